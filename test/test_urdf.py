# SPDX-License-Identifier: Apache-2.0
"""The URDFs, read back from their text by a forward kinematics of our own, and the ROS4HRI angles that move them."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from figure_poses import fitted_states, pose_of, posed, random_state
from scipy.spatial.transform import Rotation

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.figure import BONE, FigureState
from limbloc_ros.core.joint_angles import NATIVE_ANGLES
from limbloc_ros.core.pose import JOINT_NAMES, Pose
from limbloc_ros.core.ros4hri import ROS4HRI_JOINTS, ros4hri
from limbloc_ros.ros.urdf import body_urdf, native_urdf

#: Where a published joint is in the ROS4HRI chain.
LINK_OF_JOINT = {"torso_centre": "torso", "neck_base": "r_head", "head_centre": "head"} | {
    f"{joint}_{side}": f"{side.lower()}_{joint}"
    for side in "LR"
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
}


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def forward(urdf: str, angles: dict[str, float], T_world_root: np.ndarray) -> dict[str, np.ndarray]:
    """T_world_link [4, 4] of every link, walking down from the root."""
    robot = ET.fromstring(urdf)
    joints = list(robot.iter("joint"))
    children = {joint.find("child").attrib["link"] for joint in joints}
    (root,) = {link.attrib["name"] for link in robot.findall("link")} - children
    place = {root: T_world_root}
    while joints:
        ready = [joint for joint in joints if joint.find("parent").attrib["link"] in place]
        assert ready, "some links hang on nothing"
        for joint in ready:
            origin = joint.find("origin")
            T = np.eye(4)
            T[:3, 3] = numbers(origin.attrib["xyz"])
            T[:3, :3] = Rotation.from_euler("xyz", numbers(origin.attrib["rpy"])).as_matrix()
            if joint.attrib["type"] == "revolute":
                turn = angles[joint.attrib["name"]] * numbers(joint.find("axis").attrib["xyz"])
                T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            place[joint.find("child").attrib["link"]] = place[joint.find("parent").attrib["link"]] @ T
            joints.remove(joint)
    return place


def body_frame(pose: Pose) -> np.ndarray:
    """T_world_body of REP-155: between the hips, turned like the pelvis."""
    T = np.eye(4)
    T[:3, :3] = pose.rotations[BONE["pelvis"]]
    T[:3, 3] = (pose.joint("hip_L") + pose.joint("hip_R")) / 2
    return T


def suffixed(angles: dict[str, float]) -> dict[str, float]:
    return {f"{name}_p1": value for name, value in angles.items()}


def losses(pose: Pose, angles: dict[str, float]) -> dict[str, float]:
    """Distance (m) of each joint of the ROS4HRI chain from the published one."""
    place = forward(body_urdf(pose, "p1"), suffixed(angles), body_frame(pose))
    return {
        joint: float(np.linalg.norm(place[f"{link}_p1"][:3, 3] - pose.joint(joint)))
        for joint, link in LINK_OF_JOINT.items()
    }


@pytest.fixture(scope="module")
def random_poses():
    rng = np.random.default_rng(11)
    return [pose_of(random_state(rng)) for _ in range(60)]


@pytest.fixture(scope="module")
def real_poses():
    return [pose_of(state) for state in fitted_states()]


@pytest.mark.parametrize("describe", [body_urdf, native_urdf])
def test_the_description_is_sound(describe):
    robot = ET.fromstring(describe(pose_of(posed({})), "p1"))
    assert robot.tag == "robot"
    links = [link.attrib["name"] for link in robot.findall("link")]
    joints = robot.findall("joint")
    names = [joint.attrib["name"] for joint in joints]
    assert len(set(links)) == len(links)
    assert len(set(names)) == len(names)
    assert len(joints) == len(links) - 1
    assert all(name.endswith("_p1") for name in links + names)
    for joint in joints:
        assert joint.find("parent").attrib["link"] in links
        assert joint.find("child").attrib["link"] in links
        assert joint.attrib["type"] in ("fixed", "revolute")
        if joint.attrib["type"] == "revolute":
            assert np.linalg.norm(numbers(joint.find("axis").attrib["xyz"])) == pytest.approx(1)
            limit = joint.find("limit").attrib
            assert float(limit["lower"]) < 0 < float(limit["upper"])
            assert float(limit["effort"]) > 0 and float(limit["velocity"]) > 0
    materials = {material.attrib["name"] for material in robot.findall("material")}
    shapes = [visual.find("geometry")[0] for visual in robot.iter("visual")]
    assert {visual.find("material").attrib["name"] for visual in robot.iter("visual")} <= materials
    assert {shape.tag for shape in shapes} == {"sphere", "cylinder"}
    assert all(0.005 < float(shape.attrib["radius"]) < 0.2 for shape in shapes)


def test_names_and_axes_are_those_of_rep_155():
    robot = ET.fromstring(body_urdf(pose_of(posed({})), "p1"))
    table = {
        joint.attrib["name"].removesuffix("_p1"): (
            joint.find("parent").attrib["link"].removesuffix("_p1"),
            joint.find("child").attrib["link"].removesuffix("_p1"),
            joint.find("axis").attrib["xyz"],
        )
        for joint in robot.findall("joint")
        if joint.attrib["type"] == "revolute"
    }
    expected = {
        "waist": ("body", "waist", "0 1 0"),
        "r_head": ("torso", "r_head", "1 0 0"),
        "y_head": ("r_head", "y_head", "0 0 1"),
        "p_head": ("y_head", "p_head", "0 -1 0"),
    }
    for s, (inward, abduct, outward) in (("l", ("0 0 -1", "1 0 0", "0 0 1")), ("r", ("0 0 1", "-1 0 0", "0 0 -1"))):
        expected |= {
            f"{s}_y_shoulder": ("torso", f"{s}_y_shoulder", inward),
            f"{s}_p_shoulder": (f"{s}_y_shoulder", f"{s}_p_shoulder", abduct),
            f"{s}_r_shoulder": (f"{s}_p_shoulder", f"{s}_shoulder", outward),
            f"{s}_elbow": (f"{s}_shoulder", f"{s}_elbow", "0 -1 0"),
            f"{s}_y_hip": ("body", f"{s}_y_hip", "0 0 -1"),
            f"{s}_p_hip": (f"{s}_y_hip", f"{s}_p_hip", abduct),
            f"{s}_r_hip": (f"{s}_p_hip", f"{s}_hip", "0 -1 0"),
            f"{s}_knee": (f"{s}_hip", f"{s}_knee", "0 -1 0"),
        }
    assert table == expected
    fixed = {j.attrib["name"] for j in robot.findall("joint") if j.attrib["type"] == "fixed"}
    assert fixed == {f"{name}_p1" for name in ("torso", "head", "l_wrist", "r_wrist", "l_ankle", "r_ankle")}
    assert {joint.name for joint in ROS4HRI_JOINTS} == set(expected)


def test_native_kinematics_give_every_published_joint(random_poses, real_poses):
    for pose in random_poses[::2] + real_poses[::2]:
        place = forward(native_urdf(pose, "p1"), suffixed(pose.angles), body_frame(pose))
        found = np.array([place[f"{name}_p1"][:3, 3] for name in JOINT_NAMES])
        assert np.linalg.norm(found - pose.joints, axis=1).max() < 1e-4
        for bone, index in BONE.items():
            if not bone.startswith("clavicle"):  # it may turn about its own length, see joint_angles
                np.testing.assert_allclose(place[f"bone_{bone}_p1"][:3, :3], pose.rotations[index], atol=1e-5)


def test_ros4hri_kinematics_keep_the_legs_exactly(random_poses, real_poses):
    for pose in random_poses[1::2] + real_poses[1::2]:
        loss = losses(pose, ros4hri(pose))
        assert max(v for joint, v in loss.items() if joint.startswith(("hip", "knee", "ankle"))) < 1e-4


def documented_losses() -> dict[str, list[float]]:
    """The rows of docs/model.md, "What the projection drops": median, 95 %, worst, mm."""
    text = (Path(__file__).parents[1] / "docs" / "model.md").read_text()
    lines = text[text.index("### What the projection drops") :].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return {what: [float(value) for value in values] for what, *values in rows[2:]}


def test_ros4hri_kinematics_lose_what_is_documented(real_poses):
    found = [losses(pose, ros4hri(pose)) for pose in real_poses]
    table = documented_losses()
    assert len(table) == 6
    for what, documented in table.items():
        names = tuple(name.strip().removesuffix("s").replace(" ", "_") for name in what.split(","))
        values = 1000 * np.array([row[joint] for row in found for joint in row if joint.startswith(names)])
        assert len(values) >= len(found), what
        actual = [np.median(values), np.percentile(values, 95), values.max()]
        np.testing.assert_allclose(actual, documented, rtol=0.04, atol=0.1, err_msg=what)  # they are rounded


def test_wrists_make_good_a_part_of_what_shoulders_lose(real_poses):
    found = [losses(pose, ros4hri(pose)) for pose in real_poses]
    wrists, shoulders = (
        np.mean([row[f"{joint}_{side}"] for row in found for side in "LR"]) for joint in ("wrist", "shoulder")
    )
    assert wrists < 0.75 * shoulders


def test_ros4hri_keeps_the_bends_of_elbows_and_knees_and_where_the_head_looks(real_poses):
    for pose in real_poses:
        angles = ros4hri(pose)
        place = forward(body_urdf(pose, "p1"), suffixed(angles), body_frame(pose))
        np.testing.assert_allclose(place["head_p1"][:3, :3], pose.rotations[BONE["head"]], atol=1e-5)
        for s, side in (("l", "L"), ("r", "R")):
            assert angles[f"{s}_elbow"] == pytest.approx(pose.angles[f"elbow_{side}_flexion"], abs=1e-9)
            assert angles[f"{s}_knee"] == pytest.approx(-pose.angles[f"knee_{side}_flexion"], abs=1e-9)


def test_angles_of_real_poses_lie_within_the_limits(real_poses):
    for pose in real_poses[::2]:
        for describe, angles in ((body_urdf, ros4hri(pose)), (native_urdf, pose.angles)):
            for joint in ET.fromstring(describe(pose, "p1")).findall("joint[@type='revolute']"):
                limit, value = joint.find("limit").attrib, suffixed(angles)[joint.attrib["name"]]
                assert float(limit["lower"]) < value < float(limit["upper"]), joint.attrib["name"]


def test_the_limits_contain_the_stock_limits():
    assert all(j.low <= j.stock[0] and j.stock[1] <= j.high for j in ROS4HRI_JOINTS)


POSTURES = [
    ({}, {}),
    ({"shoulder_L_abduction": 90}, {"l_p_shoulder": 90}),
    ({"shoulder_R_abduction": 90}, {"r_p_shoulder": 90}),
    ({"shoulder_L_flexion": 90, "shoulder_R_flexion": 90}, {f"{s}_{a}_shoulder": 90 for s in "lr" for a in "yp"}
     | {"l_r_shoulder": 90, "r_r_shoulder": 90}),
    ({"elbow_L_flexion": 80, "elbow_R_flexion": 40}, {"l_elbow": 80, "r_elbow": 40}),
    ({f"{j}_{s}_flexion": 90 for j in ("hip", "knee") for s in "LR"},
     {f"{s}_r_hip": 90 for s in "lr"} | {f"{s}_knee": -90 for s in "lr"}),
    ({"hip_L_abduction": 30, "hip_R_abduction": 20}, {"l_p_hip": 30, "r_p_hip": 20}),
    ({"hip_L_rotation": 25}, {"l_y_hip": -25}),
    ({"hip_R_rotation": 25}, {"r_y_hip": 25}),
    ({"neck_rotation": 50}, {"y_head": 50}),
    ({"neck_flexion": 30}, {"p_head": -30}),
    ({"neck_bend": 20}, {"r_head": 20}),
]  # fmt: skip


@pytest.mark.parametrize(("native", "expected"), POSTURES)
def test_signs_and_values_of_the_ros4hri_angles(native, expected):
    found = ros4hri(pose_of(posed(native)))
    for name, value in found.items():
        # Which way an arm at the pole is split is free: it is tested by the kinematics above.
        assert np.degrees(value) == pytest.approx(expected.get(name, 0.0), abs=1e-3), name


def test_a_bend_of_the_whole_spine_is_a_bend_of_the_waist():
    bend = {f"spine_{part}_flexion": 12 for part in ("lower", "middle", "upper")}
    assert np.degrees(ros4hri(pose_of(posed(bend)))["waist"]) == pytest.approx(34, abs=4)


def swinging_arms(abduction_deg: float, frames: int = 60):
    """Walking: the left arm swings 30 degrees to and fro, once, nearly or exactly through hanging straight down."""
    for phase in np.linspace(0, 2 * np.pi, frames):
        yield pose_of(posed({"shoulder_L_flexion": 30 * np.cos(phase), "shoulder_L_abduction": abduction_deg}))


@pytest.mark.parametrize("abduction_deg", [0.0, 1e-6, 1.0])
def test_a_swinging_arm_does_not_spin_at_the_pole(abduction_deg):
    last, rows, worst = None, [], 0.0
    for pose in swinging_arms(abduction_deg):
        last = ros4hri(pose, last)
        rows.append([last[f"l_{axis}_shoulder"] for axis in "ypr"])
        worst = max(worst, losses(pose, last)["wrist_L"])
    assert np.abs(np.diff(rows, axis=0)).max() < np.radians(15)
    assert worst < 0.02
    alone = [[ros4hri(pose)[f"l_{axis}_shoulder"] for axis in "ypr"] for pose in swinging_arms(1.0)]
    assert np.abs(np.diff(alone, axis=0)).max() > np.radians(60)


def test_a_trembling_hanging_arm_stays_quiet():
    rng = np.random.default_rng(5)
    state = posed({"shoulder_L_abduction": 0.3})
    last, rows, alone = None, [], []
    for _ in range(60):
        rotations = state.rotations.copy()
        rotations[BONE["upper_arm_L"]] = rotations[BONE["upper_arm_L"]] @ exp_so3(rng.normal(0, np.radians(0.5), 3))
        pose = pose_of(FigureState(state.root, rotations, state.shape))
        last = ros4hri(pose, last)
        rows.append([last[f"l_{axis}_shoulder"] for axis in "ypr"])
        alone.append([ros4hri(pose)[f"l_{axis}_shoulder"] for axis in "ypr"])
    assert np.abs(np.diff(rows, axis=0)).max() < np.radians(15)
    assert np.abs(np.diff(alone, axis=0)).max() > np.radians(90)


def test_the_description_depends_on_sizes_not_on_posture():
    rng = np.random.default_rng(6)
    a, b = random_state(rng), random_state(rng)
    b_as_large_as_a = FigureState(b.root, b.rotations, a.shape)
    for describe in (body_urdf, native_urdf):
        assert describe(pose_of(a), "p1") == describe(pose_of(b_as_large_as_a), "p1")
        assert describe(pose_of(a), "p1") != describe(pose_of(b), "p1")


def test_the_two_descriptions_share_only_the_root():
    pose = pose_of(posed({}))
    robots = [ET.fromstring(describe(pose, "p1")) for describe in (body_urdf, native_urdf)]
    a, b = ({link.attrib["name"] for link in robot.findall("link")} for robot in robots)
    assert a & b == {"body_p1"}


@pytest.mark.parametrize("body_id", ["", "1a", "a b", 'p"1', "p-1"])
def test_an_id_that_cannot_be_part_of_a_name_is_refused(body_id):
    with pytest.raises(ValueError, match="a letter first, got"):
        body_urdf(pose_of(posed({})), body_id)


def test_a_pose_without_the_figures_parameters_is_refused():
    good = pose_of(posed({}))
    bad = Pose(*(np.zeros(3) if name == "parameters" else getattr(good, name) for name in Pose.__dataclass_fields__))
    with pytest.raises(ValueError, match=r"Pose.parameters from FigureState.to_vector.*got an array \[3\]"):
        ros4hri(bad)


def test_native_joints_are_all_angles_but_the_pelvis():
    robot = ET.fromstring(native_urdf(pose_of(posed({})), "p1"))
    moving = [joint.attrib["name"] for joint in robot.findall("joint[@type='revolute']")]
    assert sorted(moving) == sorted(f"{angle.name}_p1" for angle in NATIVE_ANGLES if angle.bone != "pelvis")
