# SPDX-License-Identifier: Apache-2.0
"""Kernels of `room` and `surroundings`: rays, shading, a z-buffer rasteriser, shadow on the floor, soft edges, noise.

All trust their callers; images are uint8 [H, W, 3] bgr, boxes are x0, y0, x1, y1 with the ends left out.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Faces = NDArray[np.int32]
Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]


@njit(cache=True, error_model="numpy")
def project(points: Array, R: Array, t: Array, K: Array, k: Array, uv: Array, depth: Array) -> None:
    """World points [V, 3] -> uv [V, 2] px and depth [V] m, with OpenCV's distortion k1 k2 p1 p2 k3 k4 k5 k6.

    The same as Camera.world_to_image for `none`, `radtan` and `rational` up to 8 coefficients; R, t are T_camera_world.
    """
    for v in range(len(points)):
        X, Y, Z = points[v, 0], points[v, 1], points[v, 2]
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        depth[v] = z
        if z <= 1e-6:
            uv[v, 0] = uv[v, 1] = np.nan
            continue
        x = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) / z
        y = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) / z
        r2 = x * x + y * y
        radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
        yd = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
        uv[v, 0] = K[0, 0] * xd + K[0, 1] * yd + K[0, 2]
        uv[v, 1] = K[1, 1] * yd + K[1, 2]


@njit(cache=True, error_model="numpy")
def cast_rays(K: Array, k: Array, R: Array, rays: Floats) -> None:
    """Directions [3, H, W] of the pixels in world axes, depth 1 along the camera's axis; k as in `project`.

    As OpenCV's undistortPoints, which takes three times as long, by five steps of a fixed-point iteration; R is
    R_world_camera.
    """
    for v in range(rays.shape[1]):
        for u in range(rays.shape[2]):
            a = x = (u - K[0, 2]) / K[0, 0]
            b = y = (v - K[1, 2]) / K[1, 1]
            for _ in range(5):
                r2 = x * x + y * y
                radial = (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))) / (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])))
                if radial < 0:
                    x, y = a, b
                    break
                xd = a - (2 * k[2] * x * y + k[3] * (r2 + 2 * x * x))
                yd = b - (k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y)
                x, y = xd * radial, yd * radial
            for axis in range(3):
                rays[axis, v, u] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]


@njit(cache=True, error_model="numpy")
def bounds(uv: Array, depth: Array, near: float) -> tuple[bool, float, float, float, float]:
    """Least and greatest u, v of the points deeper than `near` m; False if there is none or one is NaN."""
    u0 = v0 = np.inf
    u1 = v1 = -np.inf
    for k in range(len(uv)):
        if not depth[k] > near:
            continue
        u, v = uv[k, 0], uv[k, 1]
        if math.isnan(u) or math.isnan(v):
            return False, 0.0, 0.0, 0.0, 0.0
        u0, u1 = min(u0, u), max(u1, u)
        v0, v1 = min(v0, v), max(v1, v)
    return u0 <= u1, u0, v0, u1, v1


@njit(cache=True, error_model="numpy")
def shade_vertices(vertices: Array, faces: Faces, light: Array, tone: Array, shade: Array) -> None:
    """Gouraud shading [V]: light from above and a lamp in the direction `light`, times each vertex' own `tone`."""
    n = len(vertices)
    normals = np.zeros((n, 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for v in (a, b, c):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(n):
        x, y, z = normals[v, 0], normals[v, 1], normals[v, 2]
        s = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
        lamp = max((x * light[0] + y * light[1] + z * light[2]) * s, 0.0)
        shade[v] = (0.52 + 0.14 * z * s + 0.46 * lamp) * tone[v]


@njit(cache=True, error_model="numpy")
def rasterise(
    uv: Array, depth: Array, faces: Faces, shade: Array, garments: Array, stripe: Array, palette: Array, near: float,
    image: Image, mask: Image, zbuffer: Floats, x0: int, y0: int, x1: int, y1: int,
) -> None:  # fmt: skip
    """Draw the triangles that face the camera into `image` and `mask` (255), nearest first by `zbuffer`.

    uv [V, 2] px, depth [V] m, shade [V], garments [V, 4] (see person.GARMENTS), stripe [V] rest height m for the
    shirt's pattern, palette [5, 3] bgr of skin, hair, shirt, trousers, shoes. `mask` and `zbuffer` (1 / depth) are 0
    within the box, or what other meshes have left there.
    """
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if depth[a] < near or depth[b] < near or depth[c] < near:
            continue
        ax, ay = uv[a, 0], uv[a, 1]
        bx, by = uv[b, 0], uv[b, 1]
        cx, cy = uv[c, 0], uv[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area >= -1e-9:  # image y points down: a face seen from outside has a negative area
            continue
        left = max(math.ceil(min(ax, bx, cx)), x0)
        right = min(math.floor(max(ax, bx, cx)), x1 - 1)
        top = max(math.ceil(min(ay, by, cy)), y0)
        bottom = min(math.floor(max(ay, by, cy)), y1 - 1)
        if left > right or top > bottom:
            continue
        inv = 1.0 / area
        wa_dx, wb_dx = -(cy - by) * inv, -(ay - cy) * inv
        za, zb, zc = 1.0 / depth[a], 1.0 / depth[b], 1.0 / depth[c]
        wc_dx = -wa_dx - wb_dx
        for y in range(top, bottom + 1):
            wa = ((cx - bx) * (y - by) - (cy - by) * (left - bx)) * inv
            wb = ((ax - cx) * (y - cy) - (ay - cy) * (left - cx)) * inv
            wc = 1.0 - wa - wb
            # The pixels of this row that lie inside: every weight is linear along it.
            first, last = 0.0, float(right - left)
            if wa_dx > 0:
                first = max(first, -wa / wa_dx)
            elif wa_dx < 0:
                last = min(last, -wa / wa_dx)
            elif wa < 0:
                continue
            if wb_dx > 0:
                first = max(first, -wb / wb_dx)
            elif wb_dx < 0:
                last = min(last, -wb / wb_dx)
            elif wb < 0:
                continue
            if wc_dx > 0:
                first = max(first, -wc / wc_dx)
            elif wc_dx < 0:
                last = min(last, -wc / wc_dx)
            elif wc < 0:
                continue
            begin, end = math.ceil(first - 1e-9), math.floor(last + 1e-9)
            wa += begin * wa_dx
            wb += begin * wb_dx
            for x in range(left + begin, left + end + 1):
                wc = 1.0 - wa - wb
                z = wa * za + wb * zb + wc * zc
                if z > zbuffer[y, x]:
                    zbuffer[y, x] = z
                    s = wa * shade[a] + wb * shade[b] + wc * shade[c]
                    kind = 0
                    if wa * garments[a, 3] + wb * garments[b, 3] + wc * garments[c, 3] > 0:
                        kind = 4
                    elif wa * garments[a, 1] + wb * garments[b, 1] + wc * garments[c, 1] > 0:
                        kind = 2
                        height = wa * stripe[a] + wb * stripe[b] + wc * stripe[c]
                        if height * 14.0 - math.floor(height * 14.0) < 0.3:
                            s *= 0.86
                    elif wa * garments[a, 2] + wb * garments[b, 2] + wc * garments[c, 2] > 0:
                        kind = 3
                    elif wa * garments[a, 0] + wb * garments[b, 0] + wc * garments[c, 0] > 0:
                        kind = 1
                    for k in range(3):
                        image[y, x, k] = min(int(palette[kind, k] * s + 0.5), 255)
                    mask[y, x] = 255
                wa += wa_dx
                wb += wb_dx


@njit(cache=True, error_model="numpy")
def soften_edges(image: Image, copy: Image, mask: Mask, x0: int, y0: int, x1: int, y1: int) -> None:
    """Blur the silhouette's edge by 3 x 3 (1 2 1), as a lens and a sensor do; `copy` is image[y0:y1, x0:x1] before."""
    n = x1 - x0 - 2
    edge = np.empty(max(n, 0), np.uint8)
    for y in range(y0 + 1, y1 - 1):
        above, below = mask[y - 1, x0 + 1 : x1 - 1], mask[y + 1, x0 + 1 : x1 - 1]
        left, here, right = mask[y, x0 : x1 - 2], mask[y, x0 + 1 : x1 - 1], mask[y, x0 + 2 : x1]
        some = np.uint8(0)
        for k in range(n):  # 64 at once
            edge[k] = (here[k] ^ above[k]) | (here[k] ^ below[k]) | (here[k] ^ left[k]) | (here[k] ^ right[k])
            some |= edge[k]
        if some == 0:
            continue
        i = y - y0
        for j in range(1, n + 1):
            if edge[j - 1] == 0:
                continue
            for k in range(3):
                total = 8
                for di in range(-1, 2):
                    for dj in range(-1, 2):
                        total += int(copy[i + di, j + dj, k]) * (2 - abs(di)) * (2 - abs(dj))
                image[y, x0 + j, k] = total // 16


@njit(cache=True, error_model="numpy")
def cover_floor(points: Array, heights: Array, faces: Faces, fade_m: float, x0: int, y0: int, cover: Floats) -> None:
    """Rasterise a mesh that was projected onto the floor; cover [h, w] float32 becomes 1 under it.

    points [V, 2] in cells; a face's cover falls with its height above the floor, to 0 at `fade_m` m.
    """
    h, w = cover.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        value = 1.0 - min(heights[a], heights[b], heights[c]) / fade_m
        if value <= 0.0:
            continue
        ax, ay = points[a, 0] - x0, points[a, 1] - y0
        bx, by = points[b, 0] - x0, points[b, 1] - y0
        cx, cy = points[c, 0] - x0, points[c, 1] - y0
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area <= 1e-9:  # the half of the mesh that faces the light is enough
            continue
        left, right = max(math.ceil(min(ax, bx, cx)), 0), min(math.floor(max(ax, bx, cx)), w - 1)
        top, bottom = max(math.ceil(min(ay, by, cy)), 0), min(math.floor(max(ay, by, cy)), h - 1)
        inv = 1.0 / area
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                wa = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * inv
                wb = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * inv
                if wa >= 0 and wb >= 0 and wa + wb <= 1 and value > cover[y, x]:
                    cover[y, x] = value


@njit(cache=True, error_model="numpy")
def darken_floor(
    image: Image, floor: Floats, light: Floats, dark: Mask, cell_x0: int, cell_y0: int,
    x0: int, y0: int, x1: int, y1: int,
) -> None:  # fmt: skip
    """Multiply floor pixels by `light` [h, w] (1 = no shadow), bilinear; floor [H, W, 2] are the pixels' cells.

    dark [h, w] tells where the light of a cell or of its next ones is below 1.
    """
    h, w = light.shape
    one, zero = np.float32(1), np.float32(0)
    left, top, width, height = np.float32(cell_x0), np.float32(cell_y0), np.float32(w - 1), np.float32(h - 1)
    for y in range(y0, y1):
        for x in range(x0, x1):
            gx, gy = floor[y, x, 0] - left, floor[y, x, 1] - top
            if not ((gx >= zero) & (gy >= zero) & (gx < width) & (gy < height)):
                continue
            i, j = np.uint32(gy), np.uint32(gx)
            if dark[i, j] == 0:
                continue
            a, b, c, d = light[i, j], light[i, j + 1], light[i + 1, j], light[i + 1, j + 1]
            fy, fx = gy - np.float32(i), gx - np.float32(j)
            value = (a * (one - fx) + b * fx) * (one - fy) + (c * (one - fx) + d * fx) * fy
            if value < np.float32(0.999):
                for k in range(3):
                    image[y, x, k] = np.uint8(np.float32(image[y, x, k]) * value + np.float32(0.5))


@njit(cache=True, error_model="numpy")
def expose(image: Image, gain: float, noise: NDArray[np.int8], key: np.uint64, out: Image) -> None:
    """out = image * gain + noise, rounded and clipped; each row takes its noise from elsewhere in the bank `noise`.

    `key` uint64 chooses the places; the bank is int8 with at least as many values as a row. The gain is below 2.
    """
    rows, width = image.shape
    span = np.uint64(len(noise) - width + 1)
    factor = np.int16(gain * 16384.0 + 0.5)
    state = key
    for y in range(rows):
        state = state + np.uint64(0x9E3779B97F4A7C15)
        z = state
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
        start = np.int64(z % span)
        row, grain, target = image[y], noise[start : start + width], out[y]
        for x in range(width):
            # The upper half of a product of 16 bits, which a processor takes of 32 pixels at once; 2 is half a level.
            light = np.int16((np.int32(np.int16(row[x] * 4 + 2)) * np.int32(factor)) >> 16)
            target[x] = np.uint8(min(max(np.int16(light + grain[x]), np.int16(0)), np.int16(255)))
