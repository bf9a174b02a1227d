# SPDX-License-Identifier: Apache-2.0
"""Runs several nodes in one process, with one executor: cheaper than a process each.

The argument is a description in YAML (or JSON), or a file with it::

    namespace: /lab                      # optional
    nodes:
      - kind: segmentation               # segmentation carving pose simulated_cameras replay record
        name: segmentation_cam0
        parameters: {camera: cam0, background.learning_rate: 0.02}
"""

from __future__ import annotations

import ctypes
import dataclasses
import os
import signal
import sys
import threading
import time
import typing
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.rig.plain_values import yaml_values
from limbloc_ros.ros import node_main
from limbloc_ros.ros.exit_codes import ENDED, REFUSED

#: Node classes by kind; their modules are imported when asked for, because each brings its own libraries.
KINDS = {
    "segmentation": "SegmentationNode",
    "carving": "CarvingNode",
    "pose": "PoseNode",
    "simulated_cameras": "SimulatedCamerasNode",
    "replay": "ReplayNode",
    "record": "RecordNode",
    "foxglove_bridge": "FoxgloveBridge",
}

#: Nodes that may end by themselves, and the process with them.
FINITE = ("replay", "record")

#: A process whose parent has died must be gone after this, s.
ORPHAN_GRACE_S = 5.0

_PR_SET_PDEATHSIG = 1


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """The process: `run`, and then out at once.

    Nodes and DDS are shut down by then. What Python would still do, tearing down compiled kernels and the last DDS
    threads, was seen to hang for longer than anybody waits after Ctrl-C.
    """
    code = run(argv)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def run(argv: Sequence[str] | None = None) -> int:
    """Run what the first argument describes, until a signal, the end of a replay or the death of `--parent PID`."""
    everything = list(sys.argv if argv is None else argv)
    arguments = remove_ros_args(everything)[1:]
    parent = 0
    if "--parent" in arguments:
        at = arguments.index("--parent")
        parent = int(arguments[at + 1])
        del arguments[at : at + 2]
        _die_with(parent)
    if len(arguments) != 1:
        print(__doc__, file=sys.stderr)
        return REFUSED
    try:
        description = parse(arguments[0])
    except ConfigError as error:
        print(error, file=sys.stderr)
        return REFUSED
    entries = [entry for entry in description["nodes"] if isinstance(entry, Mapping)]
    for kind in KINDS:  # before there is anything to clean up: see nodes/start.py
        if any(entry.get("kind") == kind for entry in entries):
            import_module(f"limbloc_ros.nodes.{kind}")
    nodes: list[Node] = []

    def make() -> list[Node]:
        build(description, nodes)
        return nodes

    def over() -> bool:
        ends = [node.done for node in nodes if hasattr(node, "done")]
        return bool(ends) and all(end.is_set() for end in ends)

    # `until` is looked at after every callback, so it is only given where a node can end by itself.
    finite = any(entry.get("kind") in FINITE for entry in entries)
    code = node_main.main(make, everything, over if finite else None)
    for node in nodes:
        if hasattr(node, "summary"):
            print(node.summary(), flush=True)
    failed = {entry["kind"] for entry, node in zip(entries, nodes, strict=False) if getattr(node, "error", None)}
    if failed == {"record"}:  # the disk is full: the others go on
        return ENDED
    return REFUSED if failed else code


def parse(text: str) -> Mapping[str, Any]:
    """The description from YAML text or the file that `text` names.

    Raises:
        ConfigError: no such file, not YAML, or no list of nodes in it.
    """
    try:
        if "\n" not in text and "{" not in text:
            text = Path(text).read_text(encoding="utf-8")
        description = yaml_values(text)
    except (OSError, ValueError) as error:
        raise ConfigError(f"expected a description of nodes or a file with one: {error}") from error
    if not isinstance(description, Mapping) or not isinstance(description.get("nodes"), list):
        raise ConfigError("expected a description with a list of nodes, such as {nodes: [{kind: pose}]}")
    return description


def build(description: Mapping[str, Any], nodes: list[Node]) -> None:
    """Make the described nodes and append them to `nodes`.

    Raises:
        ConfigError: an entry that describes no node, an unknown kind of node, or a parameter that the node does not
            have.
    """
    for entry in description["nodes"]:
        if not isinstance(entry, Mapping):
            raise ConfigError(f"nodes: expected a mapping with the node's kind, got {entry!r:.80}")
        kind, parameters = entry.get("kind"), entry.get("parameters") or {}
        if not isinstance(kind, str) or kind not in KINDS:
            raise ConfigError(f"nodes: kind: expected one of {', '.join(KINDS)}, got {kind!r:.80}")
        if not isinstance(parameters, Mapping):
            raise ConfigError(f"nodes: {kind}: parameters: expected a mapping, got {parameters!r:.80}")
        module = import_module(f"limbloc_ros.nodes.{kind}")
        node_class = getattr(module, KINDS[kind])
        values = _with_floats(module, flatten(parameters))
        node = node_class(
            entry.get("name") or kind,
            namespace=description.get("namespace") or "",
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
        )
        nodes.append(node)
        # rclpy ignores overrides that nobody declares: a misspelt parameter would go unnoticed.
        if unknown := [name for name in values if not node.has_parameter(name)]:
            known = sorted(n for n in node.get_parameters_by_prefix("") if not n.startswith("qos_overrides"))
            raise ConfigError(
                f"{entry.get('name') or kind} has no parameter {', '.join(unknown)}; it has {', '.join(known)}"
            )


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Sections of parameters -> names with dots: `{hull: {voxel_m: 0.02}}` -> `{hull.voxel_m: 0.02}`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{name}.")
        elif value not in ([], ()):  # rclpy cannot tell what an empty list holds; it is the default anyway
            flat[f"{prefix}{name}"] = list(value) if isinstance(value, tuple) else value
    return flat


def _with_floats(module: ModuleType, values: Mapping[str, Any]) -> dict[str, Any]:
    """People write 10 where a parameter is 10.0, which ROS refuses: convert what the node's settings say is a float."""
    settings = [v for v in vars(module).values() if isinstance(v, type) and dataclasses.is_dataclass(v)]
    kinds = [item for kind in settings for item in typing.get_type_hints(kind).items()]
    wanted = (float, tuple[float, ...])
    floats = {name for name, kind in kinds if kind in wanted} - {name for name, kind in kinds if kind not in wanted}

    def converted(value: Any) -> Any:
        if isinstance(value, list):
            return [converted(item) for item in value]
        return float(value) if type(value) is int else value

    return {
        name: converted(value) if name.rpartition(".")[2] in floats else value  # sections are told by their prefix
        for name, value in values.items()
    }


def _die_with(parent: int) -> None:
    """Have the system end this process when its parent dies, however that happens."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        # The signal asks for a clean stop; a process that hangs then must not stay for ever.
        time.sleep(ORPHAN_GRACE_S)
        os._exit(1)

    if os.getppid() != parent:  # it died before we could ask
        raise SystemExit(1)
    threading.Thread(target=watch, name="watch parent", daemon=True).start()


if __name__ == "__main__":
    main()
