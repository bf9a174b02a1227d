# SPDX-License-Identifier: Apache-2.0
"""Rings of small cameras with the masks of balls, for tests of the hull."""

import numpy as np
from scipy import ndimage

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.silhouettes import cleaned, measure_silhouettes, pack_cameras

LENSES = [
    ("none", []),
    ("radtan", [-0.3, 0.1, 0.002, -0.001]),
    ("radtan", [-0.42, 0.0, 0.0, 0.0]),  # folds far points back into the image
    ("radtan", [0.5, 0.4, 0.01, -0.01]),  # enlarges the border more than twice
    ("radtan", [-0.35, 0.15, 0.0, 0.0, -0.02]),
    ("rational", [1.0, 0.5, 0.001, 0.0, 0.1, 1.3, 0.4, 0.05]),
    ("fisheye", [-0.03, 0.01, -0.002, 0.0]),
    ("fisheye", [0.2, 0.1, 0.0, 0.0]),
]


def look_at(name, position, target, focal=70.0, size=(96, 72), lens=("none", []), roll=0.0):
    """A camera whose optical axis goes from `position` through `target`."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = position
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, 1.1 * focal, (size[1] - 1) / 2 + 3.0], [0.0, 0.0, 1.0]])
    return Camera(name, *size, K, T, np.array(lens[1], float), lens[0])


def ring(count, radius=3.0, height=1.2, **how):
    """Cameras around the middle of a room of 2 x 2 x 2 m."""
    angles = np.arange(count) * 2 * np.pi / count + 0.3
    places = [(radius * np.cos(a), radius * np.sin(a), height + 0.7 * (i % 2)) for i, a in enumerate(angles)]
    cameras = [look_at(f"cam{i}", place, (0.0, 0.0, 1.0), **how) for i, place in enumerate(places)]
    return Rig(tuple(cameras), np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0]))


def ball_masks(rig, balls):
    """Masks of balls (centre, radius): a pixel is foreground when its ray meets one. Undistorted cameras."""
    masks = {}
    for camera in rig.cameras:
        v, u = np.mgrid[: camera.height, : camera.width]
        K = camera.K
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        T = camera.T_camera_world
        mask = np.zeros((camera.height, camera.width), np.uint8)
        for centre, radius in balls:
            c = T[:3, :3] @ np.asarray(centre) + T[:3, 3]
            along = rays @ c
            mask[(along > 0) & (c @ c - along**2 < radius**2)] = 255
        masks[camera.name] = mask
    return masks


def measured(rig, masks, config):
    return measure_silhouettes(masks, rig, pack_cameras(rig), config)


def one_to_one(camera, points):
    """1 where the lens maps the way from the axis to a point without turning back, 0 where not, 0.5 close to a turn."""
    if not camera.distortion.any() or len(points) == 0:
        return np.ones(len(points))
    T = camera.T_camera_world
    p = points @ T[:3, :3].T + T[:3, 3]
    part = np.linspace(0.04, 1.06, 27)
    steps = np.stack([part - 1e-4, part + 1e-4])[..., None, None]
    ahead = np.concatenate([steps * (p[:, :2] / p[:, 2:]), np.ones((2, 27, len(p), 1))], axis=-1)
    W = camera.T_world_camera
    uv, _ = camera.world_to_image(ahead @ W[:3, :3].T + W[:3, 3])
    below, above = np.linalg.norm((uv - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=-1)
    rising = above > below
    fine, nearly = rising.all(axis=0), rising[part < 0.94].all(axis=0)
    return np.where(fine, 1.0, np.where(nearly, 0.5, 0.0))


def every_voxel(rig, masks, voxel_m, band_m, names):
    """Camera distances of every voxel of the volume, by the definition: (indices, sorted distances, who, unsure)."""
    low = np.ceil(rig.volume_min / voxel_m - 0.5 - 1e-9).astype(int)
    high = np.floor(rig.volume_max / voxel_m - 0.5 + 1e-9).astype(int) + 1
    indices = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    points = (indices + 0.5) * voxel_m
    rows, unsure = [], np.zeros(len(points), bool)
    for name in names:
        camera = rig.camera(name)
        solid = cleaned(masks[name]) > 0
        inner, outer = ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid)
        field = np.where(solid, 0.5 - inner, outer - 0.5).astype(np.float32)
        uv, depth = camera.world_to_image(points)
        u, v = np.clip(np.nan_to_num(uv, nan=-1e9), -1e9, 1e9).T
        in_image = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1) & (depth > 1e-6)
        fold = np.ones(len(points))
        fold[in_image] = one_to_one(camera, points[in_image])
        unsure |= fold == 0.5
        borders = np.stack([u, v, u - camera.width + 1, v - camera.height + 1])
        unsure |= (np.abs(borders) < 1e-6).any(axis=0)
        x = np.clip(u.astype(int), 0, camera.width - 2)
        y = np.clip(v.astype(int), 0, camera.height - 2)
        fx, fy = u - x, v - y
        top = (1 - fx) * field[y, x] + fx * field[y, x + 1]
        bottom = (1 - fx) * field[y + 1, x] + fx * field[y + 1, x + 1]
        distance = ((1 - fy) * top + fy * bottom) * depth / camera.K[0, 0]
        rows.append(np.where(in_image & (fold > 0), distance, -np.inf))
    rows = np.array(rows)
    order = np.argsort(-rows, axis=0, kind="stable")
    return indices, np.take_along_axis(rows, order, axis=0), order[0], unsure


def in_order(voxels):
    order = np.lexsort(voxels[0].T)
    return [part[order] for part in voxels]


def who_cut(hull):
    """Lattice indices [V, 3] of the shell's voxels and the row of the camera that decided each."""
    indices, _ = hull.shell()
    local = indices - np.asarray(hull.index_min)
    return indices, hull.cut_by[tuple(local.T)]


BODY = [((0.0, 0.0, 0.5), 0.3), ((0.0, 0.0, 0.9), 0.3), ((0.0, 0.0, 1.3), 0.25)]
CONFIG = HullConfig(voxel_m=0.04, min_voxels=100)
