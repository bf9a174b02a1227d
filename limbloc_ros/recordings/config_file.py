# SPDX-License-Identifier: Apache-2.0
"""The parameters of an offline run from the smart space's own file, so that live and offline share one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig, from_mapping
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.rig.plain_values import read_values

#: Where the method's parameters stand in the file; all else in it is about nodes and processes.
SECTIONS: dict[str, tuple[str, type[Any]]] = {
    "background": ("segmentation", BackgroundConfig),
    "hull": ("carving", HullConfig),
    "sync": ("carving", SyncConfig),
    "fit": ("pose", FitConfig),
}

#: The other keys of `smart_space.yaml`; an offline run has no use for them.
GRAPH_KEYS = (
    "source",
    "rig",
    "cameras",
    "bag",
    "namespace",
    "transport",
    "record_to",
    "stop_with_bag",
    "foxglove",
    "processes",
    "network",
    "simulated_cameras",
    "replay",
    "record",
    "foxglove_bridge",
)


def load_config(path: Path | None) -> OfflineConfig:
    """Read `smart_space.yaml` or any file with its sections `segmentation`, `segmentation_of`, `carving`, `pose`.

    Args:
        path: None takes the defaults.

    Raises:
        ConfigError: no such file, no valid YAML (with the line), or a parameter that is unknown, of the wrong type or
            out of its bounds.
    """
    if path is None:
        return OfflineConfig()
    values = read_values(path, "parameters file", "a YAML such as config/smart_space.yaml", ConfigError)
    try:
        return config_from_mapping({} if values is None else values)
    except ConfigError as error:
        raise ConfigError(f"parameters file {path}: {error}") from None


def config_from_mapping(values: Any) -> OfflineConfig:
    """Plain values of the file -> parameters; see `load_config`."""
    node_names = {node for node, _ in SECTIONS.values()} | {"segmentation_of"}
    if not isinstance(values, Mapping):
        raise ConfigError(f"expected sections {', '.join(sorted(node_names))}, got {values!r:.80}")
    if wrong := sorted(set(SECTIONS) & set(values)):
        node, _ = SECTIONS[wrong[0]]
        raise ConfigError(f"section {wrong[0]} belongs inside of section {node}, as in config/smart_space.yaml")
    if unknown := sorted(set(map(str, values)) - node_names - set(GRAPH_KEYS)):
        raise ConfigError(f"unknown section {unknown[0]!r}; expected {', '.join(sorted(node_names))}")
    found = {name: from_mapping(kind, _section(values, node, name)) for name, (node, kind) in SECTIONS.items()}
    common = _section(values, "segmentation", "background")
    one_by_one = {
        camera: from_mapping(BackgroundConfig, {**common, **_section(values["segmentation_of"], camera, "background")})
        for camera in _mapping(values.get("segmentation_of"), "segmentation_of")
    }
    return OfflineConfig(**found, background_of=one_by_one)


def _section(values: Mapping[str, Any], node: str, name: str) -> Mapping[str, Any]:
    return _mapping(_mapping(values.get(node), node).get(name), f"{node}.{name}")


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if value is not None and not isinstance(value, Mapping):
        raise ConfigError(f"{name}: expected a section of parameters, got {value!r:.80}")
    return value or {}
