# SPDX-License-Identifier: Apache-2.0
"""The same footage through the live graph over DDS and through the offline run: the same numbers, bit for bit.

The footage is a piece of test/data/rgb_walk (JPEG pictures of four cameras, empty room first), written as a bag with
the tool that users have for it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from ros_graph import Graph
from sensor_msgs.msg import JointState

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import BackgroundConfig, FitConfig
from limbloc_ros.core.pose import Pose
from limbloc_ros.core.ros4hri import ros4hri
from limbloc_ros.nodes.carving import CarvingNode
from limbloc_ros.nodes.graph_plan import STEPPED_TIMEOUT_S
from limbloc_ros.nodes.pose import PoseNode
from limbloc_ros.nodes.replay import ReplayNode
from limbloc_ros.nodes.segmentation import SegmentationNode
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.recordings.results import Run
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.ros.messages import message_to_angles, message_to_joints, stamp_ns

ROOT = Path(__file__).parents[1]
WALK = ROOT / "test" / "data" / "rgb_walk"
CAMERAS = ("cam0", "cam2", "cam4", "cam6")
#: Pictures of the empty room, then of the man.
LEARNING, FRAMES = 8, 10
SLOW_S = 120.0


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("footage_to_bag", ROOT / "tools" / "footage_to_bag.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rig() -> Rig:
    whole = load_rig(WALK / "calib.json")
    return Rig(tuple(whole.camera(name) for name in CAMERAS), whole.volume_min, whole.volume_max)


@pytest.fixture(scope="module")
def recorded(tool: ModuleType, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A bag of the footage, and the rig file."""
    folder = tmp_path_factory.mktemp("footage")
    save_rig(rig, folder / "rig.yaml")
    assert tool.write_bag(WALK / "rgb", rig, folder / "bag", numbers=range(FRAMES)) == FRAMES * len(CAMERAS)
    return folder / "bag", folder / "rig.yaml"


def offline_run(path: Path, rig: Rig, *, temporal: bool = False) -> Run:
    config = OfflineConfig(background=BackgroundConfig(learning_frames=LEARNING), fit=FitConfig(temporal=temporal))
    return process(open_source(path, rig, config), config, jobs=1)


@pytest.mark.parametrize("temporal", [False, True])
def test_the_replayed_bag_gives_the_joint_angles_of_the_offline_run(
    graph: Graph, recorded: tuple[Path, Path], rig: Rig, temporal: bool
) -> None:
    bag, rig_file = recorded
    offline = offline_run(bag, load_rig(rig_file), temporal=temporal)
    graph.add(PoseNode, publish_unreliable=True, fit__temporal=temporal)
    graph.add(CarvingNode, rig_file=str(rig_file), sync__timeout_s=STEPPED_TIMEOUT_S)
    for name in CAMERAS:
        graph.add(
            SegmentationNode,
            f"segmentation_{name}",
            camera=name,
            transport="compressed",
            reliability="reliable",
            background__learning_frames=LEARNING,
        )
    joints, native = graph.collect(PoseArray, "joints"), graph.collect(JointState, "joint_angles")
    states = graph.collect(JointState, "humans/bodies/p1/joint_states")
    replay = graph.add(ReplayNode, bag=str(bag), mode="stepped", result_timeout_s=SLOW_S)
    graph.until(replay.done.is_set, timeout_s=SLOW_S)
    assert (replay.error, replay.steps, replay.unanswered) == (None, FRAMES, 0)
    graph.until(lambda: len(joints) == FRAMES and len(native) == len(states) == FRAMES - LEARNING)

    assert [stamp_ns(msg.header) for msg in joints] == [frame.stamp_ns for frame in offline.frames]
    poses = [frame.outcome for frame in offline.frames if isinstance(frame.outcome, Pose)]
    assert len(poses) == FRAMES - LEARNING
    for msg, frame in zip(joints, offline.frames, strict=True):
        found = message_to_joints(msg)
        assert (found is None) == (not isinstance(frame.outcome, Pose))
        if found is not None and isinstance(frame.outcome, Pose):
            assert found.tobytes() == frame.outcome.joints.tobytes()
    last: dict[str, float] | None = None
    for msg, state, pose in zip(native, states, poses, strict=True):
        assert message_to_angles(msg) == pose.angles
        last = ros4hri(pose, last)
        assert message_to_angles(state) == {f"{name}_p1": angle for name, angle in last.items()}


def test_the_bag_holds_the_footage_bit_for_bit(recorded: tuple[Path, Path], rig: Rig) -> None:
    config = OfflineConfig(background=BackgroundConfig(learning_frames=LEARNING))
    bag = list(open_source(recorded[0], rig, config).mask_sets())
    pictures = list(open_source(WALK / "rgb", rig, config).mask_sets())[:FRAMES]
    assert set(np.diff([frame.stamp_ns for frame in bag])) == {40_000_000}
    for a, b in zip(bag, pictures, strict=True):
        assert tuple(a.images) == tuple(b.images) == CAMERAS
        for name in CAMERAS:
            np.testing.assert_array_equal(a.images[name], b.images[name])
            np.testing.assert_array_equal(a.masks[name], b.masks[name])
