# SPDX-License-Identifier: Apache-2.0
"""What the outlines of the silhouettes show and a figure does not."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core._part_kernels import distance_to_part, lay_out
from limbloc_ros.core._unexplained_kernels import farthest
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.parts import Part
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.unexplained import REACH_M, unexplained_m
from limbloc_ros.recordings.cases import load_case

WALK = Path(__file__).parent / "data" / "benchmark" / "public" / "seq_walk_circle"


def test_rays_beside_a_ball_and_through_it():
    ball = (np.zeros((1, 3), np.int64), np.zeros((1, 3)), np.array([0.1]), np.array([True]))
    points = np.array([[0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.25]])
    across, through = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    assert farthest(points[:1], across[None], *ball) == pytest.approx(0.2)
    assert farthest(points[1:2], through[None], *ball) == 0.0
    assert farthest(points, np.stack([through, through, across]), *ball) == pytest.approx(0.15)
    assert farthest(points[:0], points[:0], *ball) == 0.0


def test_rays_nearest_to_some_parts_are_not_asked():
    parts = np.array([[0, 0, 0], [1, 1, 1]])
    balls = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([0.1, 0.1])
    points = np.array([[0.0, 0.0, 0.3], [0.9, 0.0, 0.4]])
    rays = np.tile([0.0, 1.0, 0.0], (2, 1))
    assert farthest(points, rays, parts, *balls, np.array([True, True])) == pytest.approx(np.hypot(0.1, 0.4) - 0.1)
    assert farthest(points, rays, parts, *balls, np.array([True, False])) == pytest.approx(0.2)
    assert farthest(points, rays, parts, *balls, np.array([False, False])) == 0.0


def test_farthest_against_every_part():
    rng = np.random.default_rng(11)
    no_ties = np.arange(36).reshape(12, 3)
    parts = np.array([[a, b, c] if p % 2 else [a, b, b] for p, (a, b, c) in enumerate(no_ties)])
    for count in (1, 3, 64, 300):
        centres, radii = rng.uniform(-0.5, 0.5, (36, 3)), rng.uniform(0.02, 0.06, 36)
        points, rays = rng.uniform(-0.8, 0.8, (count, 3)), rng.normal(size=(count, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rows, _ = lay_out(parts, centres, radii)
        far = np.array(
            [[distance_to_part(row, *p, ray)[0] for row in rows] for p, ray in zip(points, rays, strict=True)]
        )
        for counts in (np.ones(12, np.bool_), rng.random(12) < 0.5):
            asked = far.min(axis=1)[counts[far.argmin(axis=1)]]
            assert farthest(points, rays, parts, centres, radii, counts) == asked.max(initial=0.0)


def test_of_parts_as_near_the_one_of_the_point_before_counts():
    parts = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2]])  # the first two are one place
    centres, radii = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), np.array([0.1, 0.1, 0.1])
    points, rays = np.array([[0.0, 0.0, 0.3]]), np.array([[0.0, 1.0, 0.0]])
    for counts in ([True, False, True], [False, True, True]):
        asked = farthest(points, rays, parts, centres, radii, np.array(counts))
        assert asked == pytest.approx(0.2 if counts[0] else 0.0)


def test_an_arm_elsewhere_is_not_explained():
    case = load_case(WALK)
    hull = Carver(case.rig).carve(case.masks(20))
    pose = PoseEstimator().estimate(hull)
    surface = extract_surface(hull)
    assert unexplained_m(hull, surface, pose.flesh) < 0.06
    state = FigureState.from_vector(pose.parameters)
    state.rotations[[BONE["upper_arm_L"], BONE["forearm_L"], BONE["hand_L"]]] @= exp_so3(np.array([0.0, -1.2, 0.0]))
    assert unexplained_m(hull, surface, place(state).flesh()) > 0.11
    # What somebody else explains, this figure need not; a part of a hull explains its own outlines.
    assert unexplained_m(hull, surface, place(state).flesh(), [pose.flesh]) < 0.06
    assert unexplained_m(hull, surface, place(state).flesh(), [Part.of(hull).filling()]) < 0.06
    unknown = dataclasses.replace(hull, cut_by=None)
    assert unexplained_m(unknown, surface, place(state).flesh()) == 0.0
    away = FigureState(state.root + np.array([0.0, 0.0, 1.0]), state.rotations, state.shape)
    assert unexplained_m(hull, surface, place(away).flesh()) == REACH_M
