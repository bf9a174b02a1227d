# SPDX-License-Identifier: Apache-2.0
"""People with the evidence that their own bodies would leave, for tests of the energy."""

import dataclasses
import functools

import figure_poses
import numpy as np

from limbloc_ros.core import energy, figure
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.figure import FigureState, place
from limbloc_ros.core.pose import Flesh

NOTHING = Weights(
    surface=0.0, inclusion=0.0, penetration=0.0, posture=0.0, limits=0.0, spine=0.0, proportions=0.0, clothing=0.0
)
VOXEL = 0.02


def only(**weights):
    return dataclasses.replace(NOTHING, **weights)


def flesh_grid(state, margin_m=0.3):
    """The signed distance of a person's own flesh on a lattice: float32 grid and its origin."""
    placed = place(state)
    low = np.floor((placed.spheres.min(axis=0) - margin_m) / VOXEL).astype(int)
    high = np.ceil((placed.spheres.max(axis=0) + margin_m) / VOXEL).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1)
    centres = (index + 0.5) * VOXEL
    d, _ = figure.flesh_distance(centres.reshape(-1, 3), placed.flesh())
    return d.reshape(index.shape[:3]).astype(np.float32), (low + 0.5) * VOXEL


def surface_points(state, count, rng):
    """Points on a person's skin and their normals."""
    placed = place(state)
    flesh = placed.flesh()
    direction = rng.normal(size=(20 * count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    s = rng.integers(0, figure.N_SPHERES, len(direction))
    points = placed.spheres[s] + placed.radii[s, None] * direction
    outer = np.abs(figure.flesh_distance(points, flesh)[0]) < 1e-9
    return points[outer][:count], direction[outer][:count]


def evidence_of(state, rng, count=200):
    points, normals = surface_points(state, count, rng)
    weights = rng.uniform(0.5, 1.5, len(points))
    sdf, origin = flesh_grid(state)
    return Evidence(points, normals, np.zeros_like(points), weights / weights.sum(), sdf, origin, VOXEL)


def size(state):
    return 3 + figure.N_DOF + len(state.shape)


def ray_distances(points, rays, placed):
    """Signed distance [Q] of rays (points where they are zero) to the flesh: that of circles, seen along the ray."""
    out = np.empty(len(points))
    for q, (point, ray) in enumerate(zip(points, rays, strict=True)):
        flat = placed.spheres - np.outer((placed.spheres - point) @ ray, ray)
        flesh = Flesh(flat, placed.radii, figure.PART_SPHERES, figure.PART_NAMES)
        out[q] = figure.flesh_distance(point[None], flesh)[0][0]
    return out


@functools.cache
def a_person():
    """A person's evidence, and the same person a little off."""
    rng = np.random.default_rng(0)
    truth = figure_poses.random_state(rng, 0.5)
    step = 0.1 * rng.normal(size=size(truth))
    step[:3] *= 0.3
    step[3 + figure.N_DOF] *= 0.3
    return truth, evidence_of(truth, rng), truth.moved(step)


@functools.cache
def a_person_and_rays():
    """The same case, but three of four points are asked for along some ray only that touches the skin there."""
    truth, evidence, state = a_person()
    rays = np.cross(evidence.normals, np.random.default_rng(5).normal(size=evidence.points.shape))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[::4] = 0.0
    assert rays.any(axis=1).sum() > 100
    return truth, dataclasses.replace(evidence, rays=rays), state


AIR = np.ones((3, 3, 3), np.float32)
BARE = Evidence(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), AIR, np.zeros(3), VOXEL)


def entangled():
    """Someone whose arms and legs run through each other."""
    rng = np.random.default_rng(1)
    people = [figure_poses.random_state(rng) for _ in range(30)]
    return max(people, key=lambda state: energy.system(state, BARE, only(penetration=1.0)).cost)


def turned_from_rest(angles):
    state = FigureState(np.zeros(3), energy.REST_ROTATIONS, FigureState.standing(np.zeros(3)).shape)
    return state.moved(np.concatenate([np.zeros(3), angles, np.zeros(len(state.shape))]))
