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
from limbloc_ros.ros.node_main import REFUSED


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
