# SPDX-License-Identifier: Apache-2.0
"""The whole smart space from one YAML file: cameras, masks, hull, posture, in few processes.

What takes long to import is imported by `load`, so that Ctrl-C ends that quietly, too.
"""

from __future__ import annotations

import importlib
import signal
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from limbloc_ros.nodes.graph_plan import SmartSpaceConfig

#: Exit codes, as of `limbloc`: wrong input, and Ctrl-C before the processes were started.
EXIT_INPUT, EXIT_INTERRUPTED = 2, 130

DESCRIPTION = "The whole smart space from one YAML file: cameras, masks, hull, posture, in few processes."

EXAMPLES = """examples:
  smart_space                                          eight simulated cameras, and a person who moves
  smart_space --source cameras --rig lab.yaml          your cameras; their drivers run already, or come later
  smart_space --source bag --bag run1 --rig lab.yaml   a recording
  smart_space my_room.yaml                             your own copy of config/smart_space.yaml
  smart_space --set pose.fit.engine=paper --set processes.cameras_per_process=2
"""


def load() -> None:
    """Import what `run` needs."""
    importlib.import_module("limbloc_ros.nodes.graph_plan")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options; `limbloc run` has the same."""
    parser.add_argument("config", nargs="?", help="smart space file; default: the installed config/smart_space.yaml")
    parser.add_argument("--source", choices=("simulated", "cameras", "bag"), help="where images come from")
    parser.add_argument("--rig", metavar="FILE", help="rig file of the cameras")
    parser.add_argument("--bag", metavar="BAG", help="recording to replay")
    parser.add_argument("--cameras", metavar="A,B,...", help="only these cameras of the rig")
    parser.add_argument("--record", metavar="FOLDER", help="record the run to this new folder")
    parser.add_argument(
        "--foxglove",
        nargs="?",
        type=int,
        const=0,
        metavar="PORT",
        help="also serve the graph to Foxglove on this machine (default port: 8765; needs the extra `foxglove`)",
    )
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="any value of the file, e.g. pose.fit.engine=paper",
    )


def config_from_arguments(options: argparse.Namespace) -> SmartSpaceConfig:
    """The file with the options on top.

    Raises:
        ConfigError: the file or an option is wrong.
    """
    from limbloc_ros.core.errors import ConfigError
    from limbloc_ros.nodes.graph_plan import load_config
    from limbloc_ros.rig.plain_values import yaml_values
    from limbloc_ros.ros.environment import config_file

    overrides: dict[str, Any] = {}
    for text in options.set:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set: expected KEY=VALUE such as pose.fit.engine=paper, got {text!r}")
        try:
            _put(overrides, key, yaml_values(value))
        except ValueError as error:
            raise ConfigError(f"--set {text}{error}") from None
    for key, value in (("source", options.source), ("rig", options.rig), ("bag", options.bag)):
        if value is not None:
            overrides[key] = value
    if options.record is not None:
        overrides["record_to"] = options.record
    if options.foxglove is not None:
        overrides["foxglove"] = True
        if options.foxglove:
            _put(overrides, "foxglove_bridge.port", options.foxglove)
    if options.cameras is not None:
        overrides["cameras"] = [name.strip() for name in options.cameras.split(",") if name.strip()]
    return load_config(options.config or config_file("smart_space.yaml"), overrides)


def _put(values: dict[str, Any], key: str, value: Any) -> None:
    """Set `key`, a path with dots; raises ConfigError where `--set` made a plain value of a section on the way."""
    from limbloc_ros.core.errors import ConfigError

    *sections, name = key.split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{key} lies inside of {section}, which --set made {values!r:.40}; leave that --set away")
    values[name] = value


def run(config: SmartSpaceConfig) -> int:
    """Plan, start, watch and stop; returns the exit code.

    Raises:
        LimblocError: the config, rig or bag cannot be used.
    """
    import tempfile
    from pathlib import Path

    from limbloc_ros.nodes.graph_plan import plan_graph, refuse_old_recording
    from limbloc_ros.ros.environment import graph_environment
    from limbloc_ros.ros.supervisor import Supervisor

    refuse_old_recording(config)
    with tempfile.TemporaryDirectory(prefix="limbloc_") as folder:
        plans = plan_graph(config, Path(folder))
        environment = graph_environment(config.network)
        print(f"smart space: source {config.source}, {len(plans)} processes. Ctrl-C stops everything")
        for plan in plans:
            print(f"  {plan.name}: {', '.join(node['name'] for node in plan.nodes)}")
        sys.stdout.flush()
        return Supervisor(plans, environment, config.processes).run()


def main(argv: Sequence[str] | None = None) -> int:
    """The command line of `ros2 run limbloc_ros smart_space`."""
    # While modules are imported there is nothing to clean up, and numpy would make an ImportError of an interrupt.
    ours = signal.signal(signal.SIGINT, signal.SIG_DFL)
    import argparse

    from limbloc_ros.core.errors import LimblocError

    load()
    signal.signal(signal.SIGINT, ours)
    parser = argparse.ArgumentParser(
        "smart_space", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_arguments(parser)
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "--ros-args" in arguments:  # as launch files give them; without them ROS need not be loaded here
        from rclpy.utilities import remove_ros_args

        arguments = remove_ros_args(arguments)
    options = parser.parse_args(arguments)
    try:
        return run(config_from_arguments(options))
    except LimblocError as error:
        print(f"smart_space: {error}", file=sys.stderr)
        return EXIT_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    raise SystemExit(main())
