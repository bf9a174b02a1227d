# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of cameras that saw a board: lenses, camera poses and board poses, all at once.

The residuals are the distances of found corners to projected ones; derivatives are OpenCV's analytic ones, chained.
scipy's sparse trust region minimises a robust sum of them, so that a blurred or misread corner does not bend the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator

Array = NDArray[np.float64]

#: Residuals beyond this (px) count as linear, not square.
ROBUST_PX = 1.0


@dataclass(frozen=True)
class View:
    """A board seen by one camera in one frame.

    Attributes:
        camera: index of the camera.
        frame: number of the frame.
        ids: [M] corners of the board that were found.
        places: [M, 2] where, px.
    """

    camera: int
    frame: int
    ids: NDArray[np.int64]
    places: Array


@dataclass(frozen=True)
class Lens:
    """Intrinsics in the form that is optimised.

    Attributes:
        model: `radtan`, `rational` or `fisheye`.
        values: fx, fy, cx, cy and the model's coefficients.
        free: which of them are optimised.
    """

    model: str
    values: Array
    free: NDArray[np.bool_]

    @property
    def K(self) -> Array:
        """[3, 3] px."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Array:
        """The coefficients in OpenCV's order."""
        return self.values[4:]

    def project(self, points: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Project board points at a pose (Rodrigues vector and translation, board to camera).

        Returns:
            places [M, 2] px, and their derivatives [M, 2, 6 + len(values)] by rotation, translation, values.
        """
        count = len(self.values)
        if self.model == "fisheye":
            places, J = cv2.fisheye.projectPoints(points[:, None], rotation, translation, self.K, self.distortion)
            order = [*range(8, 11), *range(11, 14), 0, 1, 2, 3, 4, 5, 6, 7]
        else:
            places, J = cv2.projectPoints(points, rotation, translation, self.K, self.distortion)
            order = [*range(6), *range(6, 10), *range(10, 10 + count - 4)]
        return places.reshape(-1, 2), J[:, order].reshape(len(points), 2, 6 + count)


@dataclass(frozen=True)
class Bundle:
    """Everything that is estimated.

    Attributes:
        lenses: of each camera.
        cameras: [C, 6] Rodrigues vector and translation, world to camera.
        boards: frame -> [6] Rodrigues vector and translation, board to world.
    """

    lenses: tuple[Lens, ...]
    cameras: Array
    boards: dict[int, Array]


@dataclass(frozen=True)
class Adjusted:
    """A bundle after adjustment.

    Attributes:
        bundle: the estimate.
        residuals: of each view [M, 2] px, found minus projected.
        camera_sigma: [C, 6] standard deviations of the cameras' turns (rad) and centres (m) among each other, as the
            residuals suggest.
        iterations: evaluations of the residuals.
    """

    bundle: Bundle
    residuals: list[Array]
    camera_sigma: Array
    iterations: int


class _Layout:
    """Where each parameter stands in the vector: lenses, all cameras but the reference, boards."""

    def __init__(self, bundle: Bundle, reference: int) -> None:
        self.bundle, self.reference = bundle, reference
        self.lens_at, at = [], 0
        for lens in bundle.lenses:
            self.lens_at.append(at)
            at += int(lens.free.sum())
        self.camera_at = []
        for c in range(len(bundle.lenses)):
            self.camera_at.append(-1 if c == reference else at)
            at += 0 if c == reference else 6
        self.frames = sorted(bundle.boards)
        self.board_at = {frame: at + 6 * i for i, frame in enumerate(self.frames)}
        self.size = at + 6 * len(self.frames)

    def pack(self) -> Array:
        x = np.zeros(self.size)
        for lens, at in zip(self.bundle.lenses, self.lens_at, strict=True):
            x[at : at + int(lens.free.sum())] = lens.values[lens.free]
        for pose, at in zip(self.bundle.cameras, self.camera_at, strict=True):
            if at >= 0:
                x[at : at + 6] = pose
        for frame, at in self.board_at.items():
            x[at : at + 6] = self.bundle.boards[frame]
        return x

    def unpack(self, x: Array) -> Bundle:
        lenses = []
        for lens, at in zip(self.bundle.lenses, self.lens_at, strict=True):
            values = lens.values.copy()
            values[lens.free] = x[at : at + int(lens.free.sum())]
            lenses.append(Lens(lens.model, values, lens.free))
        cameras = self.bundle.cameras.copy()
        for c, at in enumerate(self.camera_at):
            if at >= 0:
                cameras[c] = x[at : at + 6]
        return Bundle(tuple(lenses), cameras, {frame: x[at : at + 6].copy() for frame, at in self.board_at.items()})


def adjust(bundle: Bundle, views: Sequence[View], points: Array, reference: int) -> Adjusted:
    """Adjust everything to the views.

    Args:
        bundle: a first guess.
        views: every camera and every frame of the bundle occurs.
        points: [N, 3] the board's corners, m.
        reference: the camera that does not move.
    """
    layout = _Layout(bundle, reference)
    rows = np.concatenate([[0], np.cumsum([2 * len(view.ids) for view in views])])

    def evaluate(x: Array) -> tuple[list[Array], csr_matrix]:
        here = layout.unpack(x)
        residuals, entries = [], []
        for view, top in zip(views, rows, strict=False):
            residual, blocks = _view(here, layout, view, points)
            residuals.append(residual)
            for columns, block in blocks:
                i, j = np.indices(block.shape)
                entries.append((top + i.ravel(), columns + j.ravel(), block.ravel()))
        down, across, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        return residuals, csr_matrix((values, (down, across)), shape=(int(rows[-1]), layout.size))

    # In variables that whiten the first guess's normal equations, a few steps do in place of hundreds.
    start = layout.pack()
    residuals, J = evaluate(start)
    scale, factor = _whitening(_normal_equations(residuals, J)[0])
    last = (np.zeros(layout.size), residuals, J)

    def at(y: Array) -> tuple[list[Array], csr_matrix]:
        """Where the derivatives are asked for, the residuals were asked for just before."""
        nonlocal last
        if not np.array_equal(last[0], y):
            last = (y.copy(), *evaluate(start + unwhitened(y)))
        return last[1:]

    def unwhitened(y: Array) -> Array:
        return np.asarray(scale * solve_triangular(factor, y, lower=True, trans=1, check_finite=False))

    def cost(y: Array) -> Array:
        return np.concatenate([residual.ravel() for residual in at(y)[0]])

    def jacobian(y: Array) -> LinearOperator:
        J = at(y)[1]
        return LinearOperator(
            J.shape,
            matvec=lambda v: J @ unwhitened(v.ravel()),
            rmatvec=lambda r: solve_triangular(factor, scale * (J.T @ r.ravel()), lower=True, check_finite=False),
        )

    solution = least_squares(
        cost,
        np.zeros(layout.size),
        jac=jacobian,
        method="trf",
        loss="soft_l1",
        f_scale=ROBUST_PX,
        xtol=1e-9,
        ftol=1e-10,
        gtol=1e-9,
        max_nfev=60,
        tr_solver="lsmr",
        tr_options={"atol": 1e-9, "btol": 1e-9},
    )
    residuals, J = at(solution.x)
    normal, spread = _normal_equations(residuals, J)
    adjusted = layout.unpack(start + unwhitened(solution.x))
    motions = _camera_motions(adjusted.cameras, layout)
    # The covariance is the inverse of the normal equations; only its part about the cameras is worked out.
    scale, factor = _whitening(normal)
    roots = solve_triangular(factor, scale[:, None] * motions.T, lower=True)
    sigma = np.sqrt(spread * (roots**2).sum(axis=0)).reshape(-1, 6)
    return Adjusted(adjusted, residuals, sigma, int(solution.nfev))


def _whitening(normal: Array) -> tuple[Array, Array]:
    """Scale s [P] and lower factor L [P, P], with which (L^-1 s) (s L^-T) is the inverse of normal equations."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-12))
    ridge = 1e-9 * np.eye(len(normal))
    return scale, np.asarray(np.linalg.cholesky(normal * np.outer(scale, scale) + ridge), dtype=np.float64)


def _normal_equations(residuals: Sequence[Array], J: csr_matrix) -> tuple[Array, float]:
    """J^T W J with the robust weights W, and the residuals' weighted variance, px^2."""
    flat = np.concatenate([residual.ravel() for residual in residuals])
    weights = 1 / np.sqrt(1 + (flat / ROBUST_PX) ** 2)
    weighted = csr_matrix(J.multiply(np.sqrt(weights)[:, None]))
    spread = float((weights * flat**2).sum() / max(len(flat) - J.shape[1], 1))
    return (weighted.T @ weighted).toarray(), spread


def _camera_motions(cameras: Array, layout: _Layout) -> Array:
    """Derivatives [6 C, P] of the cameras' turns (rad) and centres (m) among each other, whichever the reference was,
    by all parameters."""
    count = len(cameras)
    J = np.zeros((6 * count, layout.size))
    motions = np.zeros((6 * count, 6))
    for c, (pose, at) in enumerate(zip(cameras, layout.camera_at, strict=True)):
        R, derivative = cv2.Rodrigues(pose[:3])
        by_vector = derivative.reshape(3, 3, 3)
        if at >= 0:  # small turns in the world, and the centre -R^T t, by the six parameters
            J[6 * c : 6 * c + 3, at : at + 3] = -np.array([R.T @ _vee(by_vector[k] @ R.T) for k in range(3)]).T
            J[6 * c + 3 : 6 * c + 6, at : at + 3] = -np.einsum("kji,j->ik", by_vector, pose[3:])
            J[6 * c + 3 : 6 * c + 6, at + 3 : at + 6] = -R.T
        centre = -R.T @ pose[3:]
        motions[6 * c : 6 * c + 3, :3] = np.eye(3)  # a turn and a shift of the whole world
        motions[6 * c + 3 : 6 * c + 6, :3] = np.cross(np.eye(3), centre).T
        motions[6 * c + 3 : 6 * c + 6, 3:] = np.eye(3)
    centres = np.tile([0.0, 0, 0, 1, 1, 1], count)
    fit = np.linalg.pinv(motions * centres[:, None]) * centres
    return np.asarray(J - motions @ (fit @ J))


def _vee(skew: Array) -> Array:
    """The vector [3] of a skew-symmetric matrix [3, 3]."""
    return np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2


def _view(bundle: Bundle, layout: _Layout, view: View, points: Array) -> tuple[Array, list[tuple[int, Array]]]:
    """Residuals [M, 2] of a view, and blocks of their Jacobian: first column, [2 M, columns]."""
    lens, board, camera = bundle.lenses[view.camera], bundle.boards[view.frame], bundle.cameras[view.camera]
    composed = cv2.composeRT(board[:3], board[3:], camera[:3], camera[3:])
    rotation, translation, dr_br, dr_bt, dr_cr, dr_ct, dt_br, dt_bt, dt_cr, dt_ct = composed
    places, J = lens.project(points[view.ids], rotation, translation)
    J = -J.reshape(-1, J.shape[-1])
    by_rotation, by_translation, by_lens = J[:, :3], J[:, 3:6], J[:, 6:]
    board_block = np.hstack(
        [by_rotation @ dr_br + by_translation @ dt_br, by_rotation @ dr_bt + by_translation @ dt_bt]
    )
    blocks = [(layout.lens_at[view.camera], by_lens[:, lens.free]), (layout.board_at[view.frame], board_block)]
    if layout.camera_at[view.camera] >= 0:
        camera_block = np.hstack(
            [by_rotation @ dr_cr + by_translation @ dt_cr, by_rotation @ dr_ct + by_translation @ dt_ct]
        )
        blocks.append((layout.camera_at[view.camera], camera_block))
    return view.places - places, blocks
