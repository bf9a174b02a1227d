# SPDX-License-Identifier: Apache-2.0
"""`smart_space.yaml` -> which nodes run in which processes with which parameters.

The supervisor and the launch file both start what `plan_graph` says; it starts nothing itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limbloc_ros.core.config import from_mapping, setting
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.rig.plain_values import yaml_values
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.ros.environment import NetworkConfig
from limbloc_ros.ros.supervisor import ProcessConfig, ProcessPlan
from limbloc_ros.simulation.ring import default_rig

if TYPE_CHECKING:
    from limbloc_ros.recordings.bag_frames import CameraStream

#: Sections that hold parameters of nodes, and so names that we do not check here.
NODE_SECTIONS = ("segmentation", "carving", "pose", "simulated_cameras", "replay", "record", "foxglove_bridge")

#: In a stepped replay the clock stands still while a slow machine works; do not give a mask up meanwhile.
STEPPED_TIMEOUT_S = 5.0

#: The first start compiles the kernels, which takes a while.
READY_TIMEOUT_S = 300.0


@dataclass(frozen=True)
class SmartSpaceConfig:
    """The whole of `smart_space.yaml`."""

    source: str = setting("simulated", "where images come from", choices=("simulated", "cameras", "bag"))
    rig: str = setting("", "rig file; simulated: empty takes a ring of cameras; cameras: empty takes CameraInfo and TF")
    cameras: tuple[str, ...] = setting((), "the cameras that take part; empty: all of the rig")
    bag: str = setting("", "recording to replay, for source bag")
    namespace: str = setting("", "of all nodes and topics")
    transport: str = setting("raw", "image topics that are read", choices=("raw", "compressed"))
    record_to: str = setting("", "record the run to this new folder")
    stop_with_bag: bool = setting(True, "stop everything when the recording ends")
    foxglove: bool = setting(False, "serve the graph to Foxglove, for people who look at it in a browser")
    processes: ProcessConfig = field(default_factory=ProcessConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    segmentation: dict[str, Any] = field(default_factory=dict)
    segmentation_of: dict[str, Any] = field(default_factory=dict)
    carving: dict[str, Any] = field(default_factory=dict)
    pose: dict[str, Any] = field(default_factory=dict)
    simulated_cameras: dict[str, Any] = field(default_factory=dict)
    replay: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    foxglove_bridge: dict[str, Any] = field(default_factory=dict)


def load_config(path: str | Path, overrides: Mapping[str, Any] | None = None) -> SmartSpaceConfig:
    """Read `smart_space.yaml`. Paths in it are relative to its folder.

    Args:
        path: the YAML file.
        overrides: top-level values that replace the file's, such as `{"source": "bag"}`; paths in them are relative to
            the working folder.

    Raises:
        ConfigError: no such file, not YAML, an unknown key, a wrong type or a value out of bounds.
    """
    path = Path(path)
    try:
        values = yaml_values(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: expected a smart space file such as config/smart_space.yaml: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{path}{error}") from None
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: expected keys such as source and rig, got {type(values).__name__}")
    values = dict(values)
    for key in ("rig", "bag", "record_to"):
        if isinstance(values.get(key), str) and values[key]:
            try:
                values[key] = str(path.parent / Path(values[key]).expanduser())
            except RuntimeError as error:  # ~name of nobody
                raise ConfigError(f"{path}: {key}: {values[key]!r:.80} is no path: {error}") from None
    for key, value in (overrides or {}).items():
        values[key] = _merged(values.get(key), value)
    try:
        return config_from_mapping(values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def config_from_mapping(values: Mapping[str, Any]) -> SmartSpaceConfig:
    """The config from plain values; raises ConfigError that names the key."""
    values = {key: {} if value is None else value for key, value in values.items()}
    cameras = values.get("cameras", ())
    if not isinstance(cameras, (list, tuple)) or not all(isinstance(name, str) for name in cameras):
        raise ConfigError(f"cameras: expected a list of names, got {cameras!r:.80}")
    values["cameras"] = tuple(cameras)
    return from_mapping(SmartSpaceConfig, values)


def refuse_old_recording(config: SmartSpaceConfig) -> None:
    """Raise ConfigError when the folder to record to is there before the start."""
    if config.record_to and Path(config.record_to).exists():
        raise ConfigError(f"record_to: {config.record_to} exists already; choose another folder, or remove it")


def plan_graph(config: SmartSpaceConfig, run_folder: Path) -> list[ProcessPlan]:
    """Which processes with which nodes the config asks for.

    Args:
        config: a valid config.
        run_folder: for files that live as long as the run: the rig of the simulated cameras, and the cameras'
            backgrounds, which a segmentation process that is started again finds there.

    Raises:
        ConfigError: keys that contradict each other or are missing.
        RigError, InputError: the rig or the bag cannot be used.
    """
    if config.source == "simulated":
        return _Plan(config, run_folder).simulated()
    if config.source == "cameras":
        return _Plan(config, run_folder).real_cameras()
    return _Plan(config, run_folder).replayed()


class _Plan:
    """Builds the list of processes for one config."""

    def __init__(self, config: SmartSpaceConfig, run_folder: Path) -> None:
        self.config = config
        self.run_folder = run_folder
        self.namespace = config.namespace
        self.sim_time = False
        self.processes: list[ProcessPlan] = []

    def simulated(self) -> list[ProcessPlan]:
        """Simulated cameras and the graph."""
        c = self.config
        section = dict(c.simulated_cameras)
        rig_file = c.rig
        if not rig_file:
            count, width, height = (
                _number(section, key, default)
                for key, default in (("number_of_cameras", 8), ("width", 640), ("height", 480))
            )
            rig_file = str(self.run_folder / "rig.yaml")
            save_rig(default_rig(count, width, height), rig_file)
        names = self._names(rig_file)
        section |= {"rig_file": rig_file, "transport": c.transport}
        # The background is learnt from the empty room, so the person must not come before the other nodes are ready.
        section.setdefault("wait_for_viewers_s", READY_TIMEOUT_S)
        self._add("simulated", _node("simulated_cameras", "simulated_cameras", {**section, "cameras": names}))
        return self._graph(names, rig_file, dict.fromkeys(names, c.transport))

    def real_cameras(self) -> list[ProcessPlan]:
        """The graph alone: camera drivers run already, or come later."""
        c = self.config
        if not c.rig and not c.cameras:
            raise ConfigError(
                "rig: expected a rig file for source cameras, or `cameras` (names) to use CameraInfo and TF; got none"
            )
        names = self._names(c.rig) if c.rig else c.cameras
        return self._graph(names, c.rig, dict.fromkeys(names, c.transport))

    def replayed(self) -> list[ProcessPlan]:
        """A recording, and the graph behind its images or masks."""
        from limbloc_ros.recordings.bag_frames import camera_streams  # takes half of what the rest of a start does
        from limbloc_ros.recordings.bags import BagReader

        c = self.config
        if not c.bag:
            raise ConfigError("bag: expected a rosbag2 folder or file for source bag, got none")
        if not c.rig:
            raise ConfigError("rig: expected the rig file of the recorded cameras for source bag, got none")
        names = self._names(c.rig)
        with BagReader(c.bag) as bag:
            streams = camera_streams(bag, names, prefer="images")
            self.namespace = _namespace(streams)
            if c.namespace and c.namespace.strip("/") != self.namespace.strip("/"):
                raise ConfigError(
                    f"namespace: expected {self.namespace or '/'}, where the topics in {c.bag} are, got {c.namespace}"
                )
            companions = [f"{self.namespace}/{name}/camera_info" for name in names] + [f"{self.namespace}/true_joints"]
            topics = [re.escape(t) for t in [*(s.topic for s in streams.values()), *companions] if t in bag.topics]
        patience = {"wait_for_subscribers_s": READY_TIMEOUT_S, "wait_for_results": True}
        section = {"bag": c.bag, "topics": topics, **patience, **c.replay}
        self.sim_time = bool(section.get("clock", True))
        stepped = section.get("mode") == "stepped"
        self._add("replay", _node("replay", "replay", section), ends_graph=c.stop_with_bag)
        defaults: dict[str, Any] = {"sync": {"timeout_s": STEPPED_TIMEOUT_S}} if stepped else {}
        if all(s.is_mask for s in streams.values()):
            kinds = {s.topic.endswith("/compressed") for s in streams.values()}
            if len(kinds) > 1:
                raise ConfigError(f"{c.bag}: expected masks of all cameras raw or all compressed, got both")
            defaults["mask_transport"] = "compressed" if kinds == {True} else "raw"
            return self._graph(names, c.rig, {}, defaults)
        transports = {n: "compressed" if s.topic.endswith("/compressed") else "raw" for n, s in streams.items()}
        return self._graph(names, c.rig, transports, defaults)

    def _graph(
        self,
        names: Sequence[str],
        rig_file: str,
        transports: Mapping[str, str],
        carving_defaults: Mapping[str, Any] | None = None,
    ) -> list[ProcessPlan]:
        """Segmentation of the cameras in `transports`, carving, pose and recording."""
        c = self.config
        if unknown := sorted(map(str, set(c.segmentation_of) - set(names))):
            raise ConfigError(
                f"segmentation_of: expected names of cameras ({', '.join(names)}), got {', '.join(unknown)}"
            )
        for name, section in c.segmentation_of.items():
            if not isinstance(section, Mapping | None):
                raise ConfigError(f"segmentation_of: {name}: expected a section of parameters, got {section!r:.80}")
        # Our own publishers are reliable, and nothing may be lost; a camera driver may offer best effort only.
        reliability = "best_effort" if c.source == "cameras" else "reliable"
        common = {
            "reliability": reliability,
            "state_folder": str((self.run_folder / "background").resolve()),
            **c.segmentation,
        }
        for i, group in enumerate(_groups(list(transports), c.processes.cameras_per_process), 1):
            nodes = [
                _node(
                    "segmentation",
                    f"segmentation_{name}",
                    _merged(
                        {**common, "camera": name, "transport": transports[name]},
                        c.segmentation_of.get(name) or {},
                    ),
                )
                for name in group
            ]
            self._add(f"cameras_{i}", *nodes)
        fixed = {"rig_file": rig_file, "cameras": list(names)}
        carving = _node("carving", "carving", {**_merged(carving_defaults, c.carving), **fixed})
        pose = _node("pose", "pose", c.pose)
        if c.processes.carving_with_pose:
            self._add("carving_and_pose", carving, pose)
        else:
            self._add("carving", carving)
            self._add("pose", pose)
        if c.record_to:
            # When it has died, the supervisor starts it again, and the folder is there.
            self._add("record", _node("record", "record", {"if_exists": "next", **c.record, "bag": c.record_to}))
        if c.foxglove:
            self._add("foxglove", _node("foxglove_bridge", "foxglove_bridge", c.foxglove_bridge))
        return self.processes

    def _add(self, name: str, *nodes: dict[str, Any], ends_graph: bool = False) -> None:
        for node in nodes:
            if self.sim_time and node["kind"] not in ("replay", "record", "foxglove_bridge"):
                node["parameters"].setdefault("use_sim_time", True)
        self.processes.append(ProcessPlan(name, self.namespace, nodes, ends_graph))

    def _names(self, rig_file: str) -> tuple[str, ...]:
        """The cameras that take part; each must be in the rig."""
        rig = load_rig(rig_file)
        for name in self.config.cameras:
            rig.camera(name)
        return self.config.cameras or rig.names


def _node(kind: str, name: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {"kind": kind, "name": re.sub(r"\W", "_", name), "parameters": dict(parameters)}


def _groups(names: Sequence[str], size: int) -> list[list[str]]:
    """As few groups of at most `size` as possible, of nearly equal size."""
    count = -(-len(names) // size)
    return [list(names[i * len(names) // count : (i + 1) * len(names) // count]) for i in range(count)]


def _merged(old: Any, new: Any) -> Any:
    """`new` over `old`, section by section; keys with dots and nested sections may be mixed by the caller."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        return {**old, **{key: _merged(old.get(key), value) for key, value in new.items()}}
    return new


def _number(section: Mapping[str, Any], key: str, default: int) -> int:
    value = section.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool):
        raise ConfigError(f"simulated_cameras: {key}: expected a whole number, got {value!r}")
    return value


def _namespace(streams: Mapping[str, CameraStream]) -> str:
    """What stands before `/<camera>/...` in the topics, the same for all cameras."""
    found = {s.topic.split(f"/{s.camera}/")[0] for s in streams.values()}
    if len(found) > 1:
        raise ConfigError(f"expected all cameras of the recording in one namespace, got {', '.join(sorted(found))}")
    return found.pop()
