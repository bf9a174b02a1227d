# SPDX-License-Identifier: Apache-2.0
"""The visual hull: right on bodies with a known shape; its shell, its walls, its parts."""

import dataclasses
import itertools

import numpy as np
import pytest
from camera_rings import ball_masks, ring, who_cut
from scipy import ndimage

from limbloc_ros.core import hull as hulls
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import NOBODY, Hull, carve, components, largest_component
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.silhouettes import lattice_bounds


def test_ball():
    """The hull holds the ball; in its middle the distance is its radius; more cameras fit it closer."""
    centre, radius, voxel = np.array([0.07, -0.04, 1.02]), 0.45, 0.03
    excess = []
    for count in (3, 4, 6, 8, 12, 16):
        rig = ring(count, focal=220.0, size=(320, 240))
        masks = ball_masks(rig, [(centre, radius)])
        hull = carve(masks, rig, HullConfig(voxel_m=voxel, repair_depth_m=1.0, min_share=0.0))
        assert isinstance(hull, Hull)
        points = hull.origin_m + voxel * np.stack(np.meshgrid(*map(np.arange, hull.sdf.shape), indexing="ij"), axis=-1)
        away = np.linalg.norm(points - centre, axis=-1)
        # Half a pixel is 7 mm here.
        assert (hull.sdf[away < radius - 0.01] < 0).all()
        deepest = hull.sdf[tuple(np.round((centre - hull.origin_m) / voxel).astype(int))]
        assert deepest == pytest.approx(-radius, abs=0.05)
        if count >= 8:
            close = (np.abs(away - radius) < 0.03) & (np.abs(points[..., 2] - centre[2]) < 0.1)
            np.testing.assert_allclose(hull.sdf[close], (away - radius)[close], atol=0.035)
        excess.append(hull.inside_count * voxel**3 / (4 / 3 * np.pi * radius**3))
    assert all(more > less for more, less in itertools.pairwise(excess)), excess
    assert 0.98 < excess[-1] < 1.04 and excess[0] > 1.1


def test_the_area_that_the_volumes_walls_cut():
    """A ball whose centre lies in a wall, or in an edge of two walls, is cut in discs; on the floor it is not cut."""
    rig = ring(12, radius=4.0, focal=220.0, size=(480, 360))
    disc = np.pi * 0.3**2
    balls = ((0.0, 0.0, 1.0), 0.0), ((1.0, 0.0, 1.0), disc), ((0.0, -1.0, 1.0), disc), ((0.0, 0.0, 2.0), disc), \
        ((-1.0, 0.0, 2.0), disc), ((0.0, 0.0, 0.0), 0.0)  # fmt: skip
    for centre, area in balls:
        hull = carve(ball_masks(rig, [(np.array(centre), 0.3)]), rig, HullConfig(voxel_m=0.02, min_share=0.0))
        assert isinstance(hull, Hull)
        assert hull.cut_area_m2 == pytest.approx(area, rel=0.15), centre


def test_shell_rebuilds_the_hull_bit_for_bit():
    hull = carve(ball_masks(ring(6), [((0.0, 0.0, 1.0), 0.4)]), ring(6), HullConfig(voxel_m=0.05, min_voxels=10))
    assert isinstance(hull, Hull)
    indices, values = hull.shell()
    assert indices.dtype == np.int32 and values.dtype == np.float32
    shuffled = np.random.default_rng(0).permutation(len(indices))
    again = Hull.from_shell(0.05, hull.band_m, indices[shuffled], values[shuffled], hull.cameras, hull.rejected)
    assert again.index_min == hull.index_min and again.sdf.dtype == hull.sdf.dtype
    np.testing.assert_array_equal(again.sdf, hull.sdf)
    assert (again.cameras, again.rejected, again.band_m) == (hull.cameras, hull.rejected, hull.band_m)
    # The border is empty, so that surfaces are closed.
    outside = hull.sdf.copy()
    outside[1:-1, 1:-1, 1:-1] = hull.band_m
    assert (outside == np.float32(hull.band_m)).all()


def test_from_shell_says_what_is_wrong():
    none = np.zeros((0, 3), np.int32)
    with pytest.raises(InputError, match="at least one"):
        Hull.from_shell(0.02, 0.06, none, np.zeros(0, np.float32))
    with pytest.raises(InputError, match="as many"):
        Hull.from_shell(0.02, 0.06, np.zeros((2, 3), np.int32), np.zeros(1, np.float32))
    with pytest.raises(InputError, match="too large"):
        Hull.from_shell(0.02, 0.06, np.array([[0, 0, 0], [9000, 9000, 9000]], np.int32), np.zeros(2, np.float32))


def test_the_same_masks_give_the_same_bits():
    rig = ring(8)
    masks = ball_masks(rig, [((0.0, 0.0, 1.0), 0.35), ((0.0, 0.0, 1.5), 0.2)])
    config = HullConfig(voxel_m=0.04, min_voxels=10)
    hulls_seen = {carve({name: masks[name].copy() for name in order}, rig, config).sdf.tobytes()
                  for order in (rig.names, rig.names[::-1], rig.names)}  # fmt: skip
    assert len(hulls_seen) == 1


def hull_of(solid, voxel_m=0.05, band_m=0.1, at=(3, -4, 0)):
    """A hull with distance -1 cm inside and up to the band outside of a boolean grid."""
    away = ndimage.distance_transform_edt(np.pad(~solid, 4, constant_values=True)) * voxel_m - 0.01
    inside = np.pad(solid, 4)
    sdf = np.where(inside, -0.01, np.minimum(away, band_m)).astype(np.float32)
    indices = np.argwhere(sdf < np.float32(band_m)) + np.array(at)
    return Hull.from_shell(voxel_m, band_m, indices.astype(np.int32), sdf[sdf < np.float32(band_m)])


def test_the_warm_up_takes_a_hull_apart(monkeypatch):
    """Else the first frame with a speck beside the person would wait for the compiler."""
    kept, with_parts = [], hulls._with_parts
    monkeypatch.setattr(hulls, "_with_parts", lambda *args: kept.append(args[2]) or with_parts(*args))
    Carver.warm_up.__wrapped__()
    assert len(kept) == 1


def test_largest_component_drops_the_rest_and_its_shell():
    solid = np.zeros((30, 20, 20), bool)
    solid[2:10, 2:12, 2:12] = True
    alone = hull_of(solid)
    solid[20:25, 3:8, 3:8] = True
    both = hull_of(solid)
    assert both.sdf.shape != alone.sdf.shape
    kept = largest_component(both)
    assert kept.index_min == alone.index_min
    np.testing.assert_array_equal(kept.sdf, alone.sdf)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.35, 1.0])
def test_parts_are_numbered_in_the_order_of_their_first_voxels(share):
    solid = np.random.default_rng(3).random((9, 7, 12)) < share
    labels, sizes, boxes = hulls.apart.label_components(np.where(solid, 0.01, 0.03), 0.02)
    np.testing.assert_array_equal(labels, ndimage.label(solid)[0])
    np.testing.assert_array_equal(sizes[1:], np.bincount(labels.ravel())[1:])
    expected = [[[side.start for side in box], [side.stop for side in box]] for box in ndimage.find_objects(labels)]
    assert boxes[1:].tolist() == expected


@pytest.mark.parametrize("reach", [0, 1, 3, 9])
def test_parts_grow_along_all_axes(reach):
    part = np.random.default_rng(reach).random((7, 1, 13)) < 0.03
    grown = ndimage.binary_dilation(part, np.ones((2 * reach + 1,) * 3, bool))
    np.testing.assert_array_equal(hulls.apart.grow_part(part, reach), grown)


def test_largest_component_keeps_who_cut_where_it_was():
    solid = np.zeros((30, 20, 20), bool)
    solid[2:10, 2:12, 2:12] = True
    solid[20:25, 3:8, 3:8] = True
    both = hull_of(solid)
    rows = np.random.default_rng(0).integers(0, 8, both.sdf.shape).astype(np.uint8)
    shell = both.sdf < np.float32(both.band_m)
    viewpoints = np.random.default_rng(1).normal(size=(8, 3)).astype(np.float32)
    both = dataclasses.replace(both, cut_by=np.where(shell, rows, np.uint8(NOBODY)), viewpoints=viewpoints)
    kept = largest_component(both)
    assert kept.sdf.shape != both.sdf.shape
    assert kept.cut_by.shape == kept.sdf.shape
    assert kept.viewpoints is viewpoints
    before = {tuple(index): w for index, w in zip(both.shell()[0].tolist(), who_cut(both)[1], strict=True)}
    indices, who = who_cut(kept)
    assert [before[tuple(index)] for index in indices.tolist()] == who.tolist()
    assert (kept.cut_by[kept.sdf >= np.float32(kept.band_m)] == NOBODY).all()
    # the border stays empty and the hull is what its shell makes
    again = Hull.from_shell(
        kept.voxel_m, kept.band_m, *kept.shell(), cut_by=who_cut(kept)[1], viewpoints=kept.viewpoints
    )
    np.testing.assert_array_equal(again.cut_by, kept.cut_by)


def test_largest_component_keeps_a_single_one_and_bridges_small_gaps():
    solid = np.zeros((30, 12, 12), bool)
    solid[2:10, 2:10, 2:10] = True
    one = hull_of(solid)
    assert largest_component(one) is one
    solid[11:15, 4:8, 4:8] = True  # a gap of one voxel
    two = hull_of(solid)
    assert largest_component(two) is two


@pytest.mark.parametrize(
    ("second", "joined"),
    [
        ([[3, 9], [2, 10], [16, 30]], True),  # 4 voxels of 2 cm above
        ([[7, 22], [2, 10], [16, 30]], True),  # and aside, but above some of it
        ([[14, 22], [2, 10], [16, 30]], False),  # and beside it
        ([[3, 9], [2, 10], [20, 30]], False),  # 16 cm above
        ([[18, 26], [2, 10], [16, 30]], False),
        ([[14, 22], [2, 10], [2, 16]], False),  # beside it, 8 cm away: somebody else
        ([[4, 6], [4, 6], [16, 18]], False),  # too small
    ],
)
def test_a_body_that_masks_cut_in_two_is_one_part(second, joined):
    solid = np.zeros((30, 14, 34), bool)
    solid[2:10, 2:10, 2:12] = True
    (a, b), (c, d), (e, f) = second
    solid[a:b, c:d, e:f] = True
    for mirror in (slice(None), slice(None, None, -1)):  # which of them is found first does not matter
        both = hull_of(solid[:, :, mirror], 0.02, 0.06)
        pieces = components(both)
        assert len(pieces) == (1 if joined else 2)
        assert largest_component(both).inside_count == max(piece.inside_count for piece in pieces)
        assert sum(piece.inside_count for piece in pieces) == both.inside_count


def test_three_pieces_of_one_body_are_one_part():
    solid = np.zeros((30, 14, 44), bool)
    for low in (2, 15, 28):
        solid[2:10, 2:10, low : low + 10] = True
    solid[20:28, 2:10, 2:40] = True  # and somebody else
    assert [piece.inside_count for piece in components(hull_of(solid, 0.02, 0.06))] == [8 * 8 * 38, 3 * 8 * 8 * 10]


def test_both_legs_below_a_trunk_belong_to_it():
    solid = np.zeros((24, 14, 44), bool)
    solid[2:8, 2:10, 2:16] = solid[14:20, 2:10, 2:16] = True  # 12 cm from each other
    solid[2:20, 2:10, 19:40] = True
    for mirror in (slice(None), slice(None, None, -1)):
        both = hull_of(solid[:, :, mirror], 0.02, 0.06)
        (body,) = components(both)
        assert body.inside_count == both.inside_count
        np.testing.assert_array_equal(body.sdf < 0, both.sdf < 0)


def test_a_belt_above_hanging_hands_does_not_cut_a_body_in_two():
    solid = np.zeros((34, 14, 60), bool)
    solid[8:20, 2:12, 2:26] = solid[8:20, 2:12, 30:56] = True  # legs, and a trunk 8 cm above them
    solid[2:6, 4:8, 14:50] = solid[2:8, 4:8, 46:50] = True  # with an arm whose hand hangs lower than the belt
    both = hull_of(solid, 0.02, 0.06)
    (body,) = components(both)
    assert body.inside_count == both.inside_count


def test_lattice_bounds_hold_the_centres_in_the_volume():
    rig = dataclasses.replace(ring(2), volume_min=np.array([-1.0, -0.99, 0.0]), volume_max=np.array([1.0, 1.0, 2.04]))
    low, high = lattice_bounds(rig, 0.1)
    assert low.tolist() == [-10, -10, 0] and high.tolist() == [10, 10, 20]
