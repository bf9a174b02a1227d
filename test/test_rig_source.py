# SPDX-License-Identifier: Apache-2.0
"""A rig from CameraInfo and TF, over real DDS with the real message.

tf2_msgs has no wheel; where there is a C++ compiler, tools/build_tf2_msgs.py builds it for these tests. Elsewhere they
see that the node says what is missing.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from ros_graph import Graph
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.nodes.carving import CarvingNode
from limbloc_ros.ros import topics
from limbloc_ros.ros.cloud_messages import cloud_to_hull
from limbloc_ros.ros.image_messages import camera_to_info, mask_to_compressed
from limbloc_ros.ros.messages import make_header, transform_to_message
from limbloc_ros.ros.transforms import TransformListener, TransformOutput, import_tf_message
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

TOOL = Path(__file__).parents[1] / "tools" / "build_tf2_msgs.py"
T0_NS = 1_000_000_000_000
COMPILER = shutil.which("g++") is not None and (Path(sysconfig.get_path("include")) / "Python.h").exists()
VOLUME = {"volume_min": [-1.5, -1.5, 0.0], "volume_max": [1.5, 1.5, 2.4]}


@pytest.fixture(scope="module")
def message(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The class TFMessage, or None where it can neither be imported nor be built."""
    folder = ""
    if import_tf_message() is None and COMPILER:
        folder = str(tmp_path_factory.mktemp("tf"))
        subprocess.run([sys.executable, str(TOOL), folder], check=True)
        sys.path.insert(0, folder)
    yield import_tf_message()
    if folder:  # other test files shall find what they would find without this one
        sys.path.remove(folder)
        for name in [name for name in sys.modules if name.split(".")[0] == "tf2_msgs"]:
            del sys.modules[name]


def test_a_build_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    """`make setup` goes on without TF then; half a package would break every node."""
    compiler = tmp_path / "bin" / "gcc"
    compiler.parent.mkdir()
    compiler.write_text("#!/bin/sh\nexit 1\n")
    compiler.chmod(0o755)
    where = tmp_path / "packages"
    path = {**os.environ, "PATH": f"{compiler.parent}:/nowhere"}
    run = subprocess.run([sys.executable, str(TOOL), str(where)], env=path, capture_output=True, text=True)
    assert run.returncode == 1
    assert run.stderr.splitlines()[-1].startswith("build_tf2_msgs: g")
    assert list(where.iterdir()) == []
    setup = (TOOL.parent / "setup_venv.sh").read_text()
    assert re.search(r"^if built=.*build_tf2_msgs\.py 2>&1\); then$", setup, re.MULTILINE)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_rig(4, 160, 120)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """A pose shifted, and turned about z by degrees."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def transform(parent: str, child: str, T_parent_child: np.ndarray) -> TransformStamped:
    return transform_to_message(T_parent_child, child, make_header(0, parent))


def tell(graph: Graph, camera: Camera, **changes: Any) -> None:
    """Publish a camera's CameraInfo."""
    info = camera_to_info(camera, make_header(T0_NS, topics.optical_frame(camera.name)))
    for name, value in changes.items():
        setattr(info, name, value)
    graph.publisher(CameraInfo, topics.camera_info(camera.name)).publish(info)


def says_what_is_missing(graph: Graph) -> None:
    with pytest.raises(RigError, match=r"tf2-msgs, or without an apt ROS run tools/build_tf2_msgs\.py"):
        graph.add(CarvingNode, cameras=["cam0", "cam1"])


def test_without_the_message_the_error_says_what_to_do(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)
    says_what_is_missing(graph)


def test_transforms_are_heard_from_all_who_tell_of_them(graph: Graph, message: Any) -> None:
    """One tells once before anybody listens, as static_transform_publisher does; another; and one that moves."""
    if message is None:
        says_what_is_missing(graph)
        return
    first = TransformOutput(graph.add(lambda **options: Node("first", **options)), static=True)
    first.send([transform("room", "ceiling", pose(z=3.0))])
    first.send([transform("ceiling", "rail", pose(x=1.0))])  # both are kept for late joiners
    second = TransformOutput(graph.tester, static=True)
    second.send([transform("rail", "cam0", pose(y=0.5, turn=90.0))])
    moves = TransformOutput(graph.tester)
    assert (moves.wanted, second.wanted) == (False, True)  # nobody listens yet: what never moves is kept for them
    heard = TransformListener(graph.add(lambda **options: Node("listener", **options)))
    graph.until(lambda: moves.wanted)

    def known() -> bool:
        try:
            heard.find("room", "cam0")
        except RigError:
            return False
        return True

    graph.until(known)
    np.testing.assert_allclose(heard.find("room", "cam0"), pose(1.0, 0.5, 3.0, 90.0), atol=1e-12)
    moving = graph.publisher(message, "/tf")
    moving.publish(message(transforms=[transform("room", "ceiling", pose(z=2.5))]))
    graph.until(lambda: heard.find("room", "cam0")[2, 3] == 2.5)
    wrong = transform("room", "cam9", pose())
    wrong.transform.rotation.w = 0.0
    moving.publish(message(transforms=[wrong]))
    graph.until(lambda: "cam9" in heard.problems)
    with pytest.raises(RigError, match=r"nobody publishes a frame 'cam9'; there is .*quaternion of length 1"):
        heard.find("room", "cam9")


def test_a_rig_from_camera_info_and_tf(graph: Graph, message: Any, rig: Rig) -> None:
    if message is None:
        says_what_is_missing(graph)
        return
    node = graph.add(CarvingNode, cameras=list(rig.names), **VOLUME)
    diagnostics = graph.diagnostics()
    graph.until(diagnostics.says("carving: hull", "no rig yet", "no CameraInfo on cam3/camera_info"))
    for camera in rig.cameras:
        tell(graph, camera)
    graph.until(
        diagnostics.says(
            "carving: hull", "TF has no transform from room to 'cam0_optical' yet: nobody publishes a frame 'room'"
        )
    )
    # As from a calibration in the frame of the first camera, which is then placed in the room.
    T_room_cam0 = rig.cameras[0].T_world_camera
    TransformOutput(graph.tester, static=True).send(
        [transform("room", "cam0_optical", T_room_cam0)]
        + [
            transform("cam0_optical", topics.optical_frame(c.name), np.linalg.solve(T_room_cam0, c.T_world_camera))
            for c in rig.cameras[1:]
        ]
    )
    graph.until(lambda: node.rig is not None)
    for camera in rig.cameras:
        np.testing.assert_allclose(node.rig.camera(camera.name).T_world_camera, camera.T_world_camera, atol=1e-12)
    room = SimulatedRoom(rig, empty_s=0.0)
    person = {name: room.render_with_mask(name, 1.0)[1] for name in rig.names}
    hulls: list[PointCloud2] = graph.collect(PointCloud2, "hull")
    masks = {name: graph.publisher(CompressedImage, topics.mask_compressed(name)) for name in rig.names}
    graph.until(lambda: graph.tester.count_publishers("hull") > 0)
    graph.spin(0.1)
    for name, mask in person.items():
        masks[name].publish(mask_to_compressed(mask, make_header(T0_NS, topics.optical_frame(name))))
    graph.until(lambda: len(hulls) == 1)
    hull, expected = cloud_to_hull(hulls[0]), Carver(rig).carve(person)
    assert hull is not None
    assert isinstance(expected, Hull)
    # A quaternion does not carry a rotation to the last bit.
    assert hull.inside_count == pytest.approx(expected.inside_count, rel=1e-3)


def test_an_all_zero_k_is_explained(graph: Graph, message: Any, rig: Rig) -> None:
    if message is None:
        says_what_is_missing(graph)
        return
    graph.add(CarvingNode, cameras=["cam0", "cam1"])
    diagnostics = graph.diagnostics()
    TransformOutput(graph.tester, static=True).send(
        [transform("room", topics.optical_frame(c.name), c.T_world_camera) for c in rig.cameras]
    )
    tell(graph, rig.cameras[0])
    tell(graph, rig.cameras[1], k=np.zeros(9))
    graph.until(diagnostics.says("carving: camera cam1", "all-zero K", "camera_calibration"))
