# SPDX-License-Identifier: Apache-2.0
"""The smart space as a launch file, from the same YAML and with the same processes and environment as `smart_space`.

    ros2 launch limbloc_ros smart_space.launch.py source:=simulated
    ros2 launch limbloc_ros smart_space.launch.py source:=cameras rig:=lab.yaml cameras:=cam0,cam1,cam2 rviz:=true
    ros2 launch limbloc_ros smart_space.launch.py source:=bag bag:=run1 rig:=lab.yaml

`config:=my_room.yaml` gives your own copy of config/smart_space.yaml, which holds every other parameter;
`set:="pose.fit.engine=paper network.domain_id=42"` sets some of them, as `--set` of `smart_space` does.
"""

import argparse
import atexit
import os
import shlex
import tempfile
import time
from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from limbloc_ros.nodes.graph_plan import plan_graph, refuse_old_recording
from limbloc_ros.nodes.smart_space import config_from_arguments
from limbloc_ros.ros.environment import config_file, graph_environment
from limbloc_ros.ros.supervisor import End, RestartDelay, enclave_of, meaning_of

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


class Process:
    """One process of the plan, started again when it dies, after the delays of `smart_space`.

    `respawn` of launch knows one delay only, and would start a process again that has refused its parameters.
    """

    def __init__(self, plan, config):
        self.plan, self.config = plan, config
        self.delay = RestartDelay(config)
        self.node, self.began_s = None, 0.0

    def begin(self, _context=None):
        """The action that starts it; launch wants a new one each time."""
        self.began_s = time.monotonic()
        self.node = Node(
            package="limbloc_ros",
            executable="composed",
            exec_name=self.plan.name,
            arguments=[self.plan.description],
            additional_env=enclave_of(self.plan.name, os.environ),
            output="screen",
            sigterm_timeout=str(self.config.interrupt_s),
            sigkill_timeout=str(self.config.terminate_s),
        )
        return [self.node]

    def when_over(self, event, context):
        """What to do when it has ended: nothing, start it again, or stop everything."""
        name, end = self.plan.name, meaning_of(self.plan, event.returncode)
        if end is End.REFUSED:
            return EmitEvent(event=Shutdown(reason=f"{name} cannot run as configured; see its message above"))
        if end is End.OVER:
            return EmitEvent(event=Shutdown(reason=f"{name} has ended"))
        if end is End.DONE or context.is_shutdown:
            return None
        delay_s = self.delay.after(time.monotonic() - self.began_s)
        again = TimerAction(period=delay_s, actions=[OpaqueFunction(function=self.begin)])
        return [LogInfo(msg=f"{name} died; starting it again in {delay_s:g} s"), again]


def start(context):
    """Read the file with the arguments on top, and start one process per entry of the plan."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    foxglove = given["foxglove"].lower()
    port = int(foxglove) if foxglove.isdigit() and foxglove not in ("0", "1") else 0
    options = {name: given[name] or None for name in ("config", "source", "rig", "bag", "cameras", "record")}
    options["foxglove"] = port if port or foxglove in YES else None
    config = config_from_arguments(argparse.Namespace(**options, set=shlex.split(given["set"])))
    refuse_old_recording(config)
    folder = tempfile.TemporaryDirectory(prefix="limbloc_")
    atexit.register(folder.cleanup)  # not sooner: at the shutdown processes may still be reading
    plans = plan_graph(config, Path(folder.name))

    actions = [SetEnvironmentVariable(name, value) for name, value in graph_environment(config.network).items()]
    for process in [Process(plan, config.processes) for plan in plans]:
        actions += process.begin()
        ours = OnProcessExit(target_action=lambda action, p=process: action is p.node, on_exit=process.when_over)
        actions.append(RegisterEventHandler(ours))
    if given["rviz"].lower() in YES:
        actions.append(
            Node(package="rviz2", executable="rviz2", arguments=["-d", str(config_file("limbloc.rviz"))], output="log")
        )
    return [LogInfo(msg=f"smart space: source {config.source}, {len(plans)} processes"), *actions]


def generate_launch_description():
    """The arguments, then whatever the file asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
