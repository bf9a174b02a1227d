# SPDX-License-Identifier: Apache-2.0
"""Joint angles: exact, of the right sign, the same on both sides, and continuous through every pole."""

from pathlib import Path

import numpy as np
import pytest
from figure_poses import fitted_states, pose_of, posed, random_state
from scipy.spatial.transform import Rotation, Slerp

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.figure import BONE, BONE_NAMES, N_DOF, FigureState, place
from limbloc_ros.core.joint_angles import (
    NATIVE_ANGLES,
    ContinuousAngles,
    Range,
    hinge_angle,
    native_angles,
    native_rotations,
    solve_triple,
    turned,
)
from limbloc_ros.core.pose import JOINT, Pose

X, Y, Z = np.eye(3)


def test_there_is_one_angle_per_degree_of_freedom():
    assert len(NATIVE_ANGLES) == N_DOF == 47
    assert len({angle.name for angle in NATIVE_ANGLES}) == 47
    assert sum(angle.bone != "pelvis" for angle in NATIVE_ANGLES) == 44
    assert all(angle.low < 0 < angle.high for angle in NATIVE_ANGLES)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_the_angles_give_the_joints_back(share):
    rng = np.random.default_rng(1)
    for state in [random_state(rng, share) for _ in range(150)]:
        placed = place(state)
        angles = native_angles(placed.rotations, shape=state.shape)
        again = place(FigureState(state.root, native_rotations(angles), state.shape))
        assert np.abs(again.joints - placed.joints).max() < 1e-9


def test_the_angles_of_real_fits_give_the_joints_back_even_with_a_mean_clavicle():
    for state in fitted_states():
        placed = place(state)
        angles = native_angles(placed.rotations)
        again = place(FigureState(state.root, native_rotations(angles), state.shape))
        assert np.abs(again.joints - placed.joints).max() < 1e-3
        outside = [a.name for a in NATIVE_ANGLES if not a.low - 0.3 < angles[a.name] < a.high + 0.3]
        assert not outside


# What each angle does to a person who stands at the origin and looks along x: angle, degrees, (from joint, to joint),
# the direction in which the second then lies from the first. For the left side; the right is its mirror image.
DOWN, FORWARD, LEFT, UP = -Z, X, Y, Z
MOTIONS = [
    ("shoulder_flexion", 90, ("shoulder", "elbow"), FORWARD),
    ("shoulder_flexion", -45, ("shoulder", "elbow"), DOWN - FORWARD),
    ("shoulder_flexion", 180, ("shoulder", "wrist"), UP),
    ("shoulder_abduction", 90, ("shoulder", "wrist"), LEFT),
    ("shoulder_abduction", 150, ("shoulder", "wrist"), LEFT + np.sqrt(3) * UP),
    ("elbow_flexion", 90, ("elbow", "wrist"), FORWARD),
    ("elbow_flexion", 135, ("elbow", "wrist"), FORWARD + UP),
    ("hip_flexion", 90, ("hip", "knee"), FORWARD),
    ("hip_abduction", 60, ("hip", "ankle"), np.sqrt(3) * LEFT + DOWN),
    ("knee_flexion", 90, ("knee", "ankle"), -FORWARD),
]


@pytest.mark.parametrize("side", "LR")
@pytest.mark.parametrize(("motion", "degrees", "joints", "direction"), MOTIONS)
def test_a_limb_goes_where_its_angle_says(side, motion, degrees, joints, direction):
    joint, _, kind = motion.partition("_")
    state = posed({f"{joint}_{side}_{kind}": degrees})
    placed = place(state)
    a, b = (placed.joints[JOINT[f"{name}_{side}"]] for name in joints)
    want = direction * [1, 1 if side == "L" else -1, 1]
    np.testing.assert_allclose((b - a) / np.linalg.norm(b - a), want / np.linalg.norm(want), atol=1e-9)
    found = native_angles(placed.rotations, shape=state.shape)
    assert np.degrees(found[f"{joint}_{side}_{kind}"]) == pytest.approx(degrees, abs=0.01)
    others = [abs(value) for name, value in found.items() if name != f"{joint}_{side}_{kind}"]
    assert max(others) < 1e-6


# The same for what turns about its own length or moves only little: angle, bends before, the joint, the way it moves.
MOVES = [
    ("shoulder_{}_rotation", {"elbow_{}_flexion": 90}, "wrist", LEFT),
    ("hip_{}_rotation", {"knee_{}_flexion": 90}, "ankle", -LEFT),  # the knee turns outward, the foot behind it inward
    ("forearm_{}_pronation", {}, "fingertip", -FORWARD),  # the bent fingers point inward, pronated to the back
    ("wrist_{}_flexion", {}, "fingertip", -LEFT),  # palms face the thighs
    ("wrist_{}_deviation", {}, "hand", FORWARD),  # thumbs are in front
    ("ankle_{}_dorsiflexion", {}, "toe", UP),
    ("ankle_{}_rotation", {}, "toe", LEFT),
    ("ankle_{}_inversion", {}, "heel", -LEFT),  # soles turn inward
    ("clavicle_{}_elevation", {}, "shoulder", UP),
    ("clavicle_{}_protraction", {}, "shoulder", FORWARD),
]


@pytest.mark.parametrize("side", "LR")
@pytest.mark.parametrize(("angle", "bends", "joint", "way"), MOVES, ids=lambda value: str(value)[:20])
def test_a_small_turn_moves_the_joint_the_right_way(side, angle, bends, joint, way):
    bends = {name.format(side): degrees for name, degrees in bends.items()}
    before, after = (place(posed(bends | {angle.format(side): degrees})) for degrees in (0, 20))
    way = way * [1, 1 if side == "L" else -1, 1]
    moved = (after.joints - before.joints)[JOINT[f"{joint}_{side}"]]
    assert moved @ way > 0.7 * np.linalg.norm(moved) > 0.005
    assert np.degrees(native_angles(after.rotations)[angle.format(side)]) == pytest.approx(20, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "joint", "way"),
    [
        *((f"spine_{part}_flexion", "head_top", FORWARD) for part in ("lower", "middle", "upper")),
        *((f"spine_{part}_bend", "head_top", -LEFT) for part in ("lower", "middle", "upper")),
        *((f"spine_{part}_rotation", "shoulder_R", FORWARD) for part in ("lower", "middle", "upper")),
        ("neck_flexion", "head_top", FORWARD),
        ("neck_bend", "head_top", -LEFT),
        ("neck_rotation", "head_centre", LEFT),
        ("pelvis_heading", "hip_R", FORWARD),
        ("pelvis_tilt", "head_top", FORWARD),
        ("pelvis_list", "hip_R", DOWN),
    ],
)
def test_the_trunk_turns_the_right_way(name, joint, way):
    before, after = (place(posed({name: degrees})) for degrees in (0, 15))
    moved = (after.joints - before.joints)[JOINT[joint]]
    assert moved @ way > 0.7 * np.linalg.norm(moved) > 0.003
    assert np.degrees(native_angles(after.rotations)[name]) == pytest.approx(15, abs=1e-6)


def test_a_mirrored_posture_has_the_same_limb_angles_on_the_other_side():
    rng = np.random.default_rng(2)
    M = np.diag([1.0, -1.0, 1.0])
    other = [BONE[b[:-2] + {"_L": "_R", "_R": "_L"}[b[-2:]]] if b[-2:] in ("_L", "_R") else BONE[b] for b in BONE_NAMES]
    for _ in range(30):
        R = place(random_state(rng, 0.7)).rotations
        plain, mirrored = native_angles(R), native_angles(M @ R[other] @ M)
        for angle in NATIVE_ANGLES:
            name, sign = angle.name, 1.0
            for here, there in (("_L_", "_R_"), ("_R_", "_L_")):
                if here in name:
                    name = name.replace(here, there)
                    break
            else:
                sign = 1.0 if name.endswith(("flexion", "tilt")) else -1.0
            assert mirrored[name] == pytest.approx(sign * plain[angle.name], abs=1e-9)


def frames_of(key_postures, steps):
    """Postures [F, B, 3, 3] that pass smoothly through key rotations of bones in their parents."""
    times = np.arange(len(key_postures))
    at = np.linspace(0, times[-1], steps)
    slerps = [Slerp(times, Rotation.from_matrix([k[b] for k in key_postures])) for b in range(len(BONE_NAMES))]
    return np.stack([slerp(at).as_matrix() for slerp in slerps], axis=1)


def followed(frames, **options):
    """The angles over the frames, each from the one before, as an array [F, 47]."""
    last, rows = None, []
    for rotations in frames:
        placed = place(FigureState(np.zeros(3), rotations, FigureState.standing(np.zeros(3)).shape))
        last = native_angles(placed.rotations, last, **options)
        rows.append(list(last.values()))
        again = place(FigureState(np.zeros(3), native_rotations(last), FigureState.standing(np.zeros(3)).shape))
        assert np.abs(again.joints - placed.joints).max() < 1e-3
    return np.array(rows)


@pytest.mark.parametrize("tilt_deg", [0.0, 1e-7, 0.05])
def test_the_shoulder_stays_continuous_straight_through_its_pole(tilt_deg):
    """Both arms rise at the sides, from hanging to overhead: the pole is the arm held out level."""
    keys = [
        posed({f"shoulder_{s}_{m}": v for s in "LR" for m, v in (("abduction", a), ("flexion", tilt_deg))}).rotations
        for a in (0, 60, 120, 175)
    ]
    angles = followed(frames_of(keys, 121))
    assert np.abs(np.diff(angles, axis=0)).max() < np.radians(2.0)
    names = [angle.name for angle in NATIVE_ANGLES]
    assert np.degrees(angles[-1, names.index("shoulder_L_abduction")]) == pytest.approx(175, abs=0.1)


def test_a_trembling_arm_at_the_pole_does_not_spin_its_angles():
    rng = np.random.default_rng(3)
    keys = [posed({"shoulder_L_abduction": 90, "shoulder_L_flexion": 20}).rotations for _ in range(80)]
    for rotations in keys:
        rotations[BONE["upper_arm_L"]] = rotations[BONE["upper_arm_L"]] @ exp_so3(rng.normal(0, 1e-4, 3))
    names = [angle.name for angle in NATIVE_ANGLES]
    columns = [names.index(f"shoulder_L_{m}") for m in ("flexion", "rotation")]
    alone = [native_angles(place(FigureState(np.zeros(3), k, np.zeros(11))).rotations) for k in keys]
    free = np.array([list(angles.values()) for angles in alone])
    held = followed(keys)
    assert np.abs(np.diff(free[:, columns], axis=0)).max() > 0.5
    assert np.abs(np.diff(held[:, columns], axis=0)).max() < 0.05


def test_slow_motions_jump_only_at_a_pole_or_back_into_the_human_range():
    """Random smooth motions, wilder than people's; whatever happens on the way, hanging arms read zero at the end."""
    rng = np.random.default_rng(4)
    names = [angle.name for angle in NATIVE_ANGLES]
    jumps = 0
    for _ in range(6):
        keys = [posed({}).rotations, *(random_state(rng, 0.8).rotations for _ in range(2)), posed({}).rotations]
        for posture in keys:  # the pelvis only turns about the vertical here: somersaults are another matter
            posture[0] = exp_so3(np.array([0.0, 0.0, rng.uniform(-1, 1)]))
        angles = followed(frames_of(keys, 300))
        assert np.abs(angles[-1, 1:]).max() < np.radians(1e-3)
        for frame, column in np.argwhere(np.abs(np.diff(angles, axis=0)) > np.radians(25)):
            joint = names[column].rpartition("_")[0]
            assert joint.startswith("shoulder"), names[column]
            abduction = angles[frame : frame + 2, names.index(f"{joint}_abduction")]
            near_pole = np.abs(np.cos(abduction)).min() < np.sin(np.radians(8))
            rows = [k for k, name in enumerate(names) if name.startswith(joint)]
            strayed = any(not NATIVE_ANGLES[k].low - 0.5 < angles[frame, k] < NATIVE_ANGLES[k].high + 0.5 for k in rows)
            assert near_pole or strayed, (names[column], np.degrees(angles[frame : frame + 2, rows]))
            jumps += 1
    assert jumps > 0  # otherwise the motions are too tame to test anything


def test_the_heading_counts_whole_turns_over_time():
    turns = np.linspace(0, 3 * 2 * np.pi, 100)
    frames = np.tile(posed({}).rotations, (100, 1, 1, 1))
    frames[:, 0] = Rotation.from_rotvec(np.outer(turns, Z)).as_matrix()
    np.testing.assert_allclose(followed(frames)[:, 0], turns, atol=1e-6)


def test_lying_down_passes_the_pole_of_the_pelvis_without_a_jump():
    tilts = np.linspace(0, 110, 80)
    frames = np.array([posed({"pelvis_heading": 30, "pelvis_tilt": tilt}).rotations for tilt in tilts])
    angles = followed(frames)
    assert np.abs(np.diff(angles, axis=0)).max() < np.radians(2)


@pytest.mark.parametrize("order", ["yxz", "zxz", "zxy", "xyx"])
def test_triples_agree_with_scipy(order):
    rng = np.random.default_rng(5)
    axes = np.array([np.eye(3)["xyz".index(letter)] for letter in order])
    ranges = [Range(-np.pi, np.pi)] * 3
    for R in Rotation.random(200, random_state=rng):
        found = solve_triple(R.as_matrix(), axes, ranges)
        np.testing.assert_allclose(turned(axes, found), R.as_matrix(), atol=1e-12)
        reference = R.as_euler(order.upper())
        middle = np.pi - reference[1] if order[0] != order[2] else -reference[1]
        other = [reference[0] + np.pi, middle, reference[2] + np.pi]
        apart = [np.abs(np.exp(1j * found) - np.exp(1j * np.array(r))).max() for r in (reference, other)]
        assert min(apart) < 1e-9


def test_a_held_triple_is_off_by_at_most_half_the_slack():
    rng = np.random.default_rng(6)
    axes, ranges = np.array([Z, X, Z]), [Range(-np.pi, np.pi)] * 3
    for _ in range(300):
        last = rng.uniform(-1, 1, 3) * [3, 0.3, 3]
        R = turned(axes, last + rng.normal(0, 0.3, 3))
        found = turned(axes, solve_triple(R, axes, ranges, last, slack=0.06))
        assert np.linalg.norm(np.cross(found @ Z, R @ Z)) <= 0.5 * 0.06 + 1e-9
    np.testing.assert_allclose(solve_triple(turned(axes, last), axes, ranges, last, 0.06), last, atol=1e-12)


def test_a_hinge_takes_the_nearest_angle():
    assert hinge_angle(exp_so3(-1.2 * Y), -Y) == pytest.approx(1.2)
    assert hinge_angle(exp_so3(1.2 * Y) @ exp_so3(0.1 * X), Y) == pytest.approx(1.2, abs=0.01)


def test_the_wrong_number_of_bones_is_refused():
    with pytest.raises(ValueError, match=r"rotations of 19 bones.*got an array \[5, 3, 3\]"):
        native_angles(np.tile(np.eye(3), (5, 1, 1)))


def test_the_documentation_lists_every_angle_with_its_axis_and_range():
    rows = {}
    for line in (Path(__file__).parents[1] / "docs" / "model.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 6 and cells[0].startswith("`") and cells[1].startswith("`"):
            rows[cells[0].strip("`")] = cells
    for angle in NATIVE_ANGLES:
        row = rows[angle.name.replace("_L_", "_S_").replace("_R_", "_S_")]
        axis = f"{'-+'[sum(angle.axis) > 0]}{'xyz'[int(np.argmax(np.abs(angle.axis)))]}"
        left, _, right = row[2].partition(" ")
        assert axis == (right.strip("()") if "_R_" in angle.name and right else left), angle.name
        assert row[3:5] == [angle.description, angle.sign]
        span = "any" if angle.continuous else f"{np.degrees(angle.low):.0f} to {np.degrees(angle.high):.0f}"
        assert row[5] == span, angle.name
    assert len(rows) == sum("_R_" not in angle.name for angle in NATIVE_ANGLES)


def test_a_pose_carries_the_angles_in_order():
    pose = pose_of(posed({"knee_L_flexion": 30}))
    assert tuple(pose.angles) == tuple(angle.name for angle in NATIVE_ANGLES)


def turning_person(degrees: float) -> Pose:
    return pose_of(FigureState.standing(np.zeros(3), np.radians(degrees), 1.7))


def heading(outcome: Pose | NoPerson) -> float:
    assert isinstance(outcome, Pose)
    return float(np.degrees(outcome.angles["pelvis_heading"]))


def test_angles_of_a_sequence_do_not_jump_where_a_frame_alone_would():
    angles, frame_ns = ContinuousAngles(), 40_000_000
    alone = [heading(turning_person(d)) for d in range(0, 800, 20)]
    assert max(np.abs(np.diff(alone))) > 300
    followed = []
    for n, degrees in enumerate(range(0, 800, 20)):
        if n % 7 == 3:  # a frame without a pose between others changes nothing
            assert isinstance(angles.follow(NoPerson("hidden"), n * frame_ns), NoPerson)
            continue
        followed.append(heading(angles.follow(turning_person(degrees), n * frame_ns)))
        assert followed[-1] == pytest.approx(degrees, abs=0.01)
    assert followed[-1] > 700


def test_angles_start_anew_after_a_long_gap_and_a_reset():
    angles = ContinuousAngles()
    for n in range(20):
        last = angles.follow(turning_person(20.0 * n), n * 40_000_000)
    assert heading(last) == pytest.approx(380, abs=0.01)
    assert heading(angles.follow(turning_person(20.0), 3_000_000_000)) == pytest.approx(20, abs=0.01)
    angles.resume(last, 3_040_000_000)
    assert heading(angles.follow(turning_person(30.0), 3_080_000_000)) == pytest.approx(390, abs=0.01)
    angles.reset()
    assert heading(angles.follow(turning_person(30.0), 3_120_000_000)) == pytest.approx(30, abs=0.01)
