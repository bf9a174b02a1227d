# SPDX-License-Identifier: Apache-2.0
"""The simulated room: its cameras see who is there where the truth says, with noise, light, shadow and chairs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError, RigError
from limbloc_ros.core.pose import JOINT
from limbloc_ros.simulation import _render_kernels as kernels
from limbloc_ros.simulation.company import chair, company
from limbloc_ros.simulation.person import PERSON_NAMES, load_person
from limbloc_ros.simulation.room import SimulatedRoom, default_rig
from limbloc_ros.simulation.surroundings import backdrop, camera_rays


@pytest.fixture(scope="module")
def room() -> SimulatedRoom:
    return SimulatedRoom(default_rig(4, 320, 240), "man", seed=3)


# ---- cameras and pictures ----


@pytest.mark.parametrize("n", [2, 3, 4, 8, 16])
def test_the_default_cameras_see_the_whole_person(n: int) -> None:
    rig = default_rig(n)
    assert len(rig.cameras) == n
    person = load_person("man")
    heights = [c.T_world_camera[2, 3] for c in rig.cameras]
    assert min(heights) >= 1.2
    assert max(heights) <= 2.8
    for camera in rig.cameras:
        uv, depth = camera.world_to_image(person.vertices)
        assert (depth > 1.5).all()
        assert (uv > 0).all()
        assert (uv < [camera.width - 1, camera.height - 1]).all()
        up, _ = camera.world_to_image([[0.0, 0.0, 0.2], [0.0, 0.0, 1.7]])
        assert up[1, 1] < up[0, 1] - 100  # not upside down
    for a, b in zip(rig.cameras, rig.cameras[1:], strict=False):
        assert np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3]) > 0.5


def test_impossible_rooms_are_refused() -> None:
    for arguments, message in (((1,), "2 to 16, got 1"), ((17,), "got 17"), ((4, 10, 480), "got 10x480")):
        with pytest.raises(RigError, match=message):
            default_rig(*arguments)
    rig = default_rig(2)
    T = rig.cameras[0].T_world_camera.copy()
    T[0, 3] = 9.0
    outside = Rig((replace(rig.cameras[0], T_world_camera=T),), rig.volume_min, rig.volume_max)
    with pytest.raises(RigError, match="cam0 stands at"):
        SimulatedRoom(outside)
    with pytest.raises(ConfigError, match="noise_sigma"):
        SimulatedRoom(rig, noise_sigma=-1.0)
    with pytest.raises(ConfigError, match="light_drift"):
        SimulatedRoom(rig, light_drift=0.9)
    with pytest.raises(RigError, match="no camera 'cam7'"):
        SimulatedRoom(rig).render("cam7", 0.0)


def test_one_camera_alone_draws_what_all_cameras_draw(room: SimulatedRoom) -> None:
    frame = room.frame(7.3)
    alone = SimulatedRoom(default_rig(4, 320, 240), "man", seed=3)
    alone.render("cam2", 9.0)
    for name in ("cam2", "cam0"):
        image, mask = alone.render_with_mask(name, 7.3)
        np.testing.assert_array_equal(image, frame.images[name])
        np.testing.assert_array_equal(mask, frame.masks[name])
    np.testing.assert_array_equal(alone.joints(7.3), frame.joints)
    assert frame.images["cam2"].shape == (240, 320, 3)
    assert frame.images["cam2"].dtype == frame.masks["cam2"].dtype == np.uint8


def test_an_empty_room_has_no_joints_and_no_silhouette(room: SimulatedRoom) -> None:
    frame = room.frame(0.5)
    assert frame.joints is None
    assert frame.action == "empty"
    assert not any(mask.any() for mask in frame.masks.values())
    assert room.frame(1.6).joints is not None


@pytest.mark.parametrize("name", PERSON_NAMES)
def test_true_joints_project_into_the_true_silhouette(name: str) -> None:
    room = SimulatedRoom(default_rig(4), name, seed=2)
    seen = 0
    for t in (5.1, 9.7, 16.3, 23.9, 31.1, 44.4, 58.0):
        frame = room.frame(t)
        for camera in room.rig.cameras:
            uv, _ = camera.world_to_image(frame.joints)
            distance = cv2.distanceTransform(255 - frame.masks[camera.name], cv2.DIST_L2, 5)
            within = ((uv > 3) & (uv < [camera.width - 4, camera.height - 4])).all(1)
            u, v = np.round(uv[within]).astype(int).T
            # Linear blend skinning pulls a strongly bent joint's skin in a little: allow 3 px.
            assert distance[v, u].max() < 3.0
            seen += within.sum()
    assert seen > 0.9 * 7 * 4 * 25


def test_the_silhouette_is_the_projected_mesh(room: SimulatedRoom) -> None:
    t = 12.0
    posed = room.motion.pose(t)
    for camera in room.rig.cameras:
        uv, _ = camera.world_to_image(posed.vertices)
        # Drawn by OpenCV 8 times finer, then looked at in the pixels' centres.
        fine = np.zeros((camera.height * 8, camera.width * 8), np.uint8)
        for triangle in uv[room.person.faces]:
            cv2.fillConvexPoly(fine, np.round(triangle * 8 * 16).astype(np.int32), 255, shift=4)
        wanted, mask = fine[::8, ::8], room.render_with_mask(camera.name, t)[1]
        assert (wanted > 0).sum() > 1000
        assert np.sum(wanted != mask) < 0.03 * np.sum(wanted > 0)
        assert not (mask & ~cv2.dilate(wanted, np.ones((3, 3)))).any()
        assert not (cv2.erode(wanted, np.ones((3, 3))) & ~mask).any()


def test_left_and_right_look_different_from_the_front() -> None:
    """The waving right hand appears left of the head to a camera that the person looks at."""
    room = SimulatedRoom(default_rig(8), "man", playlist=["wave"])
    t = next(t for t in np.arange(2, 12, 0.05) if room.motion.action(t) == "wave") + 1.0
    joints = room.joints(t)
    facing = np.cross(joints[JOINT["hip_L"]] - joints[JOINT["hip_R"]], [0, 0, 1])
    camera = max(room.rig.cameras, key=lambda c: facing @ (c.T_world_camera[:3, 3] - joints[JOINT["head_centre"]]))
    uv, _ = camera.world_to_image(joints)
    wrist, head = uv[JOINT["wrist_R"]], uv[JOINT["head_centre"]]
    assert wrist[0] < head[0] - 10
    mask = room.render_with_mask(camera.name, t)[1]
    assert mask[int(wrist[1]), int(wrist[0])] == 255


LENSES = [
    ("none", []),
    ("radtan", [-0.2, 0.05, 0.002, -0.003]),
    ("radtan", [-0.2, 0.05, 0.002, -0.003, 0.01]),
    ("rational", [0.1, -0.05, 0.001, 0.002, 0.01, 0.2, 0.03, -0.01]),
]


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        *LENSES,
        ("radtan", [-2.0, 0.0, 0.0, 0.0]),  # folds within the image
        ("radtan", [3.0, -40.0, 0.0, 0.0]),
        ("rational", [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02, -0.01, 0.005]),
    ],
)
def test_rays_are_opencvs(model: str, coefficients: list[float]) -> None:
    base = default_rig(3).cameras[1]
    camera = Camera("c", 64, 48, np.diag([0.1, 0.1, 1.0]) @ base.K, base.T_world_camera, np.array(coefficients), model)
    pixels = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1)
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, camera.distortion).reshape(48, 64, 2)
    wanted = np.concatenate([flat, np.ones((48, 64, 1))], axis=-1) @ camera.T_world_camera[:3, :3].T
    np.testing.assert_allclose(camera_rays(camera), np.moveaxis(wanted, -1, 0), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_the_fast_projection_equals_the_cameras(model: str, coefficients: list[float]) -> None:
    base = default_rig(3).cameras[1]
    camera = Camera("c", 640, 480, base.K, base.T_world_camera, np.array(coefficients), model)
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (200, 3))
    points[0] = camera.T_world_camera[:3, 3] - camera.T_world_camera[:3, 2]  # behind the camera
    uv, depth = np.empty((200, 2)), np.empty(200)
    T, k = camera.T_camera_world, np.zeros(8)
    k[: len(coefficients)] = coefficients
    kernels.project(points, T[:3, :3], T[:3, 3], camera.K, k, uv, depth)
    wanted, wanted_depth = camera.world_to_image(points)
    np.testing.assert_allclose(uv, wanted, atol=1e-7)
    np.testing.assert_allclose(depth, wanted_depth, atol=1e-12)
    assert np.isnan(uv[0]).all()


def test_a_fisheye_camera_sees_the_person_where_it_projects_him() -> None:
    rig = default_rig(2)
    cameras = tuple(
        replace(c, distortion=np.array([0.02, -0.01, 0.0, 0.0]), distortion_model="fisheye") for c in rig.cameras
    )
    room = SimulatedRoom(Rig(cameras, rig.volume_min, rig.volume_max))
    frame = room.frame(6.0)
    for camera in cameras:
        uv, _ = camera.world_to_image(frame.joints[JOINT["torso_centre"]])
        assert frame.masks[camera.name][int(uv[1]), int(uv[0])] == 255


def test_the_floor_lies_where_the_camera_projects_it() -> None:
    camera = default_rig(4, 320, 240).cameras[0]
    floor = backdrop(camera, seed=0).floor_m
    v, u = np.nonzero(~np.isnan(floor[..., 0]))
    assert len(v) > 10_000
    ground = np.concatenate([floor[v, u], np.zeros((len(v), 1))], axis=1)[::97]
    uv, _ = camera.world_to_image(ground)
    np.testing.assert_allclose(uv, np.stack([u, v], axis=1)[::97], atol=0.02)


def quiet_room(**changes: object) -> SimulatedRoom:
    return SimulatedRoom(default_rig(4, 320, 240), **{"seed": 3, "noise_sigma": 0.0, "light_drift": 0.0, **changes})


def test_noise_has_the_wanted_spread_and_is_new_in_every_frame_and_camera() -> None:
    clean, noisy = quiet_room(), quiet_room(noise_sigma=3.0)
    noise = []
    for name, t in (("cam0", 0.0), ("cam0", 0.04), ("cam1", 0.0)):
        background = clean.render(name, t).astype(float)
        difference = noisy.render(name, t) - background
        noise.append(difference[(background > 20) & (background < 235)][:100_000])
    for values in noise:
        assert abs(values.std() - 3.0) < 0.1
        assert abs(values.mean()) < 0.05
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(noise[a], noise[b])[0, 1]) < 0.02
    np.testing.assert_array_equal(noisy.render("cam0", 0.04), quiet_room(noise_sigma=3.0).render("cam0", 0.04))


def test_light_drifts_slowly_and_no_further_than_asked() -> None:
    room, still = quiet_room(light_drift=0.05), quiet_room()
    reference = still.render("cam0", 0.0).mean()
    level = np.array([room.render("cam0", t).mean() / reference for t in np.arange(0.0, 1.5, 0.04)])
    assert np.abs(np.diff(level)).max() < 0.002
    # Away from the empty start the person changes the mean: compare the ceiling and walls at the image's top only.
    tops = [room.render("cam0", t)[:20].mean() / still.render("cam0", t)[:20].mean() for t in np.arange(0, 120, 3.0)]
    assert 0.04 < np.ptp(tops) < 0.105


def test_the_person_throws_a_shadow_on_the_floor_and_changes_nothing_else() -> None:
    room = quiet_room()
    empty = room.render("cam0", 0.0).astype(int)
    image, mask = room.render_with_mask("cam0", 7.0)
    change = np.abs(image.astype(int) - empty).max(-1)
    outside = cv2.dilate(mask, np.ones((5, 5))) == 0
    floor = ~np.isnan(backdrop(room.rig.camera("cam0"), 3).floor_m[..., 0])
    assert change[outside & ~floor].max() == 0
    shadow = outside & floor & (change > 8)
    assert shadow.sum() > 200
    assert (image[shadow].astype(int) <= empty[shadow]).all()
    ratio = image[shadow] / np.maximum(empty[shadow], 1)
    assert ratio.min() > 0.35
    assert np.ptp(ratio, axis=1).max() < 0.1  # a shadow keeps the colour


@pytest.mark.parametrize("name", ["man", "child"])
def test_the_person_stands_out_from_the_room_but_not_everywhere(name: str) -> None:
    room = quiet_room(person=name)
    contrasts = []
    for camera in room.rig.names:
        empty = room.render(camera, 0.0).astype(int)
        for t in (6.0, 14.0, 22.0):
            image, mask = room.render_with_mask(camera, t)
            contrasts.append(np.abs(image.astype(int) - empty).max(-1)[mask > 0])
    contrast = np.concatenate(contrasts)
    assert np.mean(contrast > 12) > 0.9
    assert np.mean(contrast <= 24) > 0.002


def test_silhouettes_of_a_posture_are_those_of_the_instant_that_has_it() -> None:
    room = quiet_room()
    images = {name: room.render_with_mask(name, 7.0) for name in room.rig.names}
    for t in (9.0, 7.0):  # the last one leaves nothing behind
        posed = room.motion.pose(t)
        assert posed is not None
        masks = room.silhouettes(posed)
    assert list(masks) == list(room.rig.names)
    for name, (image, mask) in images.items():
        assert mask.any()
        np.testing.assert_array_equal(masks[name], mask)
        np.testing.assert_array_equal(room.render(name, 7.0), image)  # nor do they in what is drawn next


# ---- several people ----


def test_people_have_places_of_their_own_and_do_what_is_said() -> None:
    pelvis = JOINT["pelvis_centre"]
    for together, low, high in (("apart", 1.1, 2.2), ("crossing", 0.5, 1.0), ("touching", 0.35, 0.55)):
        motions = company(3, together, empty_s=0.0)
        assert [motion.person.name for motion in motions] == ["man", "woman", "child"]
        nearest = np.inf
        for t in np.arange(3.0, 27.0, 0.25):
            places = [motion.pose(t).joints[pelvis, :2] for motion in motions]
            nearest = min(
                nearest, *(np.linalg.norm(a - b) for a, b in zip(places, [*places[1:], places[0]], strict=True))
            )
            assert np.abs(places).max() < 1.5
        assert low < nearest < high
    with pytest.raises(ConfigError, match="people: expected 1 to 4, got 5"):
        company(5, "apart")
    with pytest.raises(ConfigError, match="together: expected one of apart"):
        company(2, "asunder")


def test_each_of_several_people_is_drawn_where_the_truth_says_and_hides_who_is_behind() -> None:
    rig = default_rig(4, 320, 240)
    motions = company(2, "crossing", empty_s=0.0)
    both, first, second = (
        SimulatedRoom(rig, motions=who, noise_sigma=0.0, light_drift=0.0) for who in (motions, motions[:1], motions[1:])
    )
    t = 6.0
    truth = both.everybodys_joints(t)
    np.testing.assert_array_equal(truth[0], first.joints(t))
    np.testing.assert_array_equal(truth[1], second.joints(t))
    hidden = 0
    for name in rig.names:
        (image, mask), (image_1, mask_1), (image_2, mask_2) = (
            r.render_with_mask(name, t) for r in (both, first, second)
        )
        np.testing.assert_array_equal(mask, mask_1 | mask_2)
        overlap = cv2.erode(mask_1 & mask_2, np.ones((3, 3))) > 0
        hidden += overlap.sum()
        # what is seen there is the nearer one
        if overlap.any():
            nearest = int(np.argmin([rig.camera(name).world_to_image(joints)[1].mean() for joints in truth]))
            unlike = [np.abs(image[overlap].astype(int) - other[overlap]).mean() for other in (image_1, image_2)]
            assert unlike[nearest] < 12
            assert unlike[nearest] < 0.6 * unlike[1 - nearest]
    assert hidden > 0


def test_a_chair_is_drawn_when_it_is_there_and_where_it_was_pushed() -> None:
    rig = default_rig(4, 320, 240)
    seat = chair([(2.0, 0.5, 0.0, 0.0), (4.0, 0.5, 0.0, 0.0), (6.0, -0.5, 0.0, 1.0)])
    assert seat.at(1.9) is None
    np.testing.assert_allclose(seat.at(5.0).mean(axis=0)[:2], [0.0, 0.0], atol=0.1)
    a, b, c = (seat.vertices[seat.faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0  # faces are counter-clockwise from outside
    room = SimulatedRoom(rig, empty_s=60.0, things=[seat])
    assert not room.render_with_mask("cam0", 1.0)[1].any()
    mask = room.render_with_mask("cam0", 3.0)[1]
    uv, _ = rig.camera("cam0").world_to_image(seat.at(3.0))
    v, u = np.nonzero(mask)
    np.testing.assert_allclose([u.min(), u.max(), v.min(), v.max()],
                               [uv[:, 0].min(), uv[:, 0].max(), uv[:, 1].min(), uv[:, 1].max()], atol=2)  # fmt: skip
