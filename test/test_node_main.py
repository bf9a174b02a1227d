# SPDX-License-Identifier: Apache-2.0
"""Processes of nodes: they stop cleanly on signals, and say in one line why they cannot start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
from geometry_msgs.msg import PoseArray
from ros_graph import DOMAIN, Graph

from limbloc_ros.ros import topics
from limbloc_ros.ros.exit_codes import REFUSED


def start(*parameters: str) -> subprocess.Popen[str]:
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    return subprocess.Popen(
        [sys.executable, "-m", "limbloc_ros.nodes.simulated_cameras", "--ros-args", *arguments],
        env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_middle_of_work_ends_the_process_cleanly(graph: Graph, number: signal.Signals) -> None:
    truth = graph.collect(PoseArray, topics.TRUE_JOINTS)
    process = start("number_of_cameras:=2", "width:=64", "height:=64", "rate_hz:=120.0")
    try:
        graph.until(lambda: len(truth) > 20)
        process.send_signal(number)
        output, _ = process.communicate(timeout=10)
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output


IMPATIENT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            signal.raise_signal(signal.{name})
sys.meta_path.insert(0, Finder())
sys.argv = ["{command}", '{{"nodes": [{{"kind": "carving"}}]}}']
from limbloc_ros.nodes.start import {command}
sys.exit({command}())
"""


@pytest.mark.parametrize(
    ("command", "module", "name"),
    [
        ("carving", "numpy", "SIGINT"),
        ("composed", "rclpy", "SIGTERM"),
        ("composed", "limbloc_ros.nodes.carving", "SIGINT"),  # the kinds' modules come before any node is made
    ],
)
def test_a_signal_while_modules_are_imported_ends_the_process_quietly(command: str, module: str, name: str) -> None:
    """`ros2 launch` interrupts what it has just started when another node refuses its parameters."""
    script = IMPATIENT.format(command=command, module=module, name=name)
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


def test_a_node_that_is_compiled_for_long_is_not_waited_for() -> None:
    """A signal waits until the compiler has been left, but not for ever."""
    script = """
import os, signal, sys
from limbloc_ros.ros import node_main
node_main.LATE_S = 0.3
compiler = {"__name__": "numba.core.compiler"}
exec('def compiled():\\n import signal, time\\n signal.raise_signal(signal.SIGINT)\\n time.sleep(20)', compiler)
sys.exit(node_main.main(compiler["compiled"], args=[]))
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=15, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


#: Of the main thread itself: one of the process may be taken by a thread of DDS, and comes a moment later.
INTERRUPTED = "signal.raise_signal(signal.SIGINT)"


@pytest.mark.parametrize(
    ("body", "returncode", "said"),
    [
        (INTERRUPTED, 0, ""),
        (f"try: {INTERRUPTED}\n  except KeyboardInterrupt: raise ImportError('numpy failed')", 0, ""),
        ("raise ImportError('no such module')", 1, "ImportError: no such module"),
        (f"raise InputError(Late('{INTERRUPTED}'))", REFUSED, "too late"),  # while it is said why the start failed
    ],
)
def test_a_signal_while_nodes_are_made_ends_the_process_cleanly(body: str, returncode: int, said: str) -> None:
    """Also where an import makes an ImportError of it, as numpy's does; any other ImportError is told."""
    script = f"""
import os, signal, sys
from limbloc_ros.core.errors import InputError
class Late(str):
  def __str__(self):
    exec(self)
    return "too late"
def make():
  {body}
from limbloc_ros.ros.node_main import main
sys.exit(main(make, []))
"""
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
    ended = subprocess.run(
        [sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == returncode
    assert said in ended.stderr
    assert bool(said) == bool(ended.stderr)


def test_a_bad_parameter_is_one_line_not_a_trace() -> None:
    process = start("number_of_cameras:=99")
    output, _ = process.communicate(timeout=30)
    assert process.returncode == REFUSED
    assert "parameter number_of_cameras" in output
    assert "expected int from 2 to 16" in output
    assert "Traceback" not in output


def test_an_unknown_motion_lists_the_known_ones() -> None:
    process = start("number_of_cameras:=2", "width:=64", "height:=64", "motions:=[moonwalk]")
    output, _ = process.communicate(timeout=30)
    assert process.returncode == REFUSED
    assert "moonwalk" in output
    assert "walk" in output
