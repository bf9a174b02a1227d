# SPDX-License-Identifier: Apache-2.0
"""The smart space as a launch file, from the same YAML and with the same processes and environment as `smart_space`.

    ros2 launch limbloc_ros smart_space.launch.py source:=simulated
    ros2 launch limbloc_ros smart_space.launch.py source:=cameras rig:=lab.yaml cameras:=cam0,cam1,cam2 rviz:=true
    ros2 launch limbloc_ros smart_space.launch.py source:=bag bag:=run1 rig:=lab.yaml

`config:=my_room.yaml` gives your own copy of config/smart_space.yaml, which holds every other parameter;
`set:="pose.fit.engine=paper network.domain_id=42"` sets some of them, as `--set` of `smart_space` does.
"""

import argparse
import os
import shlex
import tempfile
from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit, OnShutdown
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from limbloc_ros.nodes.graph_plan import plan_graph
from limbloc_ros.nodes.smart_space import config_from_arguments
from limbloc_ros.ros.environment import config_file, graph_environment
from limbloc_ros.ros.supervisor import REFUSED, enclave_of

ARGUMENTS = {
    "config": ("", "smart space file; empty: the installed config/smart_space.yaml"),
    "source": ("", "simulated, cameras or bag; empty: what the file says"),
    "rig": ("", "rig file of the cameras"),
    "bag": ("", "recording to replay"),
    "cameras": ("", "only these cameras of the rig, separated by commas"),
    "record": ("", "record the run to this new folder"),
    "foxglove": ("false", "serve the graph to Foxglove too: true, false, or the port"),
    "set": ("", "any values of the file: KEY=VALUE, several separated by spaces"),
    "rviz": ("false", "start RViz too: true or false"),
}
YES = ("true", "1", "yes")


def when_over(plan):
    """What to do when a process has ended: stop everything if it refused its parameters, or if the bag is over."""

    def decide(event, _context):
        if event.returncode == REFUSED:
            return EmitEvent(event=Shutdown(reason=f"{plan.name} cannot run as configured; see its message above"))
        if plan.ends_graph and event.returncode == 0:
            return EmitEvent(event=Shutdown(reason=f"{plan.name} has ended"))
        return None

    return decide


def start(context):
    """Read the file with the arguments on top, and start one process per entry of the plan."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    foxglove = given["foxglove"].lower()
    port = int(foxglove) if foxglove.isdigit() and foxglove not in ("0", "1") else 0
    options = {name: given[name] or None for name in ("config", "source", "rig", "bag", "cameras", "record")}
    options["foxglove"] = port if port or foxglove in YES else None
    config = config_from_arguments(argparse.Namespace(**options, set=shlex.split(given["set"])))
    folder = tempfile.TemporaryDirectory(prefix="limbloc_")
    plans = plan_graph(config, Path(folder.name))

    actions = [SetEnvironmentVariable(name, value) for name, value in graph_environment(config.network).items()]
    for plan in plans:
        # A replay or a recording ends by itself; everything else is started again when it dies.
        finite = all(node["kind"] in ("replay", "record") for node in plan.nodes)
        process = Node(
            package="limbloc_ros",
            executable="composed",
            exec_name=plan.name,
            arguments=[plan.description],
            additional_env=enclave_of(plan.name, os.environ),
            output="screen",
            respawn=not finite,
            respawn_delay=config.processes.restart_delay_s,
            sigterm_timeout=str(config.processes.interrupt_s),
            sigkill_timeout=str(config.processes.terminate_s),
        )
        actions.append(process)
        actions.append(RegisterEventHandler(OnProcessExit(target_action=process, on_exit=when_over(plan))))
    if given["rviz"].lower() in YES:
        actions.append(
            Node(package="rviz2", executable="rviz2", arguments=["-d", str(config_file("limbloc.rviz"))], output="log")
        )

    def clean_up(_event, _context):
        folder.cleanup()

    actions.append(RegisterEventHandler(OnShutdown(on_shutdown=clean_up)))
    return [LogInfo(msg=f"smart space: source {config.source}, {len(plans)} processes"), *actions]


def generate_launch_description():
    """The arguments, then whatever the file asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
