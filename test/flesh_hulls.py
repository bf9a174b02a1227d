# SPDX-License-Identifier: Apache-2.0
"""Hulls made of the figure's own flesh, for tests of the searches: they say whether a search finds what is there."""

from dataclasses import dataclass, replace
from functools import cache

import figure_poses
import numpy as np
from scipy.spatial.transform import Rotation

from limbloc_ros.core import figure
from limbloc_ros.core.figure import FigureState, Placed, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.search import Medial

VOXEL, BAND = 0.02, 0.06


def hull_where(inside_m, low, high):
    """The hull of a signed distance function between two corners."""
    a, b = np.floor(np.array(low) / VOXEL).astype(int), np.ceil(np.array(high) / VOXEL).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(*ab) for ab in zip(a, b, strict=True)), indexing="ij"), axis=-1)
    d = inside_m((index.reshape(-1, 3) + 0.5) * VOXEL).reshape(index.shape[:3])
    return Hull(VOXEL, tuple(a.tolist()), np.minimum(d, BAND).astype(np.float32), BAND)


def flesh_hull(state):
    """The hull that ideal cameras would carve of a figure."""
    placed = place(state)
    flesh = placed.flesh()
    low, high = placed.spheres.min(axis=0) - 0.16, placed.spheres.max(axis=0) + 0.16
    return hull_where(lambda points: figure.flesh_distance(points, flesh)[0], low, high)


def moved(hull, voxels):
    """The same hull elsewhere in the room, and the cameras with it."""
    shift = VOXEL * np.asarray(voxels)
    index_min = tuple(int(i + v) for i, v in zip(hull.index_min, voxels, strict=True))
    cameras = hull.views.cameras.copy()
    cameras[:, 9:12] -= cameras[:, :9].reshape(-1, 3, 3) @ shift
    views = replace(hull.views, cameras=cameras)
    return replace(hull, index_min=index_min, viewpoints=hull.viewpoints + shift.astype(np.float32), views=views)


POSTURES = {
    "arms out": {"shoulder_L_abduction": 70, "shoulder_R_abduction": 70, "hip_L_abduction": 12, "hip_R_abduction": 12},
    "striding": {
        "shoulder_L_flexion": 60,
        "elbow_L_flexion": 60,
        "shoulder_R_abduction": 40,
        "elbow_R_flexion": 30,
        "hip_L_flexion": 35,
        "knee_L_flexion": 40,
        "hip_R_flexion": -15,
    },
}


@dataclass(frozen=True)
class Person:
    """A posed figure, its hull and the hull's medial axis."""

    state: FigureState
    placed: Placed
    hull: Hull
    medial: Medial


@cache
def person_in(posture):
    """Somebody in one of POSTURES, somewhere in the room."""
    posed = figure_poses.posed(POSTURES[posture])
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    rotations = posed.rotations.copy()
    rotations[0] = turn @ rotations[0]
    state = FigureState(np.array([0.4, -0.7, 1.0]), rotations, posed.shape)
    hull = flesh_hull(state)
    return Person(state, place(state), hull, Medial.of(hull))
