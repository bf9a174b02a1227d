# SPDX-License-Identifier: Apache-2.0
"""Boards before cameras whose truth is known: projected corners with noise, and rendered images."""

from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from limbloc_ros.rig.bundle import View


def walk(board, frames, floor_frames, rng):
    """T_world_board of somebody who walks a board through the room and then lays it on the floor."""
    corners = board.points
    middle = corners.mean(axis=0)
    poses = []
    for k in range(frames):
        yaw, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(-1.2, 1.2)
        tilt = np.pi + pitch if k % 2 else -np.pi / 2 + 0.5 * pitch
        T = np.eye(4)
        T[:3, :3] = (Rotation.from_euler("z", yaw) * Rotation.from_euler("x", tilt)).as_matrix()
        lowest = ((corners - middle) @ T[:3, :3].T)[:, 2].min()
        T[:3, 3] = [*rng.uniform(-0.9, 0.9, 2), rng.uniform(0.1, 1.2) - lowest] - T[:3, :3] @ middle
        poses.append(T)
    lying = np.diag([1.0, -1, -1, 1])  # its face up: x stays, y and z turned round
    return [*poses, *([lying] * floor_frames)]


def project(rig, board, poses, noise_px, rng):
    """What a perfect detector with noise finds: views of the board's face at less than 70 degrees."""
    views = []
    for frame, T in enumerate(poses):
        points = board.points @ T[:3, :3].T + T[:3, 3]
        for c, camera in enumerate(rig.cameras):
            away = camera.T_world_camera[:3, 3] - T[:3, 3]
            if -T[:3, 2] @ away < 0.34 * np.linalg.norm(away):
                continue
            view = visible(camera, points)
            if len(view[0]) >= 8:
                views.append(View(c, frame, view[0], view[1] + rng.normal(0, noise_px, view[1].shape)))
    return views


def visible(camera, points):
    uv, depth = camera.world_to_image(points)
    seen = (depth > 0.2) & (uv > 5).all(axis=1) & (uv < [camera.width - 6, camera.height - 6]).all(axis=1)
    return np.flatnonzero(seen), uv[seen]


def near(rig, board, count, noise_px, rng):
    """Views of the board held near each camera, for its lens."""
    middle, views = board.points.mean(axis=0), []
    for c, camera in enumerate(rig.cameras):
        k = 0
        while k < count:
            R = Rotation.from_euler("xyz", rng.uniform([-0.7, -0.7, -0.5], [0.7, 0.7, 0.5])).as_matrix()
            z = rng.uniform(0.7, 1.5)
            here = (board.points - middle) @ R.T + z * np.array([*rng.uniform([-0.5, -0.4], [0.5, 0.4]), 1.0])
            T = camera.T_world_camera
            ids, places = visible(camera, here @ T[:3, :3].T + T[:3, 3])
            if len(ids) >= 20:
                views.append(View(c, 1000 * c + k, ids, places + rng.normal(0, noise_px, places.shape)))
                k += 1
    return views


@cache
def rays_of(name, width, height, K, distortion, k):
    """Rays [k height, k width, 2] (normalised, undistorted) of k x k places in each pixel."""
    rows, columns = np.indices((k * height, k * width), dtype=np.float64)
    pixels = np.stack([(columns + 0.5) / k - 0.5, (rows + 0.5) / k - 0.5], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, np.reshape(K, (3, 3)), np.array(distortion))
    return rays.reshape(k * height, k * width, 2)


@cache
def texture_of(board, square_px):
    return cv2.GaussianBlur(board.draw(square_px), (0, 0), 1.0)


def render(camera, board, T_world_board, rng, square_px=60):
    """An image uint8 [height, width] of a grey room with a board in it: ray by ray, through the lens, antialiased."""
    k, margin = 2, square_px // 2
    first = 0.0 if board.kind == "charuco" else 1.0  # squares before the origin of `points`
    image = np.full((camera.height, camera.width), 110.0)
    squares = np.array([board.columns, board.rows]) + (board.kind == "checkerboard")
    low, high = -(first + 0.5) * np.ones(2), squares - first + 0.5
    t = np.linspace(0, 1, 30)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    rim = np.concatenate([corners[i] * (1 - t) + corners[(i + 1) % 4] * t for i in range(4)]) * board.square_m
    outline = np.column_stack([rim, np.zeros(len(rim))]) @ T_world_board[:3, :3].T + T_world_board[:3, 3]
    uv, depth = camera.world_to_image(outline)
    T = np.linalg.inv(T_world_board) @ camera.T_world_camera
    if (depth > 0.1).all() and T[2, 3] < 0:  # the board is before the camera, and shows its face
        (x0, y0), (x1, y1) = np.floor(uv.min(axis=0)).astype(int) - 1, np.ceil(uv.max(axis=0)).astype(int) + 2
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, camera.width), min(y1, camera.height)
        if x0 < x1 and y0 < y1:
            key = camera.name, camera.width, camera.height, tuple(camera.K.ravel()), tuple(camera.distortion), k
            rays = rays_of(*key)[k * y0 : k * y1, k * x0 : k * x1]
            directions = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ T[:3, :3].T
            hit = T[:3, 3] - T[2, 3] / directions[..., 2:] * directions
            # A texture pixel's centre is an integer; the board's corner lies on the edge between two.
            places = (hit[..., :2] / board.square_m + first) * square_px + margin - 0.5
            texture = texture_of(board, square_px)
            piece = cv2.remap(
                texture,
                places.astype(np.float32),
                None,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=110,
            )
            image[y0:y1, x0:x1] = piece.reshape(y1 - y0, k, x1 - x0, k).mean(axis=(1, 3))
    noise = rng.normal(0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)
