# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that project points into cameras, and the table of cameras that they read (see `silhouettes`)."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

# Columns of the packed camera table: R (9), t (3), fx fy cx cy, distortion kind, 14 coefficients, width, height, square
# of the lens's range (see `lens`; without distortion of the image's furthest corner), the lens's largest enlargement.
CAMERA_COLUMNS = 35
NONE, POLYNOMIAL, FISHEYE = 0.0, 1.0, 2.0
# How a block of space lies to a camera.
UNKNOWN, UNSEEN, PARTLY, WITHIN = 0, 1, 2, 3
#: Closer to a camera than this (m) nothing is bounded.
CLOSEST = 0.05


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def distort(cams: Any, c: int, a: float, b: float) -> tuple[float, float]:
    """Normalised coordinates in the lens's range -> pixel."""
    kind = cams[c, 16]
    if kind == 1.0:
        k = cams[c, 17:31]
        r2 = a * a + b * b
        radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        xx = a * radial + 2.0 * k[2] * a * b + k[3] * (r2 + 2.0 * a * a) + k[8] * r2 + k[9] * r2 * r2
        b = b * radial + k[2] * (r2 + 2.0 * b * b) + 2.0 * k[3] * a * b + k[10] * r2 + k[11] * r2 * r2
        a = xx
    elif kind == 2.0:
        k = cams[c, 17:31]
        r = math.sqrt(a * a + b * b)
        if r > 1e-9:
            th = math.atan(r)
            t2 = th * th
            scale = th * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
            a *= scale
            b *= scale
    return cams[c, 12] * a + cams[c, 14], cams[c, 13] * b + cams[c, 15]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def row_start(cams: Any, c: int, x: float, y: float) -> tuple[float, float, float]:
    """The part of a point's camera coordinates that all points with the same x and y share."""
    return (
        cams[c, 0] * x + cams[c, 1] * y + cams[c, 9],
        cams[c, 3] * x + cams[c, 4] * y + cams[c, 10],
        cams[c, 6] * x + cams[c, 7] * y + cams[c, 11],
    )


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def project(cams: Any, c: int, start: tuple[float, float, float], z: float) -> tuple[float, float, float]:
    """World point, given as `row_start` and its z (m) -> pixel (u, v) and depth (m); depth 0 is not seen."""
    depth = start[2] + cams[c, 8] * z
    if depth <= 1e-6:
        return 0.0, 0.0, 0.0
    inverse = 1.0 / depth
    a = (start[0] + cams[c, 2] * z) * inverse
    b = (start[1] + cams[c, 5] * z) * inverse
    if cams[c, 16] == 0.0:
        return cams[c, 12] * a + cams[c, 14], cams[c, 13] * b + cams[c, 15], depth
    if a * a + b * b > cams[c, 33]:
        return 0.0, 0.0, 0.0
    u, v = distort(cams, c, a, b)
    return u, v, depth


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def view_of_balls(cams: Any, c: int, centres: Any, radius: float, count: int, views: Any) -> None:
    """How the first `count` balls of one radius (`centres` [3, B], m) lie to a camera, to `views` [5, B].

    Rows 0 and 1: the centre's pixel (u, v). Row 2: the nearest depth, m. Row 3: `reach` (px): every point of the ball
    is seen at most that far from (u, v). Row 4: UNSEEN or WITHIN the image wholly, PARTLY, or UNKNOWN; what the other
    rows say of balls that are UNSEEN means nothing, nor where the UNKNOWN are seen; their depth is right, but 0 when
    it is less than CLOSEST.

    A point that is d from the centre differs from it by at most d / nearest depth * sqrt(1 + a^2 + b^2) in normalised
    coordinates (a, b: those of the centre), and the lens enlarges that by a known factor at most.
    """
    r00, r01, r02, t0 = cams[c, 0], cams[c, 1], cams[c, 2], cams[c, 9]
    r10, r11, r12, t1 = cams[c, 3], cams[c, 4], cams[c, 5], cams[c, 10]
    r20, r21, r22, t2 = cams[c, 6], cams[c, 7], cams[c, 8], cams[c, 11]
    limit = math.sqrt(cams[c, 33])
    known = math.inf if cams[c, 16] == NONE else limit
    enlarged = max(cams[c, 12], cams[c, 13]) * cams[c, 34]
    for n in range(count):
        x, y, z = centres[0, n], centres[1, n], centres[2, n]
        depth = r20 * x + r21 * y + t2 + r22 * z
        a = r00 * x + r01 * y + t0 + r02 * z
        b = r10 * x + r11 * y + t1 + r12 * z
        away = math.sqrt(a * a + b * b)
        # Behind the camera, or outside the cone in which it sees anything: the latter also for balls beside it.
        unseen = depth < -radius or away - radius > limit * (depth + radius)
        inverse = 1.0 / depth
        a *= inverse
        b *= inverse
        near = depth - radius
        off = away * inverse
        reach = radius / near * math.sqrt(1.0 + off * off)
        how = UNKNOWN if near < CLOSEST or off + reach > known else WITHIN
        how = UNSEEN if unseen else how
        views[0, n], views[1, n], views[2, n], views[3, n], views[4, n] = a, b, near, reach * enlarged, how
    to_pixels(cams, c, views[:, :count])
    right = cams[c, 31] - 1.0
    bottom = cams[c, 32] - 1.0
    for n in range(count):
        u, v, reach, how = views[0, n], views[1, n], views[3, n], views[4, n]
        inmost = min(min(u, right - u), min(v, bottom - v))
        seen = WITHIN if inmost >= reach else PARTLY
        seen = UNSEEN if inmost < -reach else seen
        # anew, for pixels beyond the lens have lost it
        near = r20 * centres[0, n] + r21 * centres[1, n] + t2 + r22 * centres[2, n] - radius
        views[2, n] = 0.0 if near < CLOSEST else near
        views[4, n] = seen if how == WITHIN else how


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def project_block(cams: Any, c: int, points: Any, seen: Any) -> None:
    """Pixels u, v (rows 0 and 1 of `seen`) of points [3, P], and m per px there (row 2); 0 is not seen.

    The same as `project`. With one array to read and one to write, and no branch, these loops become vector code.
    """
    r00, r01, r02, t0 = cams[c, 0], cams[c, 1], cams[c, 2], cams[c, 9]
    r10, r11, r12, t1 = cams[c, 3], cams[c, 4], cams[c, 5], cams[c, 10]
    r20, r21, r22, t2 = cams[c, 6], cams[c, 7], cams[c, 8], cams[c, 11]
    scale = 1.0 / cams[c, 12]
    for m in range(points.shape[1]):
        x = points[0, m]
        y = points[1, m]
        z = points[2, m]
        depth = r20 * x + r21 * y + t2 + r22 * z
        inverse = 1.0 / depth
        seen[0, m] = (r00 * x + r01 * y + t0 + r02 * z) * inverse
        seen[1, m] = (r10 * x + r11 * y + t1 + r12 * z) * inverse
        seen[2, m] = depth * scale if depth > 1e-6 else 0.0
    to_pixels(cams, c, seen)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def has_plain_lens(cams: Any, c: int) -> bool:
    """Whether a polynomial of five coefficients describes the lens, as of most it does."""
    some = False
    for column in range(22, 29):
        some |= cams[c, column] != 0.0
    plain: bool = cams[c, 16] == POLYNOMIAL and not some
    return plain


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bend(
    a: float, b: float, fx: float, fy: float, cx: float, cy: float,
    k1: float, k2: float, p1: float, p2: float, k3: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Normalised coordinates -> pixel, and their square, of a plain lens (see `has_plain_lens`).

    The same numbers as `distort` without their zeros, above all without a division by 1: twice as fast.
    """
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)) + cx
    v = fy * (b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b) + cy
    return u, v, r2


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def to_pixels(cams: Any, c: int, seen: Any) -> None:
    """Normalised coordinates (rows 0 and 1 of `seen`) -> pixels; row 2 becomes 0 beyond the lens's range."""
    fx, fy, cx, cy = cams[c, 12], cams[c, 13], cams[c, 14], cams[c, 15]
    limit = cams[c, 33]
    if cams[c, 16] == FISHEYE:
        for m in range(seen.shape[1]):
            a, b = seen[0, m], seen[1, m]
            if seen[2, m] == 0.0 or a * a + b * b > limit:
                seen[2, m] = 0.0
            else:
                seen[0, m], seen[1, m] = distort(cams, c, a, b)
        return
    if cams[c, 16] == POLYNOMIAL:
        k1, k2, p1, p2, k3 = cams[c, 17], cams[c, 18], cams[c, 19], cams[c, 20], cams[c, 21]
        k4, k5, k6 = cams[c, 22], cams[c, 23], cams[c, 24]
        s1, s2, s3, s4 = cams[c, 25], cams[c, 26], cams[c, 27], cams[c, 28]
        if has_plain_lens(cams, c):
            for m in range(seen.shape[1]):
                scale = seen[2, m]
                seen[0, m], seen[1, m], r2 = bend(seen[0, m], seen[1, m], fx, fy, cx, cy, k1, k2, p1, p2, k3)
                seen[2, m] = 0.0 if r2 > limit else scale
            return
        for m in range(seen.shape[1]):
            a = seen[0, m]
            b = seen[1, m]
            scale = seen[2, m]
            r2 = a * a + b * b
            radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            seen[0, m] = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a) + s1 * r2 + s2 * r2 * r2
            seen[1, m] = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b + s3 * r2 + s4 * r2 * r2
            seen[2, m] = 0.0 if r2 > limit else scale
    for m in range(seen.shape[1]):
        seen[0, m] = fx * seen[0, m] + cx
        seen[1, m] = fy * seen[1, m] + cy
