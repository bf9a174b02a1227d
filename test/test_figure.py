# SPDX-License-Identifier: Apache-2.0
"""The figure: forward kinematics, its derivatives, its sizes, and distances to its flesh."""

import figure_poses
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbloc_ros.core import _many_parts_kernels as many
from limbloc_ros.core import _surface_fit_kernels as surface_fit
from limbloc_ros.core import figure
from limbloc_ros.core.figure import BONE, SPHERE, FigureState, kernels, part_kernels, place, place_jacobian
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Flesh

MIRROR = np.diag([1.0, -1.0, 1.0])


def mirrored_name(name):
    return name[:-1] + {"L": "R", "R": "L"}[name[-1]] if name[-2:] in ("_L", "_R") else name


def mirrored(state):
    """The same person seen in a mirror in the plane y = 0."""
    swap = [BONE[mirrored_name(name)] for name in figure.BONE_NAMES]
    return FigureState(MIRROR @ state.root, MIRROR @ state.rotations[swap] @ MIRROR, state.shape)


def states(count, seed=0):
    rng = np.random.default_rng(seed)
    return [figure_poses.random_state(rng) for _ in range(count)]


def lengths(placed):
    """Distance of each bone's origin from its parent's."""
    return np.linalg.norm(placed.origins[1:] - placed.origins[figure.PARENTS[1:]], axis=1)


# rotations


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-5, 1.01e-4, 0.3, 2.0, 3.0, np.pi - 1e-9])
def test_exp_and_log_agree_with_scipy(angle):
    rng = np.random.default_rng(3)
    for _ in range(20):
        axis = rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        R = kernels.exp_so3(vector)
        np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(kernels.log_so3(R), vector, atol=2e-8)


def test_log_of_half_turns():
    for axis in (np.eye(3)[0], np.eye(3)[2], np.array([1.0, -1, 0]) / np.sqrt(2), np.array([-1.0, 2, 2]) / 3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(kernels.exp_so3(kernels.log_so3(R)), R, atol=1e-12)


# topology and forward kinematics


def test_bones_and_their_subtrees():
    parents = dict(zip(figure.BONE_NAMES, figure.PARENTS, strict=True))
    assert parents["pelvis"] == -1
    assert all(0 <= parents[name] < BONE[name] for name in figure.BONE_NAMES[1:])  # parents come first
    moving = {figure.BONE_NAMES[b] for b in np.nonzero(figure.SUBTREE[BONE["upper_arm_L"]])[0]}
    assert moving == {"upper_arm_L", "forearm_L", "hand_L"}
    assert figure.SUBTREE[BONE["pelvis"]].all()
    assert figure.N_DOF == 3 * 5 + 2 * (2 + 3 + 1 + 3 + 3 + 1 + 3)


def test_forward_kinematics_against_homogeneous_matrices():
    table = figure.proportions()
    for state in states(5):
        size = np.exp(state.shape[0]) * np.concatenate([[1.0], state.shape[1:]])
        T = []
        for b, parent in enumerate(figure.PARENTS):
            local = np.eye(4)
            local[:3, :3] = state.rotations[b]
            local[:3, 3] = state.root if parent < 0 else table.bone_offsets[b] @ size
            T.append(local if parent < 0 else T[parent] @ local)
        placed = place(state)
        np.testing.assert_allclose(placed.rotations, [t[:3, :3] for t in T], atol=1e-12)
        np.testing.assert_allclose(placed.origins, [t[:3, 3] for t in T], atol=1e-12)
        points = [
            (T[b] @ np.append(offset @ size, 1.0))[:3]
            for b, offset in zip(table.point_bones, table.point_offsets, strict=True)
        ]
        np.testing.assert_allclose(np.concatenate([placed.spheres, placed.joints]), points, atol=1e-12)
        np.testing.assert_allclose(placed.radii, (table.point_radii @ size)[: figure.N_SPHERES], atol=1e-12)


def test_jacobian_against_finite_differences():
    for state in states(4, seed=4):
        J = place_jacobian(state)
        n = J.shape[2]
        assert J.shape == (figure.N_SPHERES + 25, 4, 3 + figure.N_DOF + len(state.shape)) == (len(J), 4, n)

        def placed(step, state=state):
            p = place(state.moved(step))
            radii = np.concatenate([p.radii, np.zeros(25)])
            return np.column_stack([np.concatenate([p.spheres, p.joints]), radii])

        h = 1e-6
        numeric = np.stack([(placed(h * e) - placed(-h * e)) / (2 * h) for e in np.eye(n)], axis=-1)
        assert np.abs(J - numeric).max() < 1e-7


def test_vector_round_trip_is_exact_and_a_copy():
    for state in states(3):
        vector = state.to_vector()
        again = FigureState.from_vector(vector)
        vector[:] = 0.0
        for name in ("root", "rotations", "shape"):
            np.testing.assert_array_equal(getattr(again, name), getattr(state, name))


def test_a_step_turns_only_what_it_names_and_back():
    state = states(1)[0]
    n = 3 + figure.N_DOF + len(state.shape)
    np.testing.assert_array_equal(state.moved(np.zeros(n)).to_vector(), state.to_vector())
    for d, (bone, axis) in enumerate(zip(figure.DOF_BONES, figure.DOF_AXES, strict=True)):
        step = np.zeros(n)
        step[3 + d] = 0.7
        turned = state.moved(step)
        change = state.rotations.transpose(0, 2, 1) @ turned.rotations
        expected = np.tile(np.eye(3), (figure.N_BONES, 1, 1))
        expected[bone] = Rotation.from_rotvec(0.7 * axis).as_matrix()
        np.testing.assert_allclose(change, expected, atol=1e-12)
        np.testing.assert_allclose(turned.moved(-step).to_vector(), state.to_vector(), atol=1e-12)
    np.testing.assert_array_equal(state.rotations, states(1)[0].rotations)  # `moved` leaves the state alone


def test_rotations_stay_orthogonal_over_many_steps():
    rng = np.random.default_rng(5)
    state = states(1)[0]
    for _ in range(2000):
        step = np.zeros(3 + figure.N_DOF + len(state.shape))
        step[3 : 3 + figure.N_DOF] = rng.normal(0, 0.3, figure.N_DOF)
        state = state.moved(step)
    error = state.rotations @ state.rotations.transpose(0, 2, 1) - np.eye(3)
    assert np.abs(error).max() < 1e-11


# symmetry and sizes


def test_mirrored_state_gives_mirrored_person():
    joints = [JOINT[mirrored_name(name)] for name in JOINT_NAMES]
    spheres = [SPHERE[mirrored_name(name)] for name in figure.SPHERE_NAMES]
    for state in states(5, seed=6):
        here, there = place(state), place(mirrored(state))
        np.testing.assert_allclose(there.joints, here.joints[joints] @ MIRROR, atol=1e-9)
        np.testing.assert_allclose(there.spheres, here.spheres[spheres] @ MIRROR, atol=1e-9)
        np.testing.assert_allclose(there.radii, here.radii[spheres], atol=1e-9)


def test_mirrored_parts_exist():
    parts = {tuple(sorted(set(row))) for row in figure.PART_SPHERES.tolist()}
    swap = [SPHERE[mirrored_name(name)] for name in figure.SPHERE_NAMES]
    lopsided = [part for part in parts if tuple(sorted(swap[s] for s in part)) not in parts]
    # the trunk's quadrilaterals are cut along one diagonal only
    assert all(figure.SPHERE_NAMES[s][:-2] in TRUNK_QUADS for part in lopsided for s in part)
    assert set(figure.PART_SPHERES.ravel()) == set(range(figure.N_SPHERES))  # no sphere without a part


TRUNK_QUADS = {"hip", "iliac", "waist", "ribs", "chest", "back", "upper_chest"}


def test_postures_and_places_change_no_size():
    rng = np.random.default_rng(7)
    for state in states(3, seed=8):
        other = FigureState(rng.normal(size=3), Rotation.random(figure.N_BONES, rng=rng).as_matrix(), state.shape)
        np.testing.assert_allclose(lengths(place(other)), lengths(place(state)), atol=1e-12)
        np.testing.assert_array_equal(place(other).radii, place(state).radii)
        flat = place(other)
        for a, b in STICK_BONES:
            bones = {figure.JOINT_BONES[a], figure.JOINT_BONES[b]}
            if len(bones) == 1:
                here, there = (np.linalg.norm(p.joints[JOINT[a]] - p.joints[JOINT[b]]) for p in (place(state), flat))
                assert here == pytest.approx(there)


def test_scale_multiplies_everything_about_the_root():
    state = states(1, seed=9)[0]
    step = np.zeros(len(state.shape))
    step[0] = np.log(1.25)
    small, large = place(state), place(FigureState(state.root, state.rotations, state.shape + step))
    for name in ("origins", "spheres", "joints"):
        np.testing.assert_allclose(getattr(large, name) - state.root, 1.25 * (getattr(small, name) - state.root))
    np.testing.assert_allclose(large.radii, 1.25 * small.radii)


@pytest.mark.parametrize("stature", [1.1, 1.4, 1.7, 2.0])
def test_standing_height_is_the_stature(stature):
    placed = place(FigureState.standing(np.zeros(3), stature=stature))
    top = (placed.spheres[:, 2] + placed.radii).max()
    sole = (placed.spheres[:, 2] - placed.radii).min()
    assert top - sole == pytest.approx(stature, rel=0.03)
    assert placed.joints[JOINT["head_top"], 2] == pytest.approx(top, abs=0.015 * stature)
    assert placed.joints[JOINT["pelvis_centre"], 2] - sole == pytest.approx(0.54 * stature, rel=0.08)


def test_someone_who_stands_at_a_heading_looks_there():
    heading = 0.8
    placed = place(FigureState.standing(np.array([1.0, 2.0, 0.9]), heading=heading))
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    left = np.array([-np.sin(heading), np.cos(heading), 0.0])
    joint = {name: placed.joints[index] for name, index in JOINT.items()}
    for side, sign in (("L", 1), ("R", -1)):
        assert (joint[f"toe_{side}"] - joint[f"heel_{side}"]) @ ahead > 0.15
        for name in ("shoulder", "hip", "knee", "wrist"):
            assert sign * (joint[f"{name}_{side}"] - placed.origins[0]) @ left > 0.05
    assert (placed.spheres[SPHERE["face"]] - placed.spheres[SPHERE["occiput"]]) @ ahead > 0.02


#: Segment lengths over stature (Drillis and Contini: upper arm 0.186 from the acromion, forearm 0.146, hand 0.108,
#: thigh 0.245, shin 0.246, foot 0.152), with room for people, most at
#: the thigh, which the weights of old age shorten.
HUMAN = {
    ("shoulder_L", "elbow_L"): (0.13, 0.19),
    ("elbow_L", "wrist_L"): (0.11, 0.17),
    ("wrist_L", "fingertip_L"): (0.085, 0.125),
    ("hip_L", "knee_L"): (0.16, 0.31),
    ("knee_L", "ankle_L"): (0.20, 0.30),
    ("heel_L", "toe_L"): (0.115, 0.17),
    ("hip_L", "hip_R"): (0.09, 0.165),
    ("shoulder_L", "shoulder_R"): (0.15, 0.26),
    ("pelvis_centre", "neck_base"): (0.26, 0.36),
    ("head_centre", "head_top"): (0.05, 0.10),
}


@pytest.mark.parametrize("stature", [1.1, 1.7, 2.0])
def test_proportions_are_human(stature):
    rng = np.random.default_rng(10)
    for trial in range(60):
        state = FigureState.standing(np.zeros(3), stature=stature)
        if trial:  # the first is the mean
            bare = figure.proportions().clothing_from
            state.shape[1:bare] = np.clip(rng.normal(size=bare - 1), -2, 2)
        placed = place(state)
        for (a, b), (low, high) in HUMAN.items():
            share = np.linalg.norm(placed.joints[JOINT[a]] - placed.joints[JOINT[b]]) / stature
            assert low < share < high, (a, b, share, trial)
        radii = placed.radii / stature
        assert radii.min() > 0.0
        assert 0.04 < radii.max() < 0.09
        height = (placed.spheres[:, 2] + placed.radii).max() - (placed.spheres[:, 2] - placed.radii).min()
        assert height == pytest.approx(stature, rel=0.06)


def test_clothes_make_the_flesh_wider_and_leave_the_skeleton():
    bare = FigureState.standing(np.zeros(3), stature=1.75)
    dressed = FigureState.standing(np.zeros(3), stature=1.75)
    dressed.shape[figure.proportions().clothing_from :] = 1.0
    body, clothes = place(bare), place(dressed)
    np.testing.assert_array_equal(body.joints, clothes.joints)
    np.testing.assert_array_equal(body.spheres, clothes.spheres)
    added = dict(zip(figure.SPHERE_NAMES, clothes.radii - body.radii, strict=True))
    assert added["waist_L"] == pytest.approx(0.0175)  # of a jacket
    assert added["knee_R"] == pytest.approx(0.026)  # of a skirt
    assert added["iliac_L"] == pytest.approx(0.0175 + 0.01)  # under both
    assert {name for name, more in added.items() if more == 0.0} >= {"cranium", "tips_L", "toe_R", "ankle_L"}


def test_the_pivots_of_a_limb_lie_on_one_line_from_which_angles_are_counted():
    joints = place(FigureState.standing(np.zeros(3), stature=1.75)).joints
    for side in "LR":
        for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            first, *later = (joints[JOINT[f"{name}_{side}"]] for name in limb)
            for joint in later:
                np.testing.assert_allclose(joint[:2], first[:2], atol=1e-6)
                assert joint[2] < first[2] - 0.2


def test_the_standard_people_run_from_children_to_adults():
    table = figure.proportions()
    statures = np.exp(table.log_stature_mean + table.log_stature_std * np.array([-2.0, 0.0, 2.0]))
    assert statures[0] < 1.3
    assert 1.45 < statures[1] < 1.75
    assert statures[2] > 1.85


# distances


def family_distance(point, centres, radii):
    """min |p - c(w)| - r(w) over the barycentric weights w, by grids that zoom in (the function is convex)."""
    best, width = np.array([0.5, 0.5]), 0.5
    grid = np.linspace(-1, 1, 25)
    square = np.stack([a.ravel() for a in np.meshgrid(grid, grid)], axis=1)
    for _ in range(7):
        st = np.clip(best + width * square, 0, 1)
        st = np.concatenate([st[st.sum(axis=1) <= 1], np.stack([st[:, 0], 1 - st[:, 0]], axis=1)])
        w = np.column_stack([1 - st.sum(axis=1), st])
        d = np.linalg.norm(point - w @ centres, axis=1) - w @ radii
        best, width = st[d.argmin()], width / 6
    return float(d.min())


PARTS = {
    "triangle": ([[0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0.1]], [0.10, 0.06, 0.12]),
    "equal radii": ([[0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0.1]], [0.1, 0.1, 0.1]),
    "one swallows another": ([[0, 0, 0], [0.05, 0, 0], [0.1, 0.3, 0.1]], [0.20, 0.05, 0.08]),
    "one swallows both": ([[0, 0, 0], [0.05, 0, 0], [0.0, 0.06, 0.02]], [0.20, 0.05, 0.08]),
    "swallowed but for a rim": ([[0, 0, 0], [0.05, 0, 0], [0.05, 0.05, 0]], [0.1, 0.0501, 0.04]),
    "steep in the plane": ([[0, 0, 0], [0.3, 0, 0], [0.0, 0.3, 0.0]], [0.30, 0.08, 0.08]),
    "collinear": ([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]], [0.10, 0.15, 0.08]),
    "collinear, thin middle": ([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]], [0.10, 0.02, 0.08]),
    "collinear, end between": ([[0, 0, 0], [0.4, 0, 0], [0.2, 0, 0]], [0.10, 0.08, 0.15]),
    "two equal centres": ([[0, 0, 0], [0, 0, 0], [0.4, 0, 0]], [0.10, 0.15, 0.08]),
    "all equal": ([[0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0]], [0.10, 0.15, 0.08]),
    "radius zero": ([[0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0.1]], [0.0, 0.0, 0.0]),
}


def part_distance(point, part, centres, radii):
    """Distance of a point to one part, and the weights of the part's second and third sphere."""
    row = np.empty(13)
    part_kernels.lay_out_part(part, centres, radii, row)
    return part_kernels.distance_to_part(row, *point, np.zeros(3))


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0), (0, 1, 1), (2, 2, 2)])
def test_part_distance_against_brute_force(name, order):
    centres, radii = (np.array(x, float) for x in PARTS[name])
    part = np.array(order)
    rng = np.random.default_rng(11)
    points = np.concatenate([rng.uniform(-0.4, 0.6, (16, 3)), centres, centres.mean(axis=0)[None]])
    weights = np.empty(3)
    for point in points:
        d, weights[1], weights[2] = part_distance(point, part, centres, radii)
        weights[0] = 1.0 - weights[1] - weights[2]
        assert d == pytest.approx(family_distance(point, centres[part], radii[part]), abs=2e-6), point
        # the weights name a sphere of the family, and its distance is the one returned
        assert weights.min() >= -1e-12
        assert weights.sum() == pytest.approx(1.0)
        sphere = np.linalg.norm(point - weights @ centres[part]) - weights @ radii[part]
        # (on the part's very axis the root of a difference of products leaves some nanometres)
        assert sphere == pytest.approx(d, abs=2e-8)


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (0, 1, 1), (2, 2, 2)])
def test_many_pairs_at_once_are_what_each_alone_is(name, order):
    """Points and rays, with the gate and without: the same to the last bit."""
    centres, radii = (np.array(x, float) for x in PARTS[name])
    rng, lanes = np.random.default_rng(5), many.LANES
    points, normals, rays = rng.normal(size=(3, lanes, 3)) * [[[0.3]], [[1.0]], [[1.0]]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[::2] = 0.0
    rows = np.empty((1, 13))
    part_kernels.lay_out_part(np.array(order), centres, radii, rows[0])
    facing = np.array([surface_fit.across(n, ray) for n, ray in zip(normals, rays, strict=True)])
    kind = int(rows[0, 0] == 3.0)
    buffers, pairs = np.zeros((2, many.BUFFER)), np.zeros((2, lanes, 2), np.int64)
    for q in range(lanes):
        many.put_pair(buffers, pairs, kind, q, points, facing, rays, q, rows, 0)
    for gate in (0.0, 0.1):
        best, hints, w = np.full(lanes, 1e9), np.full(lanes, -1), np.empty((lanes, 3))
        least, way = np.zeros((lanes, 1), np.float32), np.full(1, 0.25, np.float32)
        many.settle_pairs(buffers, pairs, kind, np.full(2, lanes), gate, best, hints, w, least, way)
        for q in range(lanes):
            plain, gated, wb, wc = surface_fit.gated_distance(rows[0], *points[q], rays[q], *facing[q], gate)
            assert (best[q], hints[q], *w[q]) == (gated, 0, 1.0 - wb - wc, wb, wc)
            assert least[q, 0] == np.float32(plain) + np.float32(0.25)


def test_frustum_worked_by_hand():
    centres, radii = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([0.2, 0.2])
    for point, expected in (
        ((0.5, 0.5, 0.0), 0.3),
        ((-0.5, 0.0, 0.0), 0.3),
        ((0.5, 0.0, 0.0), -0.2),
        ((1.3, 0.4, 0.0), 0.3),
    ):
        assert part_distance(point, np.array([0, 1, 1]), centres, radii)[0] == pytest.approx(expected)


def test_flesh_distance_sign_and_nearest_part():
    flesh = Flesh(
        np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]]),
        np.array([0.3, 0.1, 0.2]),
        np.array([[0, 0, 0], [1, 2, 2]]),
        ("ball", "rod"),
    )
    query = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [1.0, 1.0, 0.05], [3.0, 0, 0], [1.0, -0.3, 0.0]])
    d, nearest = figure.flesh_distance(query, flesh)
    np.testing.assert_allclose(d[[0, 1, 2, 4, 5]], [-0.3, 0.0, 0.2, 1.9, 0.2], atol=2e-2)
    assert d[0] == pytest.approx(-0.3)
    assert d[2] == pytest.approx(0.2)
    assert d[3] == pytest.approx(-0.15)
    assert nearest.tolist() == [0, 0, 0, 1, 1, 1]


def test_flesh_distance_against_every_part_one_by_one():
    # The kernel skips parts by their bounds; nothing may be lost.
    state = states(1, seed=12)[0]
    placed = place(state)
    flesh = placed.flesh()
    rng = np.random.default_rng(13)
    near = placed.spheres[rng.integers(0, figure.N_SPHERES, 300)] + rng.normal(0, 0.08, (300, 3))
    far = state.root + rng.normal(0, 2.0, (50, 3))
    query = np.concatenate([near, far])
    d, nearest = figure.flesh_distance(query, flesh)
    every = np.array([[part_distance(q, part, flesh.centres, flesh.radii)[0] for part in flesh.parts] for q in query])
    outside = every.min(axis=1) > 0
    assert outside.any()
    assert (~outside).sum() > 30
    np.testing.assert_allclose(d, every.min(axis=1), atol=1e-12)
    np.testing.assert_allclose(every[np.arange(len(query)), nearest], d, atol=1e-12)


def test_joints_of_a_standing_person_lie_in_the_flesh():
    placed = place(FigureState.standing(np.zeros(3)))
    inner = [i for i, name in enumerate(JOINT_NAMES) if not name.startswith(("head_top", "fingertip", "toe", "heel"))]
    d, _ = figure.flesh_distance(placed.joints[inner], placed.flesh())
    assert d.max() < 0.0
    d, _ = figure.flesh_distance(placed.joints, placed.flesh())
    assert d.max() < 0.02
