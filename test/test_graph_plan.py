# SPDX-License-Identifier: Apache-2.0
"""What a smart space's file becomes: processes, their nodes and parameters, and words about what is wrong in it."""

import json

import pytest
from sensor_msgs.msg import CompressedImage, Image
from small_bags import write_bag

from limbloc_ros.core.errors import ConfigError, InputError, RigError
from limbloc_ros.nodes.graph_plan import SmartSpaceConfig, load_config, plan_graph
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.ros.environment import config_file
from limbloc_ros.simulation.room import default_rig


def write_yaml(path, text):
    path.write_text(text)
    return path


def test_the_installed_file_says_what_the_defaults_are(tmp_path):
    config = load_config(config_file("smart_space.yaml"))
    default = SmartSpaceConfig()
    for name in ("source", "rig", "cameras", "bag", "namespace", "transport", "record_to", "stop_with_bag"):
        assert getattr(config, name) == getattr(default, name), name
    assert (config.processes, config.network) == (default.processes, default.network)


def test_simulated_plan(tmp_path):
    config = load_config(config_file("smart_space.yaml"), {"simulated_cameras": {"number_of_cameras": 6}})
    plans = plan_graph(config, tmp_path)
    assert [p.name for p in plans] == ["simulated", "cameras_1", "cameras_2", "carving", "pose"]
    assert [len(p.nodes) for p in plans] == [1, 3, 3, 1, 1]
    rig_file = plans[0].nodes[0]["parameters"]["rig_file"]
    assert load_rig(rig_file).names == tuple(f"cam{i}" for i in range(6))
    assert plans[3].nodes[0]["parameters"]["rig_file"] == rig_file
    assert plans[1].nodes[2]["parameters"]["camera"] == "cam2"
    assert plans[1].nodes[0]["parameters"]["background"] == {"learning_frames": 15}
    assert json.loads(plans[0].description)["nodes"][0]["kind"] == "simulated_cameras"


def test_plan_for_cameras_with_a_subset_and_one_tuned_camera(tmp_path):
    save_rig(default_rig(8), tmp_path / "lab.yaml")
    path = write_yaml(
        tmp_path / "room.yaml",
        "source: cameras\nrig: lab.yaml\ncameras: [cam1, cam3, cam5]\nnamespace: /lab\nrecord_to: out\n"
        "processes: {cameras_per_process: 2, carving_with_pose: true}\n"
        "segmentation: {background: {open_px: 2}}\nsegmentation_of: {cam3: {background: {threshold_sigmas: 6}}}\n",
    )
    plans = plan_graph(load_config(path), tmp_path)
    assert [p.name for p in plans] == ["cameras_1", "cameras_2", "carving_and_pose", "record"]
    assert {p.namespace for p in plans} == {"/lab"}
    cam3 = plans[1].nodes[0]["parameters"]
    assert cam3["background"] == {"open_px": 2, "threshold_sigmas": 6}
    assert cam3["reliability"] == "best_effort"
    carving, pose = plans[2].nodes
    assert (carving["kind"], carving["parameters"]["cameras"], pose["kind"]) == (
        "carving",
        ["cam1", "cam3", "cam5"],
        "pose",
    )
    assert carving["parameters"]["rig_file"] == str(tmp_path / "lab.yaml")  # relative to the file
    assert plans[3].nodes[0]["parameters"]["bag"] == str(tmp_path / "out")


def test_plan_for_a_bag_of_images_in_a_namespace(tmp_path):
    save_rig(default_rig(3), tmp_path / "lab.yaml")
    write_bag(tmp_path / "bag", "/lab/{}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", CompressedImage())
    config = SmartSpaceConfig(
        source="bag", bag=str(tmp_path / "bag"), rig=str(tmp_path / "lab.yaml"), replay={"mode": "stepped"}
    )
    plans = plan_graph(config, tmp_path)
    assert [p.name for p in plans] == ["replay", "cameras_1", "carving", "pose"]
    assert [p.ends_graph for p in plans] == [True, False, False, False]
    assert {p.namespace for p in plans} == {"/lab"}
    first = plans[1].nodes[0]["parameters"]
    assert (first["transport"], first["reliability"], first["use_sim_time"]) == ("compressed", "reliable", True)
    assert "use_sim_time" not in plans[0].nodes[0]["parameters"]
    assert plans[2].nodes[0]["parameters"]["sync"]["timeout_s"] > 1.0


def test_plan_for_a_bag_of_masks_needs_no_segmentation(tmp_path):
    save_rig(default_rig(3), tmp_path / "lab.yaml")
    write_bag(tmp_path / "bag", "/{}/mask", "sensor_msgs/msg/Image", Image())
    config = SmartSpaceConfig(source="bag", bag=str(tmp_path / "bag"), rig=str(tmp_path / "lab.yaml"))
    plans = plan_graph(config, tmp_path)
    assert [p.name for p in plans] == ["replay", "carving", "pose"]
    assert plans[1].nodes[0]["parameters"]["mask_transport"] == "raw"
    assert plans[0].nodes[0]["parameters"]["topics"] == ["/cam0/mask", "/cam1/mask", "/cam2/mask"]
    assert plans[0].nodes[0]["parameters"]["wait_for_results"]  # the first start compiles kernels for a minute


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("sorce: bag", ConfigError, r"room.yaml: SmartSpaceConfig has no parameter 'sorce'; it has bag, cameras"),
        ("source: kinect", ConfigError, r"source: expected one of simulated, cameras, bag, got 'kinect'"),
        ("processes: {cameras_per_process: 0}", ConfigError, r"cameras_per_process: expected 1 to 64"),
        ("processes: 4", ConfigError, r"processes: expected a section"),
        ("network: {discovery: internet}", ConfigError, r"discovery: expected one of localhost, subnet, environment"),
        ("cameras: cam0", ConfigError, r"cameras: expected a list of names, got 'cam0'"),
        ("cameras: 8", ConfigError, r"cameras: expected a list of names, got 8"),
        ("[1, 2]", ConfigError, r"expected keys such as source and rig, got list"),
        ("a: [", ConfigError, r"room.yaml, line \d: not valid YAML"),
        ("source: cameras", ConfigError, r"rig: expected a rig file for source cameras"),
        ("source: bag", ConfigError, r"bag: expected a rosbag2 folder or file for source bag, got none"),
        ("{source: bag, bag: b}", ConfigError, r"rig: expected the rig file of the recorded cameras"),
        ("{source: cameras, rig: no.yaml}", RigError, r"no.yaml"),
        ("{source: cameras, rig: lab.yaml, cameras: [cam7]}", RigError, r"no camera 'cam7'; it has cam0, cam1, cam2"),
        ("{source: bag, rig: lab.yaml, bag: none}", InputError, r"there is nothing"),
        ("{segmentation_of: {cam9: {}}}", ConfigError, r"segmentation_of: expected names of cameras .*got cam9"),
        ("{segmentation_of: {7: {}, a: {}}}", ConfigError, r"segmentation_of: expected names of cameras .*got 7, a"),
        ("{simulated_cameras: {width: wide}}", ConfigError, r"width: expected a whole number, got 'wide'"),
    ],
)
def test_what_is_wrong_in_the_file_is_named(tmp_path, text, kind, message):
    save_rig(default_rig(3), tmp_path / "lab.yaml")
    path = write_yaml(tmp_path / "room.yaml", text)
    with pytest.raises(kind, match=message):
        plan_graph(load_config(path), tmp_path)
