# SPDX-License-Identifier: Apache-2.0
"""Hulls that no person has: a typed "no person" or a pose that is not to be acted on; never NaN, never for long."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from ros_graph import Graph
from scipy.ndimage import distance_transform_edt
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from limbloc_ros.core.config import FitConfig, HullConfig
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.geodesic import geodesic_map
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.joint_angles import ContinuousAngles
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.nodes.pose import PoseNode
from limbloc_ros.ros import messages, topics
from limbloc_ros.ros.cloud_messages import hull_to_cloud
from limbloc_ros.simulation.room import default_rig

VOXEL, BAND = 0.02, 0.06


def hull_of(inside):
    """The hull of a boolean grid, with the signed distances that carving would give it."""
    inside = np.pad(inside, 4)
    sdf = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5) * VOXEL
    return Hull(VOXEL, (-20, -20, -4), np.minimum(sdf, BAND).astype(np.float32), BAND)


def box(*shape):
    return np.ones(shape, bool)


def with_gaps(shape, kept):
    grid = np.zeros(shape, bool)
    grid[kept] = True
    return grid


def noise(share):
    return np.random.default_rng(0).random((40, 40, 90)) < share


x, y, z = np.indices((40, 40, 90))
SHAPES = {
    "one voxel": box(1, 1, 1),
    "a plane": box(1, 60, 90),
    "a floor": box(100, 100, 1),
    "a line": box(1, 1, 90),
    "a lying line": box(90, 1, 1),
    "two voxels apart": with_gaps((60, 1, 1), [0, -1]),
    "a full room": box(120, 120, 110),
    "a hollow shell": box(40, 40, 85) & ~np.pad(box(38, 38, 83), 1),
    "a cube": box(20, 20, 20),
    "a column": box(20, 20, 250),
    "every second voxel": (x + y + z) % 2 == 0,
    "thin noise": noise(0.05),
    "noise": noise(0.5),
    "spikes": (z < 2) | ((x % 10 == 0) & (y % 10 == 0)),
    "a ring": (np.abs(np.hypot(x - 19.5, y - 19.5) - 15) < 2) & (z < 3),
    "a round post": np.hypot(x - 19.5, y - 19.5)[:, :, :85] < 8,
}
#: The paper's engine takes long for what may be a person, by far not as long as a test may: those take some seconds.
PAPER = ("one voxel", "a plane", "a line", "two voxels apart", "a full room", "a hollow shell", "a column", "noise")


def nothing_confident(outcome):
    """Whether an outcome is typed and all its numbers are finite; nobody may act on it."""
    if isinstance(outcome, NoPerson):
        return bool(outcome.reason)
    arrays = (outcome.joints, outcome.rotations, outcome.parameters, outcome.sigma, outcome.flesh.centres)
    numbers = [outcome.energy, *outcome.angles.values(), *outcome.sizes.values()]
    return not outcome.reliable and all(np.isfinite(a).all() for a in (*arrays, outcome.flesh.radii, np.array(numbers)))


@pytest.mark.parametrize("name", SHAPES)
def test_the_robust_engine(name):
    hull = hull_of(SHAPES[name])
    start = time.process_time()
    for temporal in (False, True):
        estimator, angles = PoseEstimator(FitConfig(temporal=temporal)), ContinuousAngles()
        for frame in range(2 if temporal else 1):
            assert nothing_confident(angles.follow(estimator.estimate(hull), frame * 40_000_000))
    assert time.process_time() - start < 60  # about 0.2 s, a post 3 s


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_engine(name):
    start = time.process_time()
    assert nothing_confident(PoseEstimator(FitConfig(engine="paper")).estimate(hull_of(SHAPES[name])))
    assert time.process_time() - start < 60


def test_an_empty_hull():
    empty = Hull(VOXEL, (0, 0, 0), np.full((5, 5, 5), BAND, np.float32), BAND)
    for engine in ("robust", "paper"):
        assert isinstance(PoseEstimator(FitConfig(engine=engine)).estimate(empty), NoPerson)


@pytest.mark.parametrize("name", SHAPES)
def test_surface_and_geodesic_distances_are_finite(name):
    hull = hull_of(SHAPES[name])
    surface = extract_surface(hull)
    for values in (surface.points, surface.normals, surface.curvature, geodesic_map(hull, surface)):
        assert np.isfinite(values).all()


def masks_of(kind, rig):
    made = {}
    for camera in rig.cameras:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        if kind == "white":
            mask[:] = 255
        elif kind == "one pixel":
            mask[60, 80] = 255
        elif kind == "half":
            mask[30:, 20:140] = 255
        made[camera.name] = mask
    return made


@pytest.mark.parametrize("kind", ["black", "white", "one pixel", "half"])
def test_masks_of_nobody_are_carved_to_nothing_or_to_finite_numbers(kind):
    rig = default_rig(3, 160, 120)
    start = time.process_time()
    hull = Carver(rig, HullConfig(voxel_m=0.03)).carve(masks_of(kind, rig))
    assert time.process_time() - start < 60
    if isinstance(hull, Hull):
        assert np.isfinite(hull.sdf).all()
        assert nothing_confident(PoseEstimator().estimate(hull))


def finite_message(value):
    """Whether every float in a message is finite."""
    if isinstance(value, float):
        return np.isfinite(value)
    if hasattr(value, "get_fields_and_field_types"):
        return all(finite_message(getattr(value, field)) for field in value.get_fields_and_field_types())
    if isinstance(value, (list, tuple)) or type(value).__name__ in ("array", "ndarray"):
        return all(finite_message(item) for item in value) if not _floats(value) else bool(np.isfinite(value).all())
    return True


def _floats(value):
    return getattr(value, "typecode", "") in ("d", "f")


def test_no_nan_leaves_the_node():
    """Also not when the node is told to publish what it does not believe itself."""
    graph = Graph()
    try:
        node = graph.add(PoseNode, publish_unreliable=True, fit__temporal=True)
        clouds = graph.publisher(PointCloud2, topics.HULL, topics.WORK_QOS)
        seen = [
            graph.collect(kind, topic, qos)
            for kind, topic, qos in (
                (PoseArray, topics.JOINTS, topics.STREAM_QOS),
                (JointState, topics.JOINT_ANGLES, topics.STREAM_QOS),
                (MarkerArray, topics.MARKERS, topics.STREAM_QOS),
                (JointState, topics.body_joint_states("p1"), topics.STREAM_QOS),
                (String, topics.body_urdf("p1"), topics.LATCHED_QOS),
            )
        ]
        surface = graph.collect(PointCloud2, topics.SURFACE)
        graph.until(lambda: node.surface.get_subscription_count() > 0 and node.markers.get_subscription_count() > 0)
        shapes = ("one voxel", "a plane", "noise", "a round post")
        for number, name in enumerate(shapes, 1):
            cloud = hull_to_cloud(hull_of(SHAPES[name]), messages.make_header(number * 100_000_000, "room"))
            clouds.publish(cloud)
            graph.until(lambda number=number: len(seen[0]) == number and len(surface) == number)
        assert seen[0][-1].poses, "the post is given a posture, or this test shows nothing"
        graph.until(lambda: len(seen[1]) > 0 and len(seen[3]) > 0 and len(seen[4]) > 0)
        assert all(finite_message(msg) for messages_of_one in seen for msg in messages_of_one)
        assert "nan" not in seen[4][-1].data
        for msg in surface:
            assert np.isfinite(np.frombuffer(msg.data, np.float32)).all()
    finally:
        graph.close()
