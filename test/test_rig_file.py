# SPDX-License-Identifier: Apache-2.0
"""The rig file: what it says, what it refuses and in which words."""

import copy
import json
import re
import subprocess
import sys

import numpy as np
import pytest
import yaml

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.rig_file import load_rig, rig_from_mapping, save_rig
from limbloc_ros.simulation.room import default_rig

#: A camera 2 m in front of the origin at 1 m height, looking back along -x: optical z = -x, x = y, y = -z.
T_WORLD_CAMERA = [[0.0, 0.0, -1.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]

GOOD = {
    "version": 1,
    "units": "m",
    "volume": {"min": [-1.0, -1.5, 0.0], "max": [1.0, 1.5, 2.5]},
    "cameras": [
        {
            "name": "front",
            "width": 640,
            "height": 480,
            "K": [[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]],
            "distortion_model": "plumb_bob",
            "distortion": [0.1, -0.05, 0.001, -0.002, 0.0],
            "T_world_camera": T_WORLD_CAMERA,
        },
        {
            "name": "back",
            "width": 320,
            "height": 240,
            "K": [250, 0, 159.5, 0, 250, 119.5, 0, 0, 1],
            "T_world_camera": {"translation": [-2.0, 0.0, 1.0], "quaternion": [0.5, -0.5, 0.5, -0.5]},
        },
    ],
}


def write(tmp_path, data, name="rig.yaml"):
    path = tmp_path / name
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


def test_our_yaml_is_read_as_written(tmp_path):
    rig = load_rig(write(tmp_path, GOOD))
    assert rig.names == ("front", "back")
    front, back = rig.cameras
    assert (front.width, front.height, front.distortion_model) == (640, 480, "radtan")
    np.testing.assert_array_equal(front.T_world_camera, T_WORLD_CAMERA)
    np.testing.assert_array_equal(back.K, [[250, 0, 159.5], [0, 250, 119.5], [0, 0, 1]])
    assert back.distortion_model == "none"
    np.testing.assert_array_equal(rig.volume_max, [1.0, 1.5, 2.5])
    # Worked by hand: the quaternion turns the optical axis z to +x and the image's down axis y to -z.
    np.testing.assert_allclose(back.T_world_camera[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(back.T_world_camera[:3, :3] @ [0, 1, 0], [0, 0, -1], atol=1e-12)


def test_cameras_see_the_origin_where_they_should(tmp_path):
    rig = load_rig(write(tmp_path, GOOD))
    uv, depth = rig.camera("back").world_to_image([0.0, 0.5, 1.2])  # to the left of the axis, 0.2 m above it
    np.testing.assert_allclose(uv, [159.5 - 250 * 0.5 / 2.0, 119.5 - 250 * 0.2 / 2.0])
    assert depth == pytest.approx(2.0)


def test_saving_and_loading_keeps_every_bit(tmp_path):
    rng = np.random.default_rng(3)
    cameras = []
    for i, (model, count) in enumerate([("none", 0), ("radtan", 5), ("rational", 8), ("fisheye", 4)]):
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        q = q * np.sign(np.diag(r))
        q[:, 0] *= np.linalg.det(q)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = q, rng.normal(size=3)
        K = [[rng.uniform(300, 900), 0, 320.1], [0, rng.uniform(300, 900), 240.7], [0, 0, 1]]
        cameras.append(Camera(f"cam: {i}", 640, 480, K, T, rng.normal(size=count) * 0.01, model))
    rig = Rig(tuple(cameras), rng.uniform(-2, -1, 3), rng.uniform(1, 2, 3))
    save_rig(rig, tmp_path / "rig.yaml")
    again = load_rig(tmp_path / "rig.yaml")
    assert again.names == rig.names
    for a, b in zip(again.cameras, rig.cameras, strict=True):
        assert (a.width, a.height, a.distortion_model) == (b.width, b.height, b.distortion_model)
        for name in ("K", "T_world_camera", "distortion"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(again.volume_min, rig.volume_min)
    np.testing.assert_array_equal(again.volume_max, rig.volume_max)


def test_benchmark_calibration_is_world_to_camera(tmp_path):
    calib = {
        "world": "z up, metres",
        "cameras": [
            {
                "name": "cam0",
                "width": 640,
                "height": 480,
                "K": GOOD["cameras"][0]["K"],
                "dist": [0.1, 0.01, 0, 0, 0],
                "R": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
                "t": [0.0, 1.0, 2.0],
            }
        ],
    }
    rig = load_rig(write(tmp_path, json.dumps(calib), "calib.json"))
    camera = rig.cameras[0]
    np.testing.assert_allclose(camera.T_world_camera, T_WORLD_CAMERA, atol=1e-12)  # x_cam = R X + t
    assert camera.distortion_model == "radtan"
    calib["cameras"][0]["dist"] = [0, 0, 0, 0, 0]
    assert load_rig(write(tmp_path, json.dumps(calib), "calib.json")).cameras[0].distortion_model == "none"


def test_without_a_volume_it_is_where_the_cameras_look():
    data = copy.deepcopy(GOOD)
    del data["volume"]
    rig = rig_from_mapping(data)
    assert rig.volume_min[2] == 0.0
    assert 2.4 <= rig.volume_max[2] <= 2.8
    centre = (rig.volume_min + rig.volume_max)[:2] / 2
    assert np.abs(centre).max() < 0.7  # the two cameras face each other across the origin
    size = (rig.volume_max - rig.volume_min)[:2]
    assert (size > 1.0).all()
    assert (size < 5.0).all()


def change(**camera):
    """The good file with the first camera's keys replaced (None: taken away)."""
    data = copy.deepcopy(GOOD)
    for key, value in camera.items():
        if value is None:
            del data["cameras"][0][key]
        else:
            data["cameras"][0][key] = value
    return data


def top(**keys):
    return {**copy.deepcopy(GOOD), **keys}


BROKEN = {
    "nothing": ("", r"expected keys version, units, volume, cameras, got nothing"),
    "a list": ([1, 2], r"expected keys .*, got \[1, 2\]"),
    "syntax": ("version: 1\ncameras:\n  - name: [cam0\n    width: 3\n", r"line [34]: not valid YAML"),
    "tab": ("version: 1\n\tcameras: 2\n", r"line 2: not valid YAML"),
    "python object": ("cameras: !!python/object/apply:os.getcwd []\n", r"line 1: not valid YAML"),
    "no cameras": ({"version": 1}, r"key cameras: expected a list of at least one camera, got nothing"),
    "empty cameras": (top(cameras=[]), r"key cameras: expected a list of at least one camera, got \[\]"),
    "camera by name": (top(cameras=["cam0"]), r"cameras\[0\]: expected a camera with name.*, got 'cam0'"),
    "version missing": ({"cameras": GOOD["cameras"]}, r"key version: expected 1, got nothing"),
    "version from the future": (top(version=2), r"key version: expected 1, got 2"),
    "millimetres": (top(units="mm"), r"key units: expected m \(metres\), got 'mm'"),
    "misspelt top key": (top(volumes={}), r"unknown key 'volumes'; expected version, units, volume, cameras"),
    "volume a number": (top(volume=3), r"key volume: expected min and max corners, got 3"),
    "volume without max": (top(volume={"min": [0, 0, 0]}), r"key volume: key max is missing; it has min"),
    "volume of two numbers": (top(volume={"min": [0, 0], "max": [1, 1, 1]}), r"volume\.min: expected 3 numbers, got 2"),
    "volume turned over": (top(volume={"min": [1, 1, 1], "max": [0, 0, 0]}), r"carve volume must be 0\.1 to 100 m"),
    "volume in millimetres": (top(volume={"min": [0, 0, 0], "max": [3000, 3000, 2400]}), r"are the units metres\?"),
    "no name": (change(name=None), r"cameras\[0\]: key name is missing; it has .*width"),
    "number as name": (change(name=7), r"cameras\[0\]: key name: expected text such as cam0, got 7"),
    "same name twice": (change(name="back"), r"camera names must be unique, got back, back"),
    "misspelt camera key": (change(widht=640), r"cameras\[0\] \(front\): unknown key 'widht'; expected name, width"),
    "no width": (change(width=None), r"cameras\[0\] \(front\): key width is missing"),
    "width as text": (change(width="640"), r"key width: expected a whole number of pixels, got '640'"),
    "negative height": (change(height=-480), r"image size must be positive, got 640x-480"),
    "no K": (change(K=None), r"cameras\[0\] \(front\): key K is missing"),
    "K of four numbers": (change(K=[1, 2, 3, 4]), r"key K: expected 3x3 numbers, got 4"),
    "K with text": (change(K=[["f", 0, 0], [0, 1, 0], [0, 0, 1]]), r"key K: expected 3x3 numbers, got \[\['f'"),
    "K ragged": (change(K=[[1, 0], [0, 1, 0], [0, 0, 1]]), r"key K: expected 3x3 numbers, got \[\[1, 0\]"),
    "K transposed": (change(K=[[500, 0, 0], [0, 500, 0], [320, 240, 1]]), r"key K: expected the last row 0 0 1"),
    "K all zero": (change(K=[0] * 9), r"front: K has focal lengths 0, 0 px.*run camera_calibration"),
    "K not finite": (change(K=[float("nan")] * 9), r"key K: expected finite numbers, got \[nan"),
    "unknown model": (change(distortion_model="brown"), r"key distortion_model: expected one of none, radtan.*'brown'"),
    "wrong count": (change(distortion=[0.1, 0.2]), r"radtan distortion takes 4 or 5 coefficients, got 2"),
    "no pose": (change(T_world_camera=None), r"cameras\[0\] \(front\): key T_world_camera is missing"),
    "pose of 3x4": (change(T_world_camera=T_WORLD_CAMERA[:3]), r"key T_world_camera: expected 4x4 numbers, got 3x4"),
    "pose transposed": (
        change(T_world_camera=np.transpose(T_WORLD_CAMERA).tolist()),
        r"key T_world_camera: expected the last row 0 0 0 1, got \[2\.0, 0\.0, 1\.0, 1\.0\]; is the matrix transposed",
    ),
    "not a rotation": (change(T_world_camera=np.diag([2, 2, 2, 1]).tolist()), r"rows are 2\.000, 2\.0.* rig import"),
    "mirrored": (change(T_world_camera=np.diag([-1, 1, 1, 1]).tolist()), r"determinant is -1\.000 .*left-handed"),
    "quaternion too long": (
        change(T_world_camera={"translation": [0, 0, 0], "quaternion": [1, 1, 1, 1]}),
        r"T_world_camera\.quaternion: expected x y z w of length 1, got \[1\.0, 1\.0, 1\.0, 1\.0\] of length 2",
    ),
    "no translation": (change(T_world_camera={"quaternion": [0, 0, 0, 1]}), r"key translation is missing"),
    "euler angles": (change(T_world_camera={"rpy": [0, 0, 0]}), r"unknown key 'rpy'; expected translation, quaternion"),
}


@pytest.mark.parametrize(("content", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_file_says_what_is_wrong(tmp_path, content, message):
    path = write(tmp_path, content)
    with pytest.raises(RigError) as caught:
        load_rig(path)
    assert re.search(message, str(caught.value)), str(caught.value)
    assert str(path) in str(caught.value)


def test_broken_json_names_the_line(tmp_path):
    with pytest.raises(RigError, match=r"line 2: not valid JSON"):
        load_rig(write(tmp_path, '{"cameras": [\n oops]}', "calib.json"))


def test_missing_file_folder_and_binary(tmp_path):
    with pytest.raises(RigError, match=r"nowhere\.yaml does not exist"):
        load_rig(tmp_path / "nowhere.yaml")
    with pytest.raises(RigError, match="expected a file, this is a folder"):
        load_rig(tmp_path)
    (tmp_path / "rig.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match="expected UTF-8 text"):
        load_rig(tmp_path / "rig.yaml")


FULL_DISK = """
import resource, signal, sys
from limbloc_ros.core.errors import OutputError
from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.simulation.room import default_rig
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200))
try:
    save_rig(default_rig(8), sys.argv[1])
except OutputError as error:
    print(error)
"""


def test_a_full_disk_leaves_the_old_calibration_untouched(tmp_path):
    path = tmp_path / "rig.yaml"
    save_rig(default_rig(3), path)
    before = path.read_bytes()
    done = subprocess.run([sys.executable, "-c", FULL_DISK, str(path)], capture_output=True, text=True, check=True)
    assert "cannot be written: File too large" in done.stdout
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]  # nor is half a file left beside it
