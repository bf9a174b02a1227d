# SPDX-License-Identifier: Apache-2.0
"""What the hull's kernels leave out: cameras that cannot decide, blocks that are known."""

import numpy as np
import pytest
from camera_rings import LENSES, ball_masks, measured, ring

from limbloc_ros.core import _block_kernels as near
from limbloc_ros.core import _hull_kernels as kernels
from limbloc_ros.core._hull_kernels import LEAF
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.silhouettes import min_seen


@pytest.mark.parametrize("lens", LENSES)
def test_no_distance_in_a_block_exceeds_its_bound(lens):
    rig = ring(5, lens=lens)
    config = HullConfig(voxel_m=0.03)
    balls = measured(rig, ball_masks(rig, [((0.1, 0.0, 1.0), 0.3), ((-0.2, 0.2, 0.6), 0.15)]), config)
    blocks, cams, boxes, field = balls.blocks, balls.cameras, balls.boxes, balls.field
    outward, most = np.empty((2, 5, len(blocks)))
    whole = np.empty((5, len(blocks)), np.bool_)
    seen = min_seen(5)
    kernels.look_at_blocks(blocks, cams, boxes, field, 0.03, config.band_m, True, seen, outward, most, whole)
    bounded = np.isfinite(most)
    assert bounded.any() and not (bounded & ~whole).any()
    steps = np.stack(np.meshgrid(*[np.arange(LEAF)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    slack = []
    for c, n in zip(*np.nonzero(bounded), strict=True):
        for x, y, z in (blocks[n] + steps + 0.5) * 0.03:
            start = kernels.row_start(cams, c, x, y)
            distance = kernels.camera_distance(cams, c, boxes, field, config.band_m, start, z)
            slack.append(most[c, n] - distance)
    assert min(slack) >= 0.0
    assert min(slack) < 0.3  # pixels of 4 cm, of which some lenses make 10: it is no idle bound


def test_known_blocks_are_not_found_again():
    lower, upper = np.array([-7, 3, 0]), np.array([30, 44, 37])
    blocks = near.root_blocks(lower, upper, LEAF)
    known = blocks[np.random.default_rng(3).random(len(blocks)) < 0.4]
    new = blocks[near.not_among(blocks, known, lower, upper, LEAF)]
    assert {*map(tuple, new.tolist())} == {*map(tuple, blocks.tolist())} - {*map(tuple, known.tolist())}


def test_cut_faces_against_numpy():
    rng = np.random.default_rng(4)
    for shape in ((2, 3, 4), (6, 5, 9), (3, 20, 17)):
        sdf = rng.choice(np.array([-0.02, 0.01, 0.06], np.float32), shape)
        for on_floor in (False, True):
            expected = 0
            for axis in range(3):
                layers = np.moveaxis(sdf, axis, 0)
                expected += ((layers[-2] < 0) & (layers[-1] >= np.float32(0.06))).sum()
                if axis < 2 or not on_floor:
                    expected += ((layers[1] < 0) & (layers[0] >= np.float32(0.06))).sum()
            assert kernels.cut_faces(sdf, np.float32(0.06), on_floor) == expected
