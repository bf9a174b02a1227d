# SPDX-License-Identifier: Apache-2.0
"""What the processes of a smart space need around them: installed files and environment variables.

Measured reasons: Fast DDS loses large messages with its default profile; glibc gives large blocks back to the system
after every message, which costs 3 to 10 times the copy; thread pools of the number libraries only wait for each other
when every stage is a process of its own.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import limbloc_ros
from limbloc_ros.core.config import setting
from limbloc_ros.core.errors import ConfigError

PACKAGE = "limbloc_ros"


@dataclass(frozen=True)
class NetworkConfig:
    """How the processes find each other."""

    discovery: str = setting(
        "localhost",
        "who may join: this machine only, the local network, or as the environment says",
        choices=("localhost", "subnet", "environment"),
    )
    domain_id: int = setting(-1, "ROS_DOMAIN_ID; -1: as the environment says", low=-1, high=232)
    dds_profile: str = setting(
        "", "Fast DDS profile; empty: the package's own, which large images need; none: as the environment says"
    )


def share_folder() -> Path:
    """Where `config/` and `launch/` are: the source tree, or share/limbloc_ros of an installation.

    Raises:
        ConfigError: neither is there.
    """
    source = Path(limbloc_ros.__file__).resolve().parent.parent
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    candidates = [source, *(Path(prefix) / "share" / PACKAGE for prefix in prefixes)]
    for folder in candidates:
        if (folder / "config" / "smart_space.yaml").is_file():
            return folder
    raise ConfigError(
        f"the folder config/ of {PACKAGE} was not found in {', '.join(map(str, candidates))}; install the package again"
    )


def config_file(name: str) -> Path:
    """A file of `config/`; raises ConfigError when it is not there."""
    path = share_folder() / "config" / name
    if not path.is_file():
        raise ConfigError(f"{path} is missing; install the package again")
    return path


def graph_environment(network: NetworkConfig, base: Mapping[str, str] | None = None) -> dict[str, str]:
    """The variables to add to `base` (default: this process's) for the processes of a smart space.

    A variable that is set already stays, except for what `network` asks for.

    Raises:
        ConfigError: the DDS profile does not exist.
    """
    base = os.environ if base is None else base
    wanted = {
        "MALLOC_MMAP_THRESHOLD_": str(64 * 2**20),
        "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
        "PYTHONUNBUFFERED": "1",
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
    }
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        wanted[f"{library}_NUM_THREADS"] = "1"
    if not os.access(Path(limbloc_ros.__file__).parent, os.W_OK):
        # numba keeps compiled kernels beside the modules, which an installation as root does not allow.
        wanted["NUMBA_CACHE_DIR"] = str(_cache_folder(base) / "numba")
    forced: dict[str, str] = {}
    if network.dds_profile != "none":
        ours = "fastdds_localhost.xml" if network.discovery == "localhost" else "fastdds.xml"
        profile = Path(network.dds_profile) if network.dds_profile else config_file(ours)
        if not profile.is_file():
            raise ConfigError(f"network.dds_profile: expected a Fast DDS profile file, {profile} is none")
        # Jazzy reads the second, later versions the first.
        for variable in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
            (forced if network.dds_profile else wanted)[variable] = str(profile)
    if network.discovery != "environment":
        forced["ROS_AUTOMATIC_DISCOVERY_RANGE"] = network.discovery.upper()
    if network.domain_id >= 0:
        forced["ROS_DOMAIN_ID"] = str(network.domain_id)
    return {name: value for name, value in wanted.items() if name not in base} | forced


def _cache_folder(base: Mapping[str, str]) -> Path:
    home = base.get("XDG_CACHE_HOME") or (str(Path(base["HOME"]) / ".cache") if base.get("HOME") else "")
    if home and os.access(home if Path(home).exists() else Path(home).parent, os.W_OK):
        return Path(home) / PACKAGE
    return Path(tempfile.gettempdir()) / f"{PACKAGE}_{os.getuid()}"
