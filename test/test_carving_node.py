# SPDX-License-Identifier: Apache-2.0
"""The carving node over real DDS: sets, dead cameras, wrong masks, empty rooms, and a rig from CameraInfo and TF."""

from __future__ import annotations

import itertools
import time
from array import array
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.parameter import Parameter
from ros_graph import Graph
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Header

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import ConfigError, InputError, NoPerson, RigError
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.nodes.carving import CarvingNode
from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.ros import carving_report, topics
from limbloc_ros.ros.cloud_messages import cloud_to_hull
from limbloc_ros.ros.image_messages import mask_to_compressed, mask_to_image
from limbloc_ros.ros.messages import joints_to_message, make_header, stamp_ns
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

CAMERAS = 4
T0_NS = 1_000_000_000_000
FRAME_NS = 100_000_000

Masks = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_rig(CAMERAS, 160, 120)


@pytest.fixture(scope="module")
def person(rig: Rig) -> Masks:
    room = SimulatedRoom(rig, empty_s=0.0)
    return {name: room.render_with_mask(name, 1.0)[1] for name in rig.names}


@pytest.fixture
def rig_file(rig: Rig, tmp_path: Path) -> str:
    save_rig(rig, tmp_path / "rig.yaml")
    return str(tmp_path / "rig.yaml")


class Cameras:
    """Publishes compressed masks of all cameras and waits for hulls."""

    def __init__(self, graph: Graph, names: tuple[str, ...]) -> None:
        self.graph = graph
        self.hulls: list[PointCloud2] = graph.collect(PointCloud2, "hull")
        self.diagnostics = graph.diagnostics()
        self.publishers = {name: graph.publisher(CompressedImage, f"{name}/mask/compressed") for name in names}
        graph.until(lambda: graph.tester.count_publishers("hull") > 0)
        graph.spin(0.1)

    def send(self, masks: Masks, n: int, skew_ns: int = 0) -> None:
        """One frame; camera k's stamp is k * skew_ns late."""
        for k, (name, mask) in enumerate(masks.items()):
            header = make_header(T0_NS + n * FRAME_NS + k * skew_ns, topics.optical_frame(name))
            self.publishers[name].publish(mask_to_compressed(mask, header))

    def hull(self, masks: Masks, n: int, **options: Any) -> Hull | None:
        """Send one frame and return what was carved."""
        before = len(self.hulls)
        self.send(masks, n, **options)
        self.graph.until(lambda: len(self.hulls) == before + 1)
        assert stamp_ns(self.hulls[-1].header) == T0_NS + n * FRAME_NS
        return cloud_to_hull(self.hulls[-1])


def empty(masks: Masks) -> Masks:
    return {name: np.zeros_like(mask) for name, mask in masks.items()}


def assert_same_hull(hull: Hull | None, expected: Hull | NoPerson) -> None:
    assert isinstance(hull, Hull)
    assert isinstance(expected, Hull)
    assert (hull.voxel_m, hull.band_m, hull.index_min) == (expected.voxel_m, expected.band_m, expected.index_min)
    assert hull.sdf.tobytes() == expected.sdf.tobytes()


def test_the_live_hull_is_the_offline_hull_bit_for_bit(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    assert_same_hull(cameras.hull(person, 0, skew_ns=1_000_000), Carver(rig).carve(person))
    assert cameras.hulls[-1].header.frame_id == "room"
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "sets_complete") == "1")
    assert float(cameras.diagnostics.value("carving: hull", "skew_ms")) == pytest.approx(3.0)
    assert int(cameras.diagnostics.value("carving: hull", "voxels_inside")) > 1000


def test_raw_masks_give_the_same_hull(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file, mask_transport="raw")
    hulls = graph.collect(PointCloud2, "hull")
    publishers = {name: graph.publisher(Image, f"{name}/mask") for name in rig.names}
    graph.until(lambda: graph.tester.count_publishers("hull") > 0)
    graph.spin(0.1)
    for name, mask in person.items():
        publishers[name].publish(mask_to_image(mask, make_header(T0_NS, "")))
    graph.until(lambda: len(hulls) == 1)
    assert_same_hull(cloud_to_hull(hulls[0]), Carver(rig).carve(person))


def test_an_empty_room_gives_empty_hulls_and_says_so(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    assert cameras.hull(empty(person), 0) is None
    graph.until(cameras.diagnostics.says("carving: hull", "no person"))
    assert cameras.diagnostics["carving: hull"].level == DiagnosticStatus.OK
    assert cameras.hull(person, 1) is not None


def test_a_dead_camera_is_named_and_the_others_go_on(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names[:3])
    three = {name: person[name] for name in rig.names[:3]}
    expected = Carver(rig).carve(three)
    for n in range(7):
        assert_same_hull(cameras.hull(three, n), expected)
    graph.until(cameras.diagnostics.says("carving: camera cam3", "no mask on cam3/mask/compressed", "nobody publishes"))
    status = cameras.diagnostics["carving: camera cam3"]
    assert status.level == DiagnosticStatus.ERROR
    assert all(f"/cam{k}/mask/compressed" in status.message for k in range(3))  # what there is instead
    graph.until(lambda: cameras.diagnostics.value("carving: camera cam3", "missing") == "7")


def test_a_pose_node_that_died_is_missed(
    graph: Graph, rig: Rig, rig_file: str, person: Masks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cannot say so itself; who never heard it misses nothing."""
    monkeypatch.setattr(carving_report, "SILENT_S", 0.3)
    node = graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    numbers = itertools.count()
    for _ in range(3):
        cameras.hull(empty(person), next(numbers))
        graph.spin(0.2)
    assert cameras.diagnostics["carving: hull"].level == DiagnosticStatus.OK
    pose = graph.publisher(PoseArray, topics.JOINTS)
    pose.publish(PoseArray())
    graph.until(lambda: node.report.answered_once)

    def carve_until_it_says(*words: str) -> None:
        said = cameras.diagnostics.says("carving: hull", *words)
        while not said():
            cameras.hull(empty(person), next(numbers))
            graph.spin(0.02)
            assert next(numbers) < 1000

    carve_until_it_says("no poses come", "is the pose node down?")
    assert cameras.diagnostics["carving: hull"].level == DiagnosticStatus.WARN
    pose.publish(PoseArray())
    carve_until_it_says("no person")


@pytest.mark.parametrize(
    ("fault", "words"),
    [("late", ["ms older", "late"]), ("clock", ["ms younger", "clock is off"]),
     ("half", ["masks of it came", "of the other cameras"]), ("again", ["the same stamps again and again"])],
)  # fmt: skip
def test_why_a_camera_is_missing_from_the_sets(
    graph: Graph, rig: Rig, rig_file: str, person: Masks, fault: str, words: list[str]
) -> None:
    graph.add(CarvingNode, rig_file=rig_file, sync__timeout_s=0.05)
    cameras = Cameras(graph, rig.names)
    three = {name: person[name] for name in rig.names[:3]}
    period_ns, now_ns = 80_000_000, time.time_ns()
    started = time.monotonic()
    for n in range(16):
        for name, mask in three.items():
            cameras.publishers[name].publish(mask_to_compressed(mask, make_header(now_ns + n * period_ns, "")))
        shown = {"late": n - 3, "clock": n, "half": n if n % 2 else -1, "again": 0}[fault]
        if shown >= 0:
            stamp = now_ns + shown * period_ns + (40_000_000 if fault == "clock" else 0)
            cameras.publishers["cam3"].publish(mask_to_compressed(person["cam3"], make_header(stamp, "")))
        graph.spin(max(started + (n + 1) * period_ns / 1e9 - time.monotonic(), 0.0))
    status = cameras.diagnostics["carving: camera cam3"]
    assert status is not None and all(word in status.message for word in ("missing in", *words)), status
    assert not cameras.diagnostics.says("carving: camera cam0", "missing in")()


def test_what_free_running_cameras_cost_is_told_in_millimetres(
    graph: Graph, rig: Rig, rig_file: str, person: Masks
) -> None:
    """Cameras 4 ms apart each, 12 ms in all; a hand at 1.5 m/s is elsewhere by 18 mm meanwhile."""
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    answers = graph.publisher(PoseArray, topics.JOINTS)
    for n in range(4):
        cameras.hull(person, n, skew_ns=4_000_000)
        joints = np.zeros((len(JOINT_NAMES), 3))
        joints[JOINT["wrist_R"], 0] = 0.15 * n
        answers.publish(joints_to_message(joints, make_header(T0_NS + n * FRAME_NS, "room")))
        graph.spin(0.05)
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "skew_costs_mm") not in (None, "nan"))
    assert float(cameras.diagnostics.value("carving: hull", "skew_ms")) == pytest.approx(12.0)
    assert float(cameras.diagnostics.value("carving: hull", "fastest_joint_m_s")) == pytest.approx(1.5)
    assert float(cameras.diagnostics.value("carving: hull", "skew_costs_mm")) == pytest.approx(18.0)
    assert float(cameras.diagnostics.value("carving: camera cam2", "stamp_behind_ms")) == pytest.approx(8.0)


def test_fewer_masks_than_min_cameras_give_no_hull(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file, hull__min_cameras=4)
    cameras = Cameras(graph, rig.names)
    cameras.send({name: person[name] for name in rig.names[:3]}, 0)
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "sets_dropped") == "1")
    assert not cameras.hulls


def test_masks_of_different_instants_are_never_mixed(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    """The last camera is 40 ms late, twice the slop: its masks make sets of their own, which are too small."""
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    three = {name: person[name] for name in rig.names[:3]}
    cameras.send(three, 0)
    late = make_header(T0_NS + 40_000_000, "")
    cameras.publishers["cam3"].publish(mask_to_compressed(person["cam3"], late))
    graph.until(lambda: len(cameras.hulls) == 1)
    assert_same_hull(cloud_to_hull(cameras.hulls[0]), Carver(rig).carve(three))
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "sets_dropped") == "1")
    assert len(cameras.hulls) == 1


def test_a_mask_of_the_wrong_size_is_named_and_left_out(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    wrong = {**person, "cam2": np.full((240, 320), 255, np.uint8)}
    rest = {name: mask for name, mask in person.items() if name != "cam2"}
    assert_same_hull(cameras.hull(wrong, 0), Carver(rig).carve(rest))
    graph.until(cameras.diagnostics.says("carving: hull", "camera cam2", "160x120", "320x240"))
    assert cameras.diagnostics["carving: hull"].level == DiagnosticStatus.ERROR


def test_a_truncated_mask_is_named_and_the_node_goes_on(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    msg = mask_to_compressed(person["cam1"], make_header(T0_NS, ""))
    msg.data = array("B", msg.data[:100])
    cameras.publishers["cam1"].publish(msg)
    graph.until(cameras.diagnostics.says("carving: hull", "camera cam1", "PNG", "truncated"))
    assert cameras.hull(person, 1) is not None


def test_a_looped_bag_goes_on_after_the_jump_back(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    for n in (50, 51, 0, 1):
        assert cameras.hull(person, n) is not None
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "jumps_back_in_time") == "1")
    graph.until(cameras.diagnostics.says("carving: hull", "jumped back in time"))


def test_a_slow_machine_skips_whole_sets_and_carves_the_newest(
    graph: Graph, rig: Rig, rig_file: str, person: Masks
) -> None:
    node = graph.add(CarvingNode, rig_file=rig_file, catch_up_s=3 * FRAME_NS / 1e9)
    cameras = Cameras(graph, rig.names)
    fast, seen = node.carver.carve, []

    def slow(masks: Masks) -> Hull | NoPerson:
        seen.append(tuple(masks))
        time.sleep(0.3)
        return fast(masks)

    node.carver.carve = slow
    cameras.send(person, 0)
    graph.until(lambda: len(seen) == 1)
    for n in range(1, 9):
        cameras.send(person, n)
    graph.until(lambda: len(cameras.hulls) > 0 and stamp_ns(cameras.hulls[-1].header) == T0_NS + 8 * FRAME_NS)
    assert set(seen) == {rig.names}  # no set lacks a camera
    carved = len(cameras.hulls)
    assert carved < 9
    graph.until(lambda: cameras.diagnostics.value("carving: hull", "sets_skipped") == str(9 - carved))


def test_sets_wait_longer_while_a_camera_is_behind(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    graph.add(CarvingNode, rig_file=rig_file)
    cameras = Cameras(graph, rig.names)
    skips = graph.publisher(Header, topics.FRAMES_SKIPPED)
    three = {name: person[name] for name in rig.names[:3]}
    for n, complete in ((1, "0"), (2, "1")):
        cameras.send(three, n)
        graph.spin(0.4)
        cameras.publishers["cam3"].publish(mask_to_compressed(person["cam3"], make_header(T0_NS + n * FRAME_NS, "")))
        graph.until(lambda n=n: len(cameras.hulls) == n)
        graph.spin(0.15)
        assert cameras.diagnostics.value("carving: hull", "sets_complete") == complete
        skips.publish(make_header(T0_NS + n * FRAME_NS, "cam3"))
        graph.spin(0.1)


def test_some_cameras_of_the_rig(graph: Graph, rig: Rig, rig_file: str, person: Masks) -> None:
    node = graph.add(CarvingNode, rig_file=rig_file, cameras=["cam0", "cam2", "cam3"])
    assert node.rig.names == ("cam0", "cam2", "cam3")
    cameras = Cameras(graph, node.rig.names)
    three = {name: person[name] for name in node.rig.names}
    assert_same_hull(cameras.hull(three, 0), Carver(rig).carve(three))


def test_a_rig_that_cannot_be_carved_with_leaves_the_old_one(graph: Graph, rig: Rig, rig_file: str) -> None:
    """As CameraInfo may bring one while the node runs."""
    node = graph.add(CarvingNode, rig_file=rig_file)
    before = (node.rig, node.carver, node.synchroniser)
    impossible = replace(rig.cameras[0], distortion=np.array([-1e6, 0.0, 0.0, 0.0]), distortion_model="radtan")
    with pytest.raises(RigError, match="impossible"):
        node.use_rig(replace(rig, cameras=(impossible, *rig.cameras[1:])))
    assert (node.rig, node.carver, node.synchroniser) == before


def test_live_parameters(graph: Graph, rig_file: str) -> None:
    node = graph.add(CarvingNode, rig_file=rig_file)
    results = node.set_parameters(
        [
            Parameter("sync.slop_s", value=0.05),
            Parameter("hull.min_cameras", value=3),
            Parameter("hull.voxel_m", value=0.03),
        ]
    )
    assert [r.successful for r in results] == [True, True, False]
    assert (node.synchroniser.slop_s, node.synchroniser.min_cameras, node.hull_config.voxel_m) == (0.05, 3, 0.02)


@pytest.mark.parametrize(
    ("parameters", "error", "words"),
    [
        ({"rig_file": "nowhere.yaml"}, RigError, "nowhere.yaml"),
        ({"cameras": ["cam0", "cam9"]}, RigError, "no camera 'cam9'; it has cam0, cam1"),
        ({"hull__voxel_m": 0.02000001}, InputError, "micrometres"),
    ],
)
def test_what_cannot_work_stops_the_node_at_its_start(
    graph: Graph, rig_file: str, parameters: dict[str, object], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        graph.add(CarvingNode, **{"rig_file": rig_file, **parameters})


def test_neither_rig_file_nor_cameras(graph: Graph) -> None:
    with pytest.raises(ConfigError, match="parameter cameras"):
        graph.add(CarvingNode)
