# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the method, once: default, description, unit and bounds.

Nodes declare their ROS parameters by iterating over these fields (`limbloc_ros.ros.parameters`), the offline
run reads the same classes from YAML, and `docs/parameters.md` is generated from them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from limbloc_ros.core.errors import ConfigError

T = TypeVar("T")


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """A dataclass field that carries what a person needs to set it.

    `live` says that a running node may change it (`ros2 param set`); all others are read-only after start.
    """
    info = {"description": description, "unit": unit, "low": low, "high": high, "choices": choices, "live": live}
    return dataclasses.field(default=default, metadata=info)


@dataclass(frozen=True)
class BackgroundConfig:
    """Running Gaussian average segmentation (paper section 1, after Wren et al. 1997)."""

    learning_frames: int = setting(15, "person-free frames that make the first background", low=1, high=10_000)
    learning_rate: float = setting(
        0.01, "weight of a new background pixel (0: the background stays as learned)", low=0.0, high=1.0, live=True
    )
    threshold_sigmas: float = setting(
        4.0, "a pixel further than this from its mean is foreground", unit="sigma", low=0.5, high=50.0, live=True
    )
    sigma_floor: float = setting(
        2.0, "standard deviation added to every pixel's own", unit="grey levels", low=0.1, high=64.0, live=True
    )
    shadow_darkest: float = setting(
        0.5, "a pixel darker than this fraction of its background is no shadow", low=0.0, high=1.0, live=True
    )
    highlight_brightest: float = setting(
        1.15,
        "a pixel brighter than this multiple of its background is no reflected light",
        low=1.0,
        high=3.0,
        live=True,
    )
    shadow_sigmas: float = setting(
        2.0,
        "a darker pixel whose colour differs by less than this from its background's is shadow; every foreground blob "
        "must somewhere reach twice this",
        unit="sigma",
        low=0.0,
        high=15.0,
        live=True,
    )
    edge_fraction: float = setting(
        0.45,
        "the outline runs where the change falls below this fraction of the change just inside (0: no trimming)",
        low=0.0,
        high=0.95,
        live=True,
    )
    open_px: int = setting(
        0, "radius of the morphological opening (removes thin things)", unit="px at 640x480", low=0, high=20, live=True
    )
    close_px: int = setting(
        2, "radius of the morphological closing (fills cracks)", unit="px at 640x480", low=0, high=50, live=True
    )
    min_blob_px: int = setting(
        150, "smaller foreground blobs are dropped", unit="px at 640x480", low=0, high=1_000_000, live=True
    )
    max_hole_px: int = setting(
        100, "smaller holes in the foreground are filled", unit="px at 640x480", low=0, high=1_000_000, live=True
    )
    relearn_fraction: float = setting(
        0.6,
        "when more of the image than this changes, the light was switched: no mask, the background is learned anew",
        low=0.05,
        high=1.0,
        live=True,
    )
    max_pixels: int = setting(
        700_000,
        "larger images are halved until they have no more pixels than this",
        unit="px",
        low=10_000,
        high=100_000_000,
    )


@dataclass(frozen=True)
class HullConfig:
    """The visual hull as a signed distance field (paper section 1)."""

    voxel_m: float = setting(0.02, "edge length of a voxel", unit="m", low=0.005, high=0.10)
    band_m: float = setting(
        0.06, "signed distances outside the hull are kept up to this, as a thin shell", unit="m", low=0.01, high=0.5
    )
    min_cameras: int = setting(2, "fewer live masks than this give no hull", low=1, high=64, live=True)
    min_share: float = setting(
        0.6, "fewer live masks than this share of the rig's cameras give no hull", low=0.0, high=1.0, live=True
    )
    repair_depth_m: float = setting(
        0.04,
        "with six cameras or more, a voxel that one camera denies stays when this deep inside all other silhouettes",
        unit="m",
        low=0.0,
        high=1.0,
        live=True,
    )
    shared_veto: float = setting(
        1.0,
        "how far the hull of six or more cameras that contradict each other goes to what all but one see",
        low=0.0,
        high=1.0,
        live=True,
    )
    min_voxels: int = setting(500, "smaller hulls are no person", unit="voxels", low=1, high=10_000_000, live=True)
    min_further_voxels: int = setting(
        1500,
        "of several separate parts of the hull the largest is kept, and those that are no smaller than this (as if "
        "voxels were 0.02 m) and no phantoms: they may be further people",
        unit="voxels",
        low=1,
        high=10_000_000,
        live=True,
    )


@dataclass(frozen=True)
class SyncConfig:
    """How masks of several cameras become one set by acquisition stamp."""

    slop_s: float = setting(0.02, "largest stamp difference within a set", unit="s", low=0.0, high=1.0, live=True)
    queue: int = setting(10, "sets that may wait for late cameras", unit="sets", low=1, high=1000)
    timeout_s: float = setting(
        0.15, "an incomplete set is used or dropped after this", unit="s", low=0.0, high=10.0, live=True
    )
    silent_sets: int = setting(
        5, "a camera missing in this many sets running is no longer waited for (0: always wait)", low=0, high=1000
    )


@dataclass(frozen=True)
class FitConfig:
    """How the figure is fitted to the hull (paper sections 2.1 to 2.5)."""

    engine: str = setting("robust", "which fitting chain runs", choices=("robust", "paper"))
    temporal: bool = setting(False, "start from the previous frame; falls back by itself", live=True)
    seed: int = setting(0, "seed of every random choice: the same input gives the same result", low=0, high=2**31 - 1)
    max_people: int = setting(
        4, "most people who are followed at once, each with an id of its own; 1: only the largest body", low=1, high=16
    )


def validated(config: T) -> T:
    """Return `config` unchanged, or raise ConfigError naming the first field that is out of its bounds."""
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value, info = getattr(config, field.name), field.metadata
        if dataclasses.is_dataclass(value):
            validated(value)
            continue
        if info.get("choices") and value not in info["choices"]:
            raise ConfigError(f"{field.name}: expected one of {', '.join(info['choices'])}, got {value!r}")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        if not info.get("low", -math.inf) <= value <= info.get("high", math.inf):
            raise ConfigError(
                f"{field.name}: expected {info['low']} to {info['high']} {info['unit']}".rstrip() + f", got {value}"
            )
    return config


def from_mapping(kind: type[T], values: Mapping[str, Any]) -> T:
    """Build the config dataclass `kind` from plain values, e.g. a YAML section.

    Raises:
        ConfigError: an unknown name (the known ones are listed), a wrong type, or a value out of bounds.
    """
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    kwargs: dict[str, Any] = {}
    for name, value in values.items():
        if name not in fields:
            raise ConfigError(f"{kind.__name__} has no parameter {name!r}; it has {', '.join(sorted(fields))}")
        field = fields[name]
        default = field.default
        if default is dataclasses.MISSING:
            assert field.default_factory is not dataclasses.MISSING
            default = field.default_factory()
        if dataclasses.is_dataclass(default):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{name}: expected a section of parameters, got {value!r:.80}")
            kwargs[name] = from_mapping(type(default), value)
            continue
        if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value) if abs(value) < 2**1000 else math.inf
        if type(value) is not type(default):
            raise ConfigError(f"{name}: expected {type(default).__name__} like {default!r}, got {value!r:.80}")
        kwargs[name] = value
    return validated(kind(**kwargs))
