# SPDX-License-Identifier: Apache-2.0
"""Importers on the tools' own files (see data/rigs/README.md), exporters by reading back, and what is asked."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from limbloc_ros import cli
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.recordings.bags import TYPESTORE, BagWriter
from limbloc_ros.rig.formats import FORMATS, recognise
from limbloc_ros.rig.formats.common import CAMERA_TO_WORLD, WORLD_TO_CAMERA
from limbloc_ros.rig.formats.ros import read_transforms, with_poses
from limbloc_ros.rig.geometry import inverse, rotation_between, where_they_look
from limbloc_ros.rig.importing import Wishes, resized, settle
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.simulation.room import default_rig

RIGS = Path(__file__).parent / "data" / "rigs"


def imported(*names, **wishes):
    paths = [RIGS / name for name in names]
    return settle(recognise(paths).read(paths), Wishes(**wishes))


def centre(camera):
    return camera.T_world_camera[:3, 3]


def test_qualisys_against_numbers_worked_out_elsewhere():
    """R and t of cam01 as the benchmark's maintainers converted them (x_cam = R X + t, metres)."""
    rig, said = imported("qualisys.qca.txt")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    cam01 = rig.camera("cam01")
    np.testing.assert_allclose(cam01.T_camera_world[:3, 3], [0.32110489, 0.95633206, 2.89071305], atol=1e-7)
    np.testing.assert_allclose(cam01.T_camera_world[2, :3], [-0.71040026, 0.59073422, -0.38257621], atol=1e-7)
    assert (cam01.width, cam01.height) == (1088, 1920)
    np.testing.assert_allclose(cam01.K[0], [107599.671875 / 64, 0, 34110.316406 / 64])
    assert cam01.distortion.tolist() == [-0.046183, 0.139983, 0.000608, 0.00069, 0.0]
    assert any("mm, as the format documents" in line for line in said)


def test_two_tools_measured_the_same_cameras():
    """Pose2Sim's scene points and Qualisys' wand, independently: same places within a hand's breadth, same gaze."""
    qualisys, _ = imported("qualisys.qca.txt")
    scene, said = imported("pose2sim_Calib_scene.toml", names={f"int_cam0{i}_img": f"cam0{i}" for i in (1, 2, 3, 4)})
    assert scene.names == qualisys.names
    for a, b in zip(qualisys.cameras, scene.cameras, strict=True):
        assert np.linalg.norm(centre(a) - centre(b)) < 0.15
        turn = Rotation.from_matrix(a.T_world_camera[:3, :3].T @ b.T_world_camera[:3, :3])
        assert np.degrees(turn.magnitude()) < 4
    assert any("metres are plausible" in line for line in said)


def test_the_benchmarks_direction_is_told_as_it_stands_in_the_file(tmp_path):
    """calib.json has x_cam = R X + t, and whoever overrules that must find the file's own numbers turned round."""
    rig = default_rig(4)
    FORMATS["benchmark"].write(rig, tmp_path / "calib.json")
    reading = FORMATS["benchmark"].read([tmp_path / "calib.json"])
    assert reading.direction == WORLD_TO_CAMERA
    np.testing.assert_allclose(reading.cameras[0].T, rig.cameras[0].T_camera_world, atol=1e-12)
    _, said = settle(reading, Wishes())
    assert any(line.startswith("direction: world-to-camera, as the format documents") for line in said)


def test_aniposelib_asks_for_unit_and_up():
    with pytest.raises(RigError, match=r"unit of length is not written.*--unit mm: the cameras stand 0\.42 m to 0\.53"):
        imported("aniposelib_calibration.toml")
    with pytest.raises(RigError, match=r"expected 0\.7 to 20\.0 m|which way is up"):
        imported("aniposelib_calibration.toml", unit="mm")
    rig, said = imported("aniposelib_calibration.toml", unit="mm", up="-y", camera_heights={"A": 1.2})
    assert [c.distortion_model for c in rig.cameras] == ["fisheye"] * 3
    assert centre(rig.camera("A"))[2] == pytest.approx(1.2)
    assert any(line.startswith("warning") and "no room has" in line for line in said)  # a table-top rig of 0.5 m


def test_caliscope_lacks_the_floor():
    with pytest.raises(RigError, match=r"camera cam_2 would stand at -0\.10 m.*--camera-height cam_2=METRES"):
        imported("caliscope_camera_array.toml")
    rig, _ = imported("caliscope_camera_array.toml", floor_m=-0.75)
    assert rig.names == ("cam_0", "cam_1", "cam_2")
    assert all(0.5 < centre(c)[2] < 1.5 for c in rig.cameras)


def test_multical_pair():
    """The second camera of its example stands 5 cm to the right of the first: x_cam2 = R x_cam1 + T, T = -0.05."""
    wishes = {"unit": "m", "up": "-y", "camera_heights": {"cam1": 1.5}}
    rig, said = imported("multical_calibration.json", **wishes)
    one, two = rig.cameras
    right = one.T_world_camera[:3, 0]
    assert (centre(two) - centre(one)) @ right == pytest.approx(0.05)
    assert any("nothing confirms it" in line for line in said)
    assert one.distortion.tolist() == [-0.12, 0.32, 0, 0, -0.2]


def test_kalibr_chain_worked_by_hand():
    """Each camera turns by 90 degrees about the same place 2 m in front: the third looks back at the first."""
    with pytest.raises(RigError, match=r"its world is its first camera.*--camera-height cam0=METRES"):
        imported("kalibr_camchain.yaml")
    rig, _ = imported("kalibr_camchain.yaml", up="cameras", camera_heights={"cam0": 1.4})
    centres = np.array([centre(c) for c in rig.cameras])
    np.testing.assert_allclose(centres[:, 2], 1.4)
    np.testing.assert_allclose(np.linalg.norm(centres[:, :2], axis=1), 2.0)  # the origin is what they look at
    np.testing.assert_allclose(centres[0, :2], -centres[2, :2], atol=1e-8)
    assert [c.distortion_model for c in rig.cameras] == ["radtan", "fisheye", "none"]
    assert rig.cameras[1].K[1].tolist() == [0, 462, 239]


def test_kalibr_own_file_agrees_with_its_inertial_unit():
    """Each camera's pose against the inertial unit, in the same file, gives the pair's pose without T_cn_cnm1."""
    rig, said = imported("kalibr_euroc_camchain.yaml", up="cameras", camera_heights={"cam0": 1.2})
    one, two = rig.cameras
    chain = yaml.safe_load((RIGS / "kalibr_euroc_camchain.yaml").read_text())
    expected = np.array(chain["cam0"]["T_cam_imu"]) @ inverse(np.array(chain["cam1"]["T_cam_imu"]))
    np.testing.assert_allclose(inverse(one.T_world_camera) @ two.T_world_camera, expected, atol=1e-4)
    assert (centre(two) - centre(one)) @ one.T_world_camera[:3, 0] == pytest.approx(0.110, abs=5e-4)  # EuRoC's baseline
    assert [c.distortion_model for c in rig.cameras] == ["fisheye", "fisheye"]
    assert (one.width, one.height) == (752, 480)
    assert any("the cameras look the same way: nothing confirms it" in line for line in said)  # a stereo pair
    assert any("below the cameras" in line for line in said)


def test_easymocap_users_file_as_opencv_reads_it():
    """EasyMocap reads with OpenCV's FileStorage, and takes x_cam = R X + T: the same pixels, from R instead of Rot."""
    folder = RIGS / "easymocap_mirrored"
    rig, said = imported("easymocap_mirrored", sizes={"": (1920, 1080)})
    assert rig.names == ("2", "3", "4", "5", "6", "7")
    assert any("all cameras look at one place" in line for line in said)
    assert any("metres are plausible" in line for line in said)
    files = [cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_READ) for name in ("intri.yml", "extri.yml")]
    points = np.array([[0.1, -0.2, 0.9], [-0.4, 0.3, 1.7]])
    for camera in rig.cameras:
        K, dist = (files[0].getNode(f"{key}_{camera.name}").mat() for key in ("K", "dist"))
        R, T = (files[1].getNode(f"{key}_{camera.name}").mat() for key in ("R", "T"))
        expected = cv2.projectPoints(points, R, T, K, dist)[0][:, 0]
        np.testing.assert_allclose(camera.world_to_image(points)[0], expected, atol=1e-6)
        assert 1.0 < centre(camera)[2] < 2.0


def test_easymocap_worked_by_hand():
    """Camera 1 stands 4 m to the south (-y) of the origin, camera 2 3 m to the west, both looking at it."""
    with pytest.raises(RigError, match="--size 1=WIDTHxHEIGHT"):
        imported("easymocap")
    rig, _ = imported("easymocap", sizes={"": (1920, 1080)})
    one, two = rig.cameras
    np.testing.assert_allclose(centre(one), [0, -4, 1.5], atol=1e-9)
    np.testing.assert_allclose(centre(two), [-3, 0, 1.2], atol=1e-9)
    np.testing.assert_allclose(two.T_world_camera[:3, 2], [1, 0, 0], atol=1e-9)
    assert one.distortion.size == 5
    assert two.distortion_model == "none"


def test_ros_intrinsics_and_poses_from_tf():
    reading = recognise([RIGS / "ros_ost.yaml"]).read([RIGS / "ros_ost.yaml"])
    assert reading.cameras[0].name == "08144361026320a0"
    with pytest.raises(RigError, match="intrinsics only"):
        settle(reading, Wishes())
    transforms = read_transforms(RIGS / "tf_static.yaml")
    frames = {"08144361026320a0": "front_optical_frame"}
    rig, _ = settle(with_poses(reading, transforms, frames, None, False), Wishes())
    camera = rig.cameras[0]
    np.testing.assert_allclose(centre(camera), [2, 0, 1.6], atol=1e-12)
    np.testing.assert_allclose(camera.T_world_camera[:3, 2], [-1, 0, 0], atol=1e-12)  # looks back at the origin
    np.testing.assert_allclose(camera.T_world_camera[:3, 1], [0, 0, -1], atol=1e-12)  # image down = world down
    named = replace(reading, cameras=(replace(reading.cameras[0], name="front"),))
    body, _ = settle(with_poses(named, transforms, {}, "room", True), Wishes())
    np.testing.assert_allclose(body.cameras[0].T_world_camera, camera.T_world_camera, atol=1e-12)
    with pytest.raises(RigError, match=r"camera 08144361026320a0: its frame: none among front_link"):
        with_poses(reading, transforms, {}, None, False)
    with pytest.raises(RigError, match="--world-frame map: the transforms have only"):
        with_poses(reading, transforms, frames, "map", False)


def test_static_transform_publisher_lines(tmp_path):
    lines = tmp_path / "tf.txt"
    lines.write_text(
        "ros2 run tf2_ros static_transform_publisher 1 2 3 1.5707963267948966 0 0 room a_link\n"
        "ros2 run tf2_ros static_transform_publisher --x 1 --y 2 --z 3 --yaw 1.5707963267948966 "
        "--frame-id room --child-frame-id b_link\n"
        "rosrun tf static_transform_publisher 1 2 3 0 0 0.7071067811865476 0.7071067811865476 /room /c_link\n"
        "ros2 run tf2_ros static_transform_publisher --x 1 --y 2 --z 3 --qz 0.7071067811865476 --qw 0.7071067811865476 "
        "--frame-id room --child-frame-id d_link\n"
    )
    found = read_transforms(lines)
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    for child in "abcd":
        np.testing.assert_allclose(found["room", f"{child}_link"], expected, atol=1e-12)


def toml_of(poses, tmp_path):
    """A TOML of cameras that stand like these T_world_camera, written world-to-camera."""
    lines = []
    for i, T in enumerate(poses):
        inverted = inverse(T)
        lines += [
            f"[cam_{i}]",
            "size = [640, 480]",
            "matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]",
            "distortions = [0.0, 0.0, 0.0, 0.0, 0.0]",
            f"rotation = {Rotation.from_matrix(inverted[:3, :3]).as_rotvec().tolist()}",
            f"translation = {inverted[:3, 3].tolist()}",
        ]
    path = tmp_path / "Calib.toml"
    path.write_text("\n".join(lines))
    return FORMATS["anipose"].read([path])


def test_the_wrong_direction_is_noticed(tmp_path):
    poses = [c.T_world_camera for c in default_rig(6).cameras]
    reading = toml_of([inverse(T) for T in poses], tmp_path)
    with pytest.raises(RigError, match=rf"read as {WORLD_TO_CAMERA}.* Say --direction"):
        settle(reading, Wishes())
    rig, said = settle(reading, Wishes(direction=CAMERA_TO_WORLD))
    np.testing.assert_allclose([c.T_world_camera for c in rig.cameras], poses, atol=1e-9)
    assert any("as you said" in line for line in said)


def test_a_flipped_world_is_noticed(tmp_path):
    flip = np.diag([1.0, -1, -1, 1])
    poses = [flip @ c.T_world_camera for c in default_rig(6).cameras]
    with pytest.raises(RigError, match="the images' own up points along the file's -z"):
        settle(toml_of(poses, tmp_path), Wishes())
    rig, _ = settle(toml_of(poses, tmp_path), Wishes(up="-z"))
    assert all(centre(c)[2] > 1 for c in rig.cameras)


def test_y_up_is_turned_to_z_up(tmp_path):
    turn = np.eye(4)
    turn[:3, :3] = rotation_between(np.array([0.0, 0, 1]), np.array([0.0, 1, 0]))
    poses = [c.T_world_camera for c in default_rig(6).cameras]
    rig, _ = settle(toml_of([turn @ T for T in poses], tmp_path), Wishes(up="y"))
    np.testing.assert_allclose([c.T_world_camera for c in rig.cameras], poses, atol=1e-9)


def test_the_wrong_unit_is_noticed(tmp_path):
    poses = [c.T_world_camera.copy() for c in default_rig(6).cameras]
    for T in poses:
        T[:3, 3] *= 1000
    with pytest.raises(RigError, match=r"--unit mm: the cameras stand 2\.7"):
        settle(toml_of(poses, tmp_path), Wishes())
    rig, _ = settle(toml_of(poses, tmp_path), Wishes(unit="mm"))
    assert np.linalg.norm(centre(rig.cameras[0])[:2]) == pytest.approx(2.75)
    with pytest.raises(RigError, match="which no room has"):  # where the format does document its unit
        settle(replace(toml_of(poses, tmp_path), unit_m=1.0), Wishes())


def test_a_left_handed_rotation_is_refused(tmp_path):
    reading = toml_of([c.T_world_camera for c in default_rig(4).cameras], tmp_path)
    mirrored = reading.cameras[0].T @ np.diag([-1.0, 1, 1, 1])
    bad = replace(reading, cameras=(replace(reading.cameras[0], T=mirrored), *reading.cameras[1:]))
    with pytest.raises(RigError, match=r"determinant -1\.000"):
        settle(bad, Wishes())


@pytest.mark.parametrize("fit", ["letterbox", "crop", "stretch"])
def test_rescaled_images_show_the_same_places(fit):
    """What lay at a fraction of the calibrated image lies where the scaled image has it; pixel centres are integers."""
    camera = default_rig(4, 640, 480).cameras[0]
    small = resized(camera, (320, 200), fit)
    point = camera.T_world_camera[:3, :3] @ [0.2, -0.1, 2.0] + centre(camera)
    before, after = (c.world_to_image(point)[0] + 0.5 for c in (camera, small))
    scale = {"letterbox": (200 / 480,) * 2, "crop": (0.5, 0.5), "stretch": (0.5, 200 / 480)}[fit]
    expected = (before - [320, 240]) * scale + [160, 100]
    np.testing.assert_allclose(after, expected, atol=1e-9)
    with pytest.raises(RigError, match="another shape"):
        resized(camera, (320, 200))
    np.testing.assert_allclose(resized(camera, (320, 240)).K[0, 0], camera.K[0, 0] / 2)


@pytest.mark.parametrize("name", [name for name, form in FORMATS.items() if form.write])
def test_what_is_written_is_read_again(name, tmp_path):
    rig = default_rig(5)
    path = tmp_path / {"easymocap": "folder", "ros": "folder", "anipose": "a.toml", "caliscope": "c.toml"}.get(
        name, {"qualisys": "c.qca.txt", "kalibr": "chain.yaml"}.get(name, "c.json")
    )
    notes = FORMATS[name].write(rig, path)
    assert notes
    files = sorted(path.glob("cam*.yaml")) if name == "ros" else [path]
    form = recognise(files)
    assert form.name == name
    reading = form.read(files)
    if name == "ros":
        reading = with_poses(reading, read_transforms(path / "tf_static.yaml"), {}, None, False)
    first = rig.cameras[0].T_world_camera
    wishes = {"kalibr": Wishes(up="cameras", camera_heights={"cam0": float(first[2, 3])})}.get(name, Wishes())
    back, _ = settle(reading, wishes)
    for a, b in zip(rig.cameras, back.cameras, strict=True):
        assert (a.width, a.height, a.distortion_model) == (b.width, b.height, b.distortion_model)
        np.testing.assert_allclose(b.K, a.K, atol=1e-9)
        np.testing.assert_allclose(b.distortion[:4], a.distortion, atol=1e-12)
        if name != "kalibr":  # its world is lost: only the places among each other stay
            np.testing.assert_allclose(b.T_world_camera, a.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(
        [inverse(back.cameras[0].T_world_camera) @ c.T_world_camera for c in back.cameras],
        [inverse(first) @ c.T_world_camera for c in rig.cameras],
        atol=1e-9,
    )


@pytest.mark.parametrize("name", ["benchmark", "multical", "qualisys", "easymocap"])
def test_a_lens_that_a_format_cannot_hold_is_refused(name, tmp_path):
    camera = default_rig(2).cameras[0]
    fisheye = Camera("wide", 640, 480, camera.K, camera.T_world_camera, [0.1, 0.0, 0.0, 0.0], "fisheye")
    rig = Rig((fisheye,), np.zeros(3), np.ones(3))
    with pytest.raises(RigError, match=r"camera wide: .*cannot hold fisheye"):
        FORMATS[name].write(rig, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "[cam_0]\nsize = [1, 2]\n", "key distortions is missing"),
        ("a.toml", "size = [", "not valid TOML"),
        ("a.qca.txt", "<calibration><cameras><camera></cameras>", "not valid XML"),
        ("a.yaml", "cam0: {camera_model: omni, intrinsics: [1]}", "expected camera_model pinhole, got 'omni'"),
        ("a.json", '{"cameras": {"a": {"image_size": [1, 2]}}}', "key dist is missing"),
        ("a.json", '{"cameras": [], "hello": 1}', "is of no format"),
    ],
)
def test_damaged_files_are_refused_in_words(name, text, message, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(RigError, match=re.escape(message)):
        recognise([path]).read([path])


def test_a_bag_holds_a_whole_rig(tmp_path, capsys):
    rig = default_rig(3)
    types = TYPESTORE.types
    stamp = types["builtin_interfaces/msg/Time"](1, 0)
    header = types["std_msgs/msg/Header"]
    tf = []
    with BagWriter(tmp_path / "bag") as bag:
        for camera in rig.cameras:
            info = types["sensor_msgs/msg/CameraInfo"](
                header=header(stamp, f"{camera.name}_optical_frame"),
                height=camera.height,
                width=camera.width,
                distortion_model="plumb_bob",
                d=np.append(camera.distortion, 0.0),
                k=camera.K.ravel(),
                r=np.eye(3).ravel(),
                p=np.zeros(12),
                binning_x=0,
                binning_y=0,
                roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
            )
            topic = f"/{camera.name}/camera_info"
            bag.add_topic(topic, "sensor_msgs/msg/CameraInfo")
            bag.write(topic, 1, TYPESTORE.serialize_cdr(info, "sensor_msgs/msg/CameraInfo"))
            x, y, z, w = Rotation.from_matrix(camera.T_world_camera[:3, :3]).as_quat()
            tf.append(
                types["geometry_msgs/msg/TransformStamped"](
                    header(stamp, "room"),
                    f"{camera.name}_optical_frame",
                    types["geometry_msgs/msg/Transform"](
                        types["geometry_msgs/msg/Vector3"](*centre(camera)),
                        types["geometry_msgs/msg/Quaternion"](x, y, z, w),
                    ),
                )
            )
        bag.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
        message = types["tf2_msgs/msg/TFMessage"](tf)
        bag.write("/tf_static", 2, TYPESTORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))
    out = tmp_path / "rig.yaml"
    assert cli.main(["rig", "import", str(tmp_path / "bag"), "--out", str(out)]) == 0
    assert "all cameras look at one place" in capsys.readouterr().out
    for a, b in zip(rig.cameras, load_rig(out).cameras, strict=True):
        np.testing.assert_allclose(b.T_world_camera, a.T_world_camera, atol=1e-9)
        np.testing.assert_allclose(b.K, a.K)


def test_the_command_line_imports_and_exports(tmp_path, capsys):
    out = tmp_path / "rig.yaml"
    images = tmp_path / "images"
    for name, size in (("cam01", (108, 192)), ("front", (109, 192))):
        (images / name).mkdir(parents=True)
        cv2.imwrite(str(images / name / "0000.png"), np.zeros(size[::-1], np.uint8))
    command = ["rig", "import", str(RIGS / "qualisys.qca.txt"), "--rename", "cam02=front", "--images", str(images)]
    assert cli.main([*command, "--out", str(out)]) == 2
    assert "another shape: say how they were made: --fit" in capsys.readouterr().err
    assert cli.main([*command, "--fit", "letterbox", "--out", str(out)]) == 0
    rig = load_rig(out)
    assert [(c.name, c.width) for c in rig.cameras[:3]] == [("cam01", 108), ("front", 109), ("cam03", 1088)]
    assert cli.main(["rig", "export", str(out), "--format", "anipose", "--out", str(tmp_path / "Calib.toml")]) == 0
    assert "holds no carve volume" in capsys.readouterr().out
    assert cli.main(["rig", "import", str(tmp_path / "nothing.toml")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert cli.main(["rig", "import", str(RIGS / "qualisys.qca.txt"), "--size", "cam01=big"]) == 2
    assert "--size: expected VALUE or KEY=VALUE, got 'cam01=big'" in capsys.readouterr().err


def test_where_cameras_look():
    look = where_they_look([c.T_world_camera for c in default_rig(8).cameras])
    np.testing.assert_allclose(look.point, [0, 0, 0.95], atol=1e-3)
    assert look.common
    save = where_they_look([np.eye(4), np.eye(4)])
    assert save.parallel
    assert not save.common
