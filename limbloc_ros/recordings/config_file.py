# SPDX-License-Identifier: Apache-2.0
"""The parameters of an offline run from YAML: the sections `background`, `sync`, `hull` and `fit`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

from limbloc_ros.core.config import from_mapping
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.recordings.offline import OfflineConfig


def load_config(path: Path | None) -> OfflineConfig:
    """Read a parameters file; the defaults without one.

    Raises:
        ConfigError: no such file, no valid YAML (with the line), or a parameter that is unknown, of the wrong type or
            out of its bounds.
    """
    if path is None:
        return OfflineConfig()
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"parameters file {path} cannot be read: {error}") from None
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"parameters file {path}{line}: not valid YAML: {error.problem}") from None
    if values is None:
        return OfflineConfig()
    if not isinstance(values, Mapping):
        raise ConfigError(f"parameters file {path}: expected sections background, sync, hull, fit, got {values!r}")
    try:
        return from_mapping(OfflineConfig, values)
    except ConfigError as error:
        raise ConfigError(f"parameters file {path}: {error}") from None
