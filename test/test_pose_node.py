# SPDX-License-Identifier: Apache-2.0
"""The pose node over real DDS, and the whole graph from simulated images to joint states."""

from __future__ import annotations

import dataclasses
import types
import xml.etree.ElementTree as ET
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.parameter import Parameter
from ros_graph import Graph
from sensor_msgs.msg import CompressedImage, JointState, PointCloud2
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from limbloc_ros.core.config import FitConfig
from limbloc_ros.core.errors import ConfigError, NoPerson
from limbloc_ros.core.hull import Hull, components
from limbloc_ros.core.people import People
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.pose import JOINT, Pose
from limbloc_ros.core.posture import POSTURES
from limbloc_ros.core.ros4hri import ros4hri
from limbloc_ros.nodes.carving import CarvingNode
from limbloc_ros.nodes.pose import PoseNode
from limbloc_ros.nodes.segmentation import SegmentationNode
from limbloc_ros.nodes.simulated_cameras import SimulatedCamerasNode
from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.ros import body_output, topics
from limbloc_ros.ros.body_output import body_id, body_pose
from limbloc_ros.ros.cloud_messages import empty_hull_cloud, hull_to_cloud
from limbloc_ros.ros.image_messages import message_to_mask
from limbloc_ros.ros.messages import (
    make_header,
    message_to_angles,
    message_to_joints,
    message_to_transform,
    stamp_ns,
    status_values,
)
from limbloc_ros.simulation.company import company
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

T0_NS = 1_000_000_000_000
FRAME_NS = 100_000_000
#: The person has come in by then.
T_S = 2.0


@pytest.fixture(scope="module")
def room() -> SimulatedRoom:
    return SimulatedRoom(default_rig(8, 320, 240), empty_s=0.0)


@pytest.fixture(scope="module")
def hull(room: SimulatedRoom) -> Hull:
    hull = Carver(room.rig).carve(room.frame(T_S).masks)
    assert isinstance(hull, Hull)
    return hull


@pytest.fixture(scope="module")
def offline(hull: Hull) -> Pose:
    pose = PoseEstimator().estimate(hull)
    assert isinstance(pose, Pose)
    assert pose.reliable
    return pose


class Carvings:
    """Publishes hulls to a pose node and waits for its answers."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.joints: list[PoseArray] = graph.collect(PoseArray, "joints")
        self.diagnostics = graph.diagnostics()
        self.publisher = graph.publisher(PointCloud2, "hull")
        graph.until(lambda: graph.tester.count_publishers("joints") > 0)
        graph.spin(0.1)

    def send(self, hull: Hull | None, n: int = 0) -> PoseArray:
        """One hull, one answer."""
        before = len(self.joints)
        header = make_header(T0_NS + n * FRAME_NS, "room")
        self.publisher.publish(empty_hull_cloud(header) if hull is None else hull_to_cloud(hull, header))
        self.graph.until(lambda: len(self.joints) == before + 1)
        assert stamp_ns(self.joints[-1].header) == T0_NS + n * FRAME_NS
        return self.joints[-1]


def test_live_is_offline_bit_for_bit_and_near_the_truth(
    graph: Graph, hull: Hull, offline: Pose, room: SimulatedRoom
) -> None:
    graph.add(PoseNode)
    angles = graph.collect(JointState, "joint_angles")
    states = graph.collect(JointState, "humans/bodies/p1/joint_states")
    carvings = Carvings(graph)
    joints = message_to_joints(carvings.send(hull))
    graph.until(lambda: len(angles) == len(states) == 1)
    assert joints is not None
    assert joints.tobytes() == offline.joints.tobytes()
    assert message_to_angles(angles[0]) == offline.angles
    expected = {f"{name}_p1": value for name, value in ros4hri(offline, None).items()}
    assert message_to_angles(states[0]) == expected
    assert len(expected) == 20
    assert {stamp_ns(m.header) for m in (*angles, *states)} == {T0_NS}
    truth = room.joints(T_S)
    assert truth is not None
    assert np.linalg.norm(joints - truth, axis=1).mean() < 0.05
    graph.until(carvings.diagnostics.says("pose: posture", "tracking"))
    values = status_values(carvings.diagnostics["pose: posture"])
    assert float(values["xor_energy"]) == pytest.approx(offline.energy, rel=1e-3)
    assert {f"{stage}_ms" for stage in offline.stage_ms} <= set(values)


def test_the_urdf_waits_for_late_joiners_and_names_the_same_joints(graph: Graph, hull: Hull, offline: Pose) -> None:
    graph.add(PoseNode, body_id="anna")
    states = graph.collect(JointState, "humans/bodies/anna/joint_states")
    carvings = Carvings(graph)
    carvings.send(hull)
    descriptions = graph.collect(String, "humans/bodies/anna/urdf", topics.LATCHED_QOS)
    graph.until(lambda: len(descriptions) == len(states) == 1)
    robot = ET.fromstring(descriptions[0].data)
    movable = {j.attrib["name"] for j in robot.iter("joint") if j.attrib["type"] != "fixed"}
    assert movable == set(states[0].name)
    assert "body_anna" in {link.attrib["name"] for link in robot.iter("link")}


def test_a_new_urdf_only_for_notable_changes(graph: Graph, hull: Hull, offline: Pose) -> None:
    node = graph.add(PoseNode, urdf_tolerance_m=0.03, urdf_period_s=1.0)
    descriptions = graph.collect(String, "humans/bodies/p1/urdf", topics.LATCHED_QOS)
    carvings = Carvings(graph)
    name = next(iter(offline.sizes))

    def fitted(change_m: float, n: int) -> int:
        sizes = {**offline.sizes, name: offline.sizes[name] + change_m}
        node.estimator.estimate = lambda *_: dataclasses.replace(offline, sizes=sizes)
        carvings.send(hull, n)
        graph.spin(0.1)
        return len(descriptions)

    assert fitted(0.0, 0) == 1
    assert fitted(0.05, 5) == 1  # large, but only half a second after the last one
    assert fitted(0.02, 20) == 1  # late enough, but small
    assert fitted(0.05, 21) == 2


def test_nobody_gives_an_empty_answer_and_clears_the_figure(graph: Graph, hull: Hull) -> None:
    graph.add(PoseNode)
    markers = graph.collect(MarkerArray, "markers")
    states = graph.collect(JointState, "humans/bodies/p1/joint_states")
    carvings = Carvings(graph)
    assert message_to_joints(carvings.send(None)) is None
    graph.until(lambda: len(markers) == 1)
    assert markers[0].markers[0].action == Marker.DELETEALL
    assert not states
    graph.until(carvings.diagnostics.says("pose: posture", "no person", "empty"))


def test_pictures_for_those_who_look(graph: Graph, hull: Hull, offline: Pose) -> None:
    node = graph.add(PoseNode)
    node.estimator.estimate = lambda *_: offline
    carvings = Carvings(graph)
    published: list[object] = []
    node.surface.publish, original = published.append, node.surface.publish
    carvings.send(hull, 0)
    assert not published  # nobody subscribed
    node.surface.publish = original
    markers, clouds = graph.collect(MarkerArray, "markers"), graph.collect(PointCloud2, "surface")
    graph.until(lambda: node.surface.get_subscription_count() == node.markers.get_subscription_count() == 1)
    carvings.send(hull, 1)
    graph.until(lambda: len(markers) == len(clouds) == 1)
    assert [m.ns for m in markers[0].markers] == ["stick", "joints", "flesh"]
    assert clouds[0].width > 1000
    assert stamp_ns(clouds[0].header) == T0_NS + FRAME_NS


def test_a_damaged_cloud_is_named_and_the_node_goes_on(graph: Graph, hull: Hull, offline: Pose) -> None:
    node = graph.add(PoseNode)
    node.estimator.estimate = lambda *_: offline
    carvings = Carvings(graph)
    msg = hull_to_cloud(hull, make_header(T0_NS, "room"))
    msg.data = array("B", msg.data[:1000])
    carvings.publisher.publish(msg)
    graph.until(carvings.diagnostics.says("pose: posture", "hull:", "truncated"))
    assert carvings.diagnostics["pose: posture"].level == DiagnosticStatus.ERROR
    assert message_to_joints(carvings.send(hull, 1)) is not None


def test_an_unreliable_fit_is_shown_but_not_told_as_fact(graph: Graph, hull: Hull, offline: Pose) -> None:
    node = graph.add(PoseNode)
    doubtful = dataclasses.replace(offline, reliable=False, doubt="the left arm hides")
    node.estimator.estimate = lambda *_: doubtful
    states, markers = graph.collect(JointState, "humans/bodies/p1/joint_states"), graph.collect(MarkerArray, "markers")
    carvings = Carvings(graph)
    graph.until(lambda: node.markers.get_subscription_count() == 1)
    assert message_to_joints(carvings.send(hull, 0)) is None
    graph.until(lambda: len(markers) == 1)
    graph.until(carvings.diagnostics.says("pose: posture", "not reliable (the left arm hides)"))
    assert carvings.diagnostics["pose: posture"].level == DiagnosticStatus.WARN
    assert not states
    node.set_parameters([Parameter("publish_unreliable", value=True)])
    assert message_to_joints(carvings.send(hull, 1)) is not None
    graph.until(lambda: len(states) == 1)


def test_a_jump_back_in_time_starts_anew(graph: Graph, hull: Hull, offline: Pose) -> None:
    node = graph.add(PoseNode)
    node.estimator.estimate = lambda *_: offline
    resets: list[int] = []
    node.estimator.reset = lambda: resets.append(1)
    carvings = Carvings(graph)
    for n in (50, 51, 0, 1):
        carvings.send(hull, n)
    assert len(resets) == 1


def test_a_body_id_must_fit_into_names(graph: Graph) -> None:
    with pytest.raises(ConfigError, match="body_id"):
        graph.add(PoseNode, body_id="7 dwarfs")


def test_everybody_has_topics_of_their_own(graph: Graph, room: SimulatedRoom) -> None:
    """Two people: the same numbers as from the core, one set of topics each, and one leaves."""
    both = SimulatedRoom(room.rig, motions=company(2, "apart", empty_s=0.0))
    carver, people = Carver(room.rig), People(FitConfig(temporal=True))
    hulls = [carver.carve({n: both.render_with_mask(n, t)[1] for n in both.rig.names}) for t in (5.0, 5.1, 5.2, 5.3)]
    assert all(isinstance(hull, Hull) for hull in hulls)
    expected = [people.follow(people.look(hull), T0_NS + n * FRAME_NS) for n, hull in enumerate(hulls)]
    assert [body.number for body in expected[-1]] == [1, 2]
    node = graph.add(PoseNode, fit__temporal=True, body_id="anna")
    tracked: list[IdsList] = []
    node.bodies._ids_list, node.bodies._tracked = IdsList, types.SimpleNamespace(publish=tracked.append)
    ids = ("anna", "anna2")
    joints = {i: graph.collect(PoseArray, f"humans/bodies/{i}/joints") for i in ids}
    native = {i: graph.collect(JointState, f"humans/bodies/{i}/joint_angles") for i in ids}
    states = {i: graph.collect(JointState, f"humans/bodies/{i}/joint_states") for i in ids}
    markers = graph.collect(MarkerArray, "markers")
    carvings = Carvings(graph)
    for n, hull in enumerate(hulls):
        first = carvings.send(hull, n)
        graph.spin(0.1)
    (_, one), (_, two) = ((body.number, body.outcome) for body in expected[-1])
    assert message_to_joints(first).tobytes() == one.joints.tobytes()
    graph.until(lambda: len(joints["anna2"]) == len(native["anna2"]) >= 1 and len(markers) == len(hulls))
    for i, pose in (("anna", one), ("anna2", two)):
        assert message_to_joints(joints[i][-1]).tobytes() == pose.joints.tobytes()
        assert message_to_angles(native[i][-1]) == pose.angles
        assert all(name.endswith(f"_{i}") for name in states[i][-1].name)
    assert tracked[-1].ids == ["anna", "anna2"]
    assert {marker.ns for marker in markers[-1].markers} == {
        *("stick", "joints", "flesh"), *("anna2/stick", "anna2/joints", "anna2/flesh")
    }  # fmt: skip
    graph.until(carvings.diagnostics.says("pose: posture of anna2", "tracking"))
    assert status_values(carvings.diagnostics["pose: posture"])["people"] == "anna anna2"
    carvings.send(components(hulls[-1])[0], len(hulls))
    graph.until(lambda: len(markers) == len(hulls) + 1)
    assert [m.ns for m in markers[-1].markers if m.action == Marker.DELETE] == [
        "anna2/stick", "anna2/joints", "anna2/flesh"
    ]  # fmt: skip


def test_ids_count_on_from_the_first() -> None:
    assert [body_id("p1", n) for n in (1, 2, 3)] == ["p1", "p2", "p3"]
    assert [body_id("anna", n) for n in (1, 2)] == ["anna", "anna2"]
    assert body_id("body9", 2) == "body10"


# --- what only an apt ROS 2 has ---


@dataclass
class IdsList:
    """Stand-in for hri_msgs/IdsList."""

    header: Header
    ids: list[str] = field(default_factory=list)


@dataclass
class BodyPosture:
    """Stand-in for hri_msgs/BodyPosture."""

    header: Header
    posture: int = 0


def test_tf_posture_and_the_list_of_bodies_where_they_exist(
    graph: Graph, hull: Hull, offline: Pose, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Any] = []
    output = types.SimpleNamespace(available=True, wanted=True, send=sent.extend)  # somebody listens
    monkeypatch.setattr(body_output, "TransformOutput", lambda node: output)
    node = graph.add(PoseNode)
    tracked: list[IdsList] = []
    node.bodies._ids_list, node.bodies._tracked = IdsList, types.SimpleNamespace(publish=tracked.append)
    (body,) = node.bodies._outputs.values()
    postures: list[BodyPosture] = []
    body._body_posture, body._posture = BodyPosture, types.SimpleNamespace(publish=postures.append)
    node.estimator.estimate = lambda *_: offline
    descriptions = graph.collect(String, "humans/bodies/p1/urdf", topics.LATCHED_QOS)
    carvings = Carvings(graph)
    carvings.send(hull, 0)
    node.estimator.estimate = lambda *_: NoPerson("gone")
    carvings.send(hull, 1)
    assert [message.ids for message in tracked] == [["p1"], []]
    assert [message.posture for message in postures] == [POSTURES.index("standing")]
    graph.until(lambda: len(descriptions) == 1)
    root, *links = sent
    assert (root.header.frame_id, root.child_frame_id) == ("room", "body_p1")
    np.testing.assert_allclose(message_to_transform(root), body_pose(offline), atol=1e-9)
    np.testing.assert_allclose(
        message_to_transform(root)[:3, 3], (offline.joint("hip_L") + offline.joint("hip_R")) / 2, atol=1e-9
    )
    children = {joint.find("child").attrib["link"] for joint in ET.fromstring(descriptions[0].data).iter("joint")}
    assert {link.child_frame_id for link in links} == children
    assert all(stamp_ns(link.header) == T0_NS for link in sent)
    sent.clear()
    output.wanted = False
    states = graph.collect(JointState, "humans/bodies/p1/joint_states")
    node.estimator.estimate = lambda *_: offline
    carvings.send(hull, 2)
    graph.until(lambda: len(states) == 1)
    assert not sent


# --- the whole graph ---


def test_from_simulated_images_to_joint_states(graph: Graph, tmp_path: Path) -> None:
    rig = default_rig(6, 320, 240)
    rig_file = str(tmp_path / "rig.yaml")
    save_rig(rig, rig_file)
    patient = {"catch_up_s": 10.0}  # one thread does it all: nothing is to be skipped while a figure is searched
    graph.add(PoseNode, **patient)  # first, because it takes seconds to load its kernels
    graph.add(CarvingNode, rig_file=rig_file, **patient)
    for name in rig.names:
        camera = {"camera": name, "background__learning_frames": 5, "reliability": "reliable"}
        graph.add(SegmentationNode, f"segmentation_{name}", **camera, **patient)
    graph.add(SimulatedCamerasNode, rig_file=rig_file, rate_hz=3.0, empty_s=3.0)
    joints, truth = graph.collect(PoseArray, "joints"), graph.collect(PoseArray, "true_joints")
    states = graph.collect(JointState, "humans/bodies/p1/joint_states")
    masks = {name: graph.collect(CompressedImage, topics.mask_compressed(name)) for name in rig.names}
    graph.until(lambda: sum(bool(msg.poses) for msg in joints) >= 4 and len(states) >= 4, timeout_s=60.0)
    found = {stamp_ns(msg.header): message_to_joints(msg) for msg in joints if msg.poses}

    true_joints = {stamp_ns(msg.header): message_to_joints(msg) for msg in truth}
    pelvis = JOINT["pelvis_centre"]
    away = [np.linalg.norm(found[t][pelvis] - true_joints[t][pelvis]) for t in found if true_joints.get(t) is not None]
    assert len(away) >= 3
    assert np.median(away) < 0.10

    # The same masks through the offline chain.
    stamp = max(found)
    seen = {name: message_to_mask(m) for name, list_ in masks.items() for m in list_ if stamp_ns(m.header) == stamp}
    hull = Carver(rig).carve(seen)
    assert isinstance(hull, Hull)
    pose = PoseEstimator().estimate(hull)
    assert isinstance(pose, Pose)
    assert pose.joints.tobytes() == found[stamp].tobytes()
