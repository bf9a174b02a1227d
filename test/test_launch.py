# SPDX-License-Identifier: Apache-2.0
"""The launch file and the files in config/, as far as that goes without ROS 2's launch (it has no wheel).

The launch file starts what `plan_graph` says; test_smart_space.py runs those plans for real.
"""

import argparse
import ast
import atexit
import re
import runpy
import sys
import types
import xml.etree.ElementTree as ET
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import limbloc_ros
from limbloc_ros.core.config import from_mapping
from limbloc_ros.nodes import smart_space
from limbloc_ros.nodes.composed import KINDS, flatten
from limbloc_ros.nodes.graph_plan import NODE_SECTIONS, SmartSpaceConfig, load_config, plan_graph
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.ros.environment import graph_environment, share_folder
from limbloc_ros.ros.exit_codes import REFUSED

ROOT = Path(limbloc_ros.__file__).parent.parent
LAUNCH = ROOT / "launch" / "smart_space.launch.py"
CONFIG = ROOT / "config"
#: As the beginning of smart_space.yaml says.
OTHER_THAN_THE_DEFAULT = {("pose", "fit.temporal"), ("simulated_cameras", "rate_hz")}


def launch_arguments():
    """The literal ARGUMENTS of the launch file."""
    tree = ast.parse(LAUNCH.read_text(encoding="utf-8"))
    (value,) = [
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "ARGUMENTS"
    ]
    return ast.literal_eval(value)


def test_launch_arguments_are_keys_of_the_config():
    known = {field.name for field in fields(SmartSpaceConfig)}
    arguments = launch_arguments()
    assert {"source", "rig", "bag", "cameras"} <= set(arguments)
    assert set(arguments) - {"config", "rviz", "record", "set"} <= known
    assert all(len(text) > 5 for _, text in arguments.values())


class Stand:
    """In the place of ROS 2's launch: keeps what it is made of."""

    def __init__(self, *args, **options):
        self.args, self.options = args, options

    def perform(self, context):
        return context[self.args[0]]


@pytest.fixture
def launched(monkeypatch):
    """Arguments of the launch file -> the actions that it gives to launch."""
    names = {"launch": ["LaunchDescription"], "launch.actions": [], "launch.event_handlers": [], "launch.events": []}
    for module in (*names, "launch.substitutions", "launch_ros", "launch_ros.actions"):
        made = types.ModuleType(module)
        for node in ast.walk(ast.parse(LAUNCH.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == module:
                for alias in node.names:
                    setattr(made, alias.name, type(alias.name, (Stand,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    at_exit = []
    monkeypatch.setattr(atexit, "register", at_exit.append)
    file = runpy.run_path(str(LAUNCH))
    defaults = {name: default for name, (default, _) in launch_arguments().items()}
    yield lambda **given: file["start"]({**defaults, **given})
    for clean_up in at_exit:
        clean_up()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, []),
        ({"foxglove": "true"}, ["--foxglove"]),
        ({"foxglove": "9000", "record": "out/bag"}, ["--foxglove", "9000", "--record", "out/bag"]),
        (
            {"config": "room.yaml", "source": "cameras", "rig": "lab.yaml", "cameras": "cam0,cam1"},
            ["room.yaml", "--source", "cameras", "--rig", "lab.yaml", "--cameras", "cam0,cam1"],
        ),
        (
            {"set": "pose.fit.engine=paper network.domain_id=42 namespace=/lab 'cameras=[cam1, cam2]'"},
            ["--set", "pose.fit.engine=paper", "--set", "network.domain_id=42", "--set", "namespace=/lab", "--set",
             "cameras=[cam1, cam2]"],
        ),
    ],
)  # fmt: skip
def test_the_launch_file_starts_what_the_command_line_starts(launched, given, words, tmp_path, monkeypatch):
    """Every option of `smart_space`, and each process with its keys; `limbloc run` has the same."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_SECURITY_ENCLAVE_OVERRIDE", raising=False)
    (tmp_path / "lab.yaml").write_bytes((CONFIG / "rig_4_cameras.yaml").read_bytes())
    (tmp_path / "room.yaml").write_bytes((CONFIG / "smart_space.yaml").read_bytes())
    parser = argparse.ArgumentParser()
    smart_space.add_arguments(parser)
    config = smart_space.config_from_arguments(parser.parse_args(words))
    plans = plan_graph(config, tmp_path)
    actions = launched(**given)
    processes = [action for action in actions if type(action).__name__ == "Node"]
    assert [process.options["exec_name"] for process in processes] == [plan.name for plan in plans]
    for process, plan in zip(processes, plans, strict=True):
        (description,) = process.options["arguments"]
        # Both have a folder of their own for what lives as long as the run.
        theirs, ours = (
            re.sub(r'"[^"]*/(rig\.yaml|background)"', r'"\1"', text) for text in (description, plan.description)
        )
        assert theirs == ours
        assert process.options["additional_env"] == {"ROS_SECURITY_ENCLAVE_OVERRIDE": f"/limbloc/{plan.name}"}
    told = {a.args for a in actions if type(a).__name__ == "SetEnvironmentVariable"}
    assert told == set(graph_environment(config.network).items())
    options = {action.dest for action in parser._actions} - {"help"}
    assert options <= set(launch_arguments())


def test_what_dies_is_started_again_ever_later_and_what_refused_ends_everything(launched):
    """As the supervisor does it (test_smart_space.py); tried with ROS 2's own launch as well."""
    actions = launched()
    node = next(action for action in actions if type(action).__name__ == "Node")
    handlers = [a.args[0].options for a in actions if a.args and type(a.args[0]).__name__ == "OnProcessExit"]
    (over,) = [options for options in handlers if options["target_action"](node)]
    ended, running = types.SimpleNamespace(returncode=-9), types.SimpleNamespace(is_shutdown=False)
    for seconds in (1.0, 2.0, 4.0):
        said, timer = over["on_exit"](ended, running)
        assert said.options["msg"].endswith(f"died; starting it again in {seconds:g} s")
        assert timer.options["period"] == seconds
        (begin,) = timer.options["actions"]
        (again,) = begin.options["function"](None)
        assert again.options == node.options
        assert over["target_action"](again)
        assert not over["target_action"](node)
        node = again
    assert over["on_exit"](ended, types.SimpleNamespace(is_shutdown=True)) is None
    stop = over["on_exit"](types.SimpleNamespace(returncode=REFUSED), running)
    assert "cannot run as configured" in stop.options["event"].options["reason"]


def test_everything_the_launch_file_imports_from_us_exists():
    for node in ast.walk(ast.parse(LAUNCH.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("limbloc_ros"):
            module = __import__(node.module, fromlist=[alias.name for alias in node.names])
            for alias in node.names:
                assert hasattr(module, alias.name), f"{node.module}.{alias.name}"


def test_the_executable_that_it_starts_is_installed():
    assert '"composed"' in (ROOT / "setup.py").read_text(encoding="utf-8")
    assert 'executable="composed"' in LAUNCH.read_text(encoding="utf-8")


def test_the_launch_file_and_config_are_found_where_they_are():
    assert share_folder() == ROOT
    for name in ("smart_space.yaml", "fastdds.xml", "fastdds_localhost.xml", "limbloc.rviz", "rig_4_cameras.yaml"):
        assert (CONFIG / name).is_file()


@pytest.mark.parametrize("name", ["smart_space", "smart_space_4_cameras", "smart_space_8_cameras"])
def test_every_parameter_in_the_installed_files_exists(name):
    config = load_config(CONFIG / f"{name}.yaml")
    whole = name == "smart_space"
    for section in NODE_SECTIONS:
        module = import_module(f"limbloc_ros.nodes.{section}")
        settings = [v for v in vars(module).values() if isinstance(v, type) and hasattr(v, "__dataclass_fields__")]
        known = {field.name: kind for kind in settings for field in fields(kind)}
        for key, value in flatten(getattr(config, section)).items():
            leaf = key.rpartition(".")[2]
            assert leaf in known, f"{section}: {key}"
            made = from_mapping(known[leaf], {leaf: value})  # right type and within its bounds
            other = (section, key) in OTHER_THAN_THE_DEFAULT
            if whole:
                assert (made == known[leaf]()) != other, f"{section}: {key}: the file says that it is the default"


def test_node_sections_are_the_nodes():
    assert set(NODE_SECTIONS) == set(KINDS)


@pytest.mark.parametrize("count", [4, 8])
def test_the_examples_for_four_and_eight_cameras_can_be_run_as_they_are(count, tmp_path):
    """With real cameras and with simulated ones; each camera sees most of the carve volume's floor and head height."""
    rig = load_rig(CONFIG / f"rig_{count}_cameras.yaml")
    assert len(rig.cameras) == count
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0.0, 0.75)])
    places = rig.volume_min + (rig.volume_max - rig.volume_min) * (0.2 + 0.6 * corners * [1, 1, 1 / 0.75])
    for camera in rig.cameras:
        uv, depth = camera.world_to_image(places)
        inside = (depth > 0) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
        assert inside.mean() >= 0.5, camera.name
        np.testing.assert_allclose(np.linalg.det(camera.T_world_camera[:3, :3]), 1.0, atol=1e-5)
    for source in ("cameras", "simulated"):
        config = load_config(CONFIG / f"smart_space_{count}_cameras.yaml", {"source": source})
        kinds = [node["kind"] for process in plan_graph(config, tmp_path) for node in process.nodes]
        assert kinds.count("segmentation") == count


@pytest.mark.parametrize("name", ["fastdds.xml", "fastdds_localhost.xml"])
def test_the_dds_profile_is_the_default_one_with_large_segments(name):
    space = {"d": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    root = ET.parse(CONFIG / name).getroot()
    shared = [t for t in root.iterfind(".//d:transport_descriptor", space) if t.findtext("d:type", "", space) == "SHM"]
    assert int(shared[0].findtext("d:segment_size", "0", space)) == 16 * 2**20
    assert int(shared[0].findtext("d:maxMessageSize", "0", space)) == 4 * 2**20
    participant = root.find(".//d:participant", space)
    assert participant is not None and participant.get("is_default_profile") == "true"
