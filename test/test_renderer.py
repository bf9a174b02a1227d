# SPDX-License-Identifier: Apache-2.0
"""Meshes, software renderer and image overlays, against balls whose pictures are known by hand."""

import numpy as np
import pytest

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES
from limbloc_ros.export.hull_surface import vertex_normals
from limbloc_ros.export.stick_drawing import BRIGHT, draw_stick
from limbloc_ros.report._renderer_kernels import rasterise
from limbloc_ros.report.mesh import Mesh, balls, capsule, hull_mesh, stick_mesh, with_field
from limbloc_ros.report.overlay import overlay_montage
from limbloc_ros.report.renderer import Layer, background, look_at, render

RED, BLUE = (1.0, 0.1, 0.1), (0.1, 0.1, 1.0)


def ball_hull(centre, radius, voxel_m=0.02, band_m=0.06):
    """The exact signed distance of a ball, on the world's lattice."""
    low = np.floor((np.asarray(centre) - radius - 0.1) / voxel_m).astype(int)
    high = np.ceil((np.asarray(centre) + radius + 0.1) / voxel_m).astype(int)
    axes = [(np.arange(a, b) + 0.5) * voxel_m for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sdf = np.minimum(np.linalg.norm(points - centre, axis=-1) - radius, band_m)
    return Hull(voxel_m, tuple(int(v) for v in low), sdf.astype(np.float32), band_m)


def volume(mesh):
    """Signed volume of a closed mesh: positive when faces are anticlockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def person(at=(0.0, 0.0)):
    """A standing figure that faces world x: left is +y."""
    spots = {"head_centre": (0, 1.60), "head_top": (0, 1.72), "neck_base": (0, 1.45), "torso_centre": (0, 1.2)}
    spots |= {"pelvis_centre": (0, 0.95), "shoulder": (0.2, 1.4), "elbow": (0.45, 1.4), "wrist": (0.7, 1.4)}
    spots |= {"hand": (0.78, 1.4), "fingertip": (0.86, 1.4), "hip": (0.1, 0.92), "knee": (0.12, 0.5)}
    spots |= {"ankle": (0.12, 0.08), "toe": (0.12, 0.02), "heel": (0.12, 0.03)}
    joints = np.zeros((len(JOINT_NAMES), 3))
    for i, name in enumerate(JOINT_NAMES):
        y, z = spots[name.removesuffix("_L").removesuffix("_R")]
        x = 0.15 if name.startswith("toe") else 0.0
        joints[i] = (at[0] + x, at[1] + (-y if name.endswith("_R") else y), z)
    return joints


def test_hull_mesh_is_the_ball_it_came_from():
    centre, radius = np.array([0.513, -1.207, 0.9]), 0.25
    mesh = hull_mesh(ball_hull(centre, radius))
    outward = (mesh.vertices - centre) / np.linalg.norm(mesh.vertices - centre, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - centre, axis=1), radius, atol=1.5e-3)
    assert (np.einsum("ij,ij->i", mesh.normals, outward) > 0.98).all()
    moved = Mesh.of(mesh.vertices - centre, mesh.faces, mesh.normals, RED)
    assert volume(moved) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)
    edges = {tuple(edge) for edge in mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}
    assert all((b, a) in edges for a, b in edges)  # closed: every edge has its other side


def test_hull_mesh_closes_a_hull_that_reaches_its_array_border():
    hull = Hull(0.1, (0, 0, 0), np.full((1, 1, 1), -0.05, dtype=np.float32), 0.05)
    mesh = hull_mesh(hull)
    assert len(mesh.vertices) == 8
    assert volume(mesh) > 0
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), [0.05, 0.05, 0.05], atol=1e-12)


def test_field_takes_the_value_of_the_nearest_point():
    mesh = balls([(0, 0, 0)], 1.0, RED)
    points = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    coloured = with_field(mesh, points, np.array([5.0, np.nan, 7.0, 3.0]))
    top = np.argmax(mesh.vertices[:, 2])
    assert coloured.scalars[top] == pytest.approx(7.0, abs=0.3)  # the others are 1.4 m away or more
    assert np.isfinite(coloured.scalars).all()


def test_rasterise_agrees_with_rays_against_the_plane():
    rng = np.random.default_rng(3)
    f, size = 40.0, 32
    for _ in range(20):
        corners = np.column_stack([rng.uniform(-1, 1, (3, 2)), rng.uniform(1.5, 4, 3)])
        uv = corners[:, :2] / corners[:, 2:] * f + (size - 1) / 2
        z_buffer = np.full((size, size), np.inf, dtype=np.float32)
        values = np.zeros((size, size, 3), dtype=np.float32)
        rasterise(uv, corners[:, 2], np.array([[0, 1, 2]]), corners.astype(np.float32), z_buffer, values)
        # Plain reference: each pixel's ray meets the plane; inside when all barycentric coordinates are positive.
        u, v = np.meshgrid(np.arange(size), np.arange(size))
        rays = np.stack([(u - (size - 1) / 2) / f, (v - (size - 1) / 2) / f, np.ones_like(u, float)], axis=-1)
        weights = rays @ np.linalg.inv(corners)
        inside = (weights > 1e-9).all(axis=-1)
        depth = 1 / weights.sum(axis=-1)
        clear = np.abs(weights).min(axis=-1) > 1e-6  # leave out pixels on an edge
        np.testing.assert_array_equal(np.isfinite(z_buffer)[clear], inside[clear])
        seen = inside & clear
        np.testing.assert_allclose(z_buffer[seen], depth[seen], rtol=1e-5)
        np.testing.assert_allclose(values[seen], (rays * depth[..., None])[seen], atol=1e-4)


def test_rasterise_drops_what_reaches_behind_the_camera():
    z_buffer = np.full((4, 4), np.inf, dtype=np.float32)
    uv = np.array([[0.0, 0], [9, 0], [0, 9]])
    args = (np.array([[0, 1, 2]]), np.zeros((3, 1), np.float32), z_buffer, np.zeros((4, 4, 1), np.float32))
    rasterise(uv, np.array([1.0, 1.0, -1.0]), *args)
    rasterise(np.array([[0.0, 0], [np.nan, 0], [0, 9]]), np.ones(3), *args)
    assert np.isinf(z_buffer).all()


def test_a_ball_covers_the_disc_that_optics_says():
    radius, distance, size = 0.3, 3.0, (121, 101)
    camera = look_at((1.0, 2.0, 0.5), 0.7, 0.2, distance, size)
    backdrop = background(size)
    picture = render([Layer(balls([(1.0, 2.0, 0.5)], radius, RED))], camera, backdrop)
    touched = (picture != backdrop).any(axis=2)
    # The outline's rays touch the ball: sin(angle) = r / d, so tan(angle) = r / sqrt(d^2 - r^2).
    expected = camera.K[0, 0] * radius / np.sqrt(distance**2 - radius**2)
    rows, columns = np.nonzero(touched)
    assert (columns.min() + columns.max()) / 2 == pytest.approx((size[0] - 1) / 2, abs=1)
    assert (rows.min() + rows.max()) / 2 == pytest.approx((size[1] - 1) / 2, abs=1)
    assert np.ptp(columns) / 2 == pytest.approx(expected, abs=1.5)
    assert touched.sum() == pytest.approx(np.pi * expected**2, rel=0.06)
    middle = picture[50, 60].astype(int)
    assert middle[0] > middle[1] + 60  # red
    assert middle[0] > middle[2] + 60


def test_nearer_layers_hide_or_tint_what_is_behind_whatever_their_order():
    camera = look_at((0, 0, 0), 0.0, 0.0, 4.0, (41, 41))  # looks along -x
    near, far = balls([(1, 0, 0)], 0.4, RED), balls([(-1, 0, 0)], 0.4, BLUE)
    solid = [
        render(order, camera)[20, 20].astype(int) for order in ([Layer(near), Layer(far)], [Layer(far), Layer(near)])
    ]
    np.testing.assert_array_equal(*solid)
    assert solid[0][0] > solid[0][2] + 60
    tinted = render([Layer(near, 0.5), Layer(far)], camera)[20, 20].astype(int)
    only_far = render([Layer(far)], camera)[20, 20].astype(int)
    assert only_far[2] > tinted[2] > solid[0][2]
    assert only_far[0] < tinted[0] < solid[0][0]


def test_nothing_to_draw_leaves_the_backdrop():
    camera = look_at((0, 0, 0), 0, 0, 2.0, (30, 20))
    behind = Layer(balls([(9.0, 0, 0)], 0.1, RED))
    for layers in ([], [Layer(Mesh.join([]))], [behind]):
        np.testing.assert_array_equal(render(layers, camera), background((30, 20)))
    with pytest.raises(ValueError, match=r"expected shape \(20, 30, 3\), got \(30, 20, 3\)"):
        render([], camera, background((20, 30)))


def test_rendering_is_repeatable_and_the_floor_darkens_under_the_figure():
    camera = look_at((0, 0, 0.2), 0.3, 0.5, 3.0, (80, 60))
    layers = [Layer(balls([(0, 0, 0.2)], 0.2, RED))]
    picture = render(layers, camera, floor=True)
    np.testing.assert_array_equal(picture, render(layers, camera, floor=True))
    uv, _ = camera.world_to_image(np.array([-0.068, 0.22, 0.0]))  # on the floor, just beside the ball
    x, y = np.round(uv).astype(int)
    assert picture[y, x].sum() < background((80, 60))[y, x].sum() - 30


def test_look_at_shows_up_as_up_and_left_as_left():
    camera = look_at((1, 2, 3), np.pi / 2, 0.3, 5.0, (200, 100))  # stands at +y, looks along -y
    uv, depth = camera.world_to_image(np.array([[1, 2, 3], [1, 2, 3.5], [1.5, 2, 3]]))
    np.testing.assert_allclose(uv[0], [99.5, 49.5], atol=1e-9)
    assert depth[0] == pytest.approx(5.0)
    assert uv[1, 1] < 49.5
    assert uv[2, 0] < 99.5  # looking along -y, +x lies to the left


def test_stick_figure_leaves_out_missing_joints():
    joints = person()
    whole = stick_mesh(joints)
    assert len(whole.vertices) == 162 * (len(JOINT_NAMES) + len(STICK_BONES))
    joints[JOINT["wrist_L"]] = np.nan
    part = stick_mesh(joints)
    assert len(part.vertices) == len(whole.vertices) - 162 * 3  # the joint and the two bones that meet there
    assert np.isfinite(part.vertices).all()
    assert len(stick_mesh(np.full_like(joints, np.nan)).vertices) == 0


def test_vertex_normals_of_a_capsule_point_outwards():
    rod = capsule((0, 0, 0), (0, 0, 1), 0.1, 0.1, RED, detail=3)
    assert (np.einsum("ij,ij->i", vertex_normals(rod.vertices, rod.faces), rod.normals) > 0.8).all()


DISTORTED = Camera(
    "cam0",
    320,
    240,
    np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]]),
    look_at((0, 0, 1.0), 0.0, 0.1, 3.0, (320, 240)).T_world_camera,
    np.array([-0.25, 0.05, 0.0, 0.0]),
    "radtan",
)
RIG = Rig((DISTORTED,), np.array([-2.0, -2, 0]), np.array([2.0, 2, 2.5]))


def near_colour(pixel, side):
    return np.abs(pixel[::-1].astype(int) - 255 * np.array(BRIGHT[side])).max() < 40


def test_overlay_lands_on_the_distorted_pixels():
    joints = person()
    image = np.full((240, 320, 3), 90, dtype=np.uint8)
    drawn = draw_stick(image, DISTORTED, joints)
    assert (image == 90).all()  # the input is left alone
    for name, side in (("wrist_L", "L"), ("wrist_R", "R"), ("head_centre", "")):
        uv, _ = DISTORTED.world_to_image(joints[JOINT[name]])
        x, y = np.round(uv).astype(int)
        assert near_colour(drawn[y, x], side), name
    # The person faces the camera, so the own left is on the right of the image.
    assert DISTORTED.world_to_image(joints[JOINT["wrist_L"]])[0][0] > 160
    joints[JOINT["wrist_L"]] = np.nan
    assert not near_colour(draw_stick(image, DISTORTED, joints)[y, x + 150], "L")


def test_close_up_keeps_the_figure_on_the_image():
    joints = person()
    mask = np.zeros((240, 320), dtype=np.uint8)
    uv, _ = DISTORTED.world_to_image(joints[JOINT["knee_L"]])
    x, y = np.round(uv).astype(int)
    mask[y - 6 : y + 7, x - 6 : x + 7] = 255
    sheet = overlay_montage({"cam0": mask}, RIG, joints, close_up=True, panel_width_px=600)
    assert sheet.shape == (800, 600, 3)
    # The grey square of the mask is centred on the drawn knee: its middle is where blue is drawn.
    grey = (sheet == 128).all(axis=2)
    blue = np.abs(sheet[..., ::-1].astype(int) - 255 * np.array(BRIGHT["L"])).max(axis=2) < 40
    rows, columns = np.nonzero(grey)
    assert len(rows) > 100
    y, x = (round(np.percentile(at, (2, 98)).mean()) for at in (rows, columns))
    assert blue[y, x]


def test_overlay_errors_name_what_came():
    joints = person()
    with pytest.raises(InputError, match="expected images of cam0, got other"):
        overlay_montage({"other": np.zeros((240, 320), np.uint8)}, RIG, joints)
    with pytest.raises(InputError, match=r"cam0: expected an image of shape \(240, 320, 3\), got \(120, 160, 3\)"):
        overlay_montage({"cam0": np.zeros((120, 160, 3), np.uint8)}, RIG, joints)
