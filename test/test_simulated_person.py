# SPDX-License-Identifier: Apache-2.0
"""Simulated people and how they move: a closed body, joints in it, natural motions without jumps."""

from __future__ import annotations

import numpy as np
import pytest

from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.simulation import _quaternions as quat
from limbloc_ros.simulation.motion import PLAYLIST, Motion, motion_names
from limbloc_ros.simulation.person import PERSON_NAMES, Person, baked, load_person
from limbloc_ros.simulation.retarget import LINK, LINKS, Retarget
from limbloc_ros.simulation.room import default_rig

TIMES = np.arange(1.6, 60.0, 1.37)


@pytest.fixture(scope="module")
def man_motion() -> Motion:
    return Motion(load_person("man"), seed=0)


def neutral(**links: np.ndarray) -> np.ndarray:
    """Link rotations of a straight body, but for some links."""
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(LINKS), 1))
    for name, q in links.items():
        rotations[LINK[name]] = q
    return rotations


def pose(name: str = "man", **links: np.ndarray) -> dict[str, np.ndarray]:
    """Joints by name of a person whose root bone stands 1 m above the origin."""
    person = load_person(name)
    posed = person.pose(Retarget(person).bone_rotations(neutral(**links)), [0, 0, 1])
    return dict(zip(JOINT_NAMES, posed.joints, strict=True))


# ---- person ----


@pytest.mark.parametrize("name", PERSON_NAMES)
def test_a_person_is_a_closed_body_of_plausible_size(name: str) -> None:
    person = load_person(name)
    assert 1.2 < person.stature_m < 1.9
    a, b, c = (person.vertices[person.faces[:, k]] for k in range(3))
    litres = 1000 * np.einsum("ij,ij->", a, np.cross(b, c)) / 6  # positive: faces are counter-clockwise from outside
    assert 15 < litres / person.stature_m**2 < 40  # a density of 1 kg a litre makes this the body mass index
    np.testing.assert_allclose(person.skin_weights.sum(1), 1.0, atol=1e-9)
    assert (person.bone_parents[1:] < np.arange(1, len(person.bone_names))).all()
    # Rest pose: looks along x, left is +y, soles on the floor.
    assert person.rest_joint("toe_L")[0] > person.rest_joint("heel_L")[0] + 0.1
    assert person.rest_joint("hand_L")[1] > 0.2 > -0.2 > person.rest_joint("hand_R")[1]
    assert abs(person.vertices[:, 2].min()) < 0.01


def test_people_differ_as_their_names_say() -> None:
    people = {name: load_person(name) for name in PERSON_NAMES}
    assert people["child"].stature_m < people["woman"].stature_m < people["man"].stature_m

    def girth(name: str) -> float:
        person = people[name]
        waist = np.abs(person.vertices[:, 2] - person.rest_joint("torso_centre")[2]) < 0.08
        return float(np.ptp(person.vertices[waist & (np.abs(person.vertices[:, 1]) < 0.25), 0]) / person.stature_m)

    assert girth("heavy") > 1.15 * girth("woman")


def test_people_of_a_file_without_clothes_are_bare() -> None:
    arrays = {key: value for key, value in baked("people.npz").items() if key != "garments"}
    for index, name in enumerate(arrays["names"].tolist()):
        bare, dressed = Person.from_arrays(f"person {index}", arrays, index), load_person(name)
        assert bare.name == f"person {index}"
        assert (bare.garments < 0).all() and bare.garments.shape == dressed.garments.shape
        assert (dressed.garments > 0).any()
        for key in ("vertices", "bone_heads", "joint_rest", "skin_weights"):
            np.testing.assert_array_equal(getattr(bare, key), getattr(dressed, key))


def test_skinning_equals_its_plain_reference() -> None:
    person = load_person("woman")
    rng = np.random.default_rng(0)
    links = np.stack([quat.multiply(quat.about(1, a), quat.about(2, b)) for a, b in rng.uniform(-1, 1, (13, 2))])
    rotations, root = Retarget(person).bone_rotations(links), np.array([0.3, -0.2, 0.9])
    posed = person.pose(rotations, root)
    position = np.zeros((len(person.bone_names), 3))
    position[0] = root
    for bone, parent in enumerate(person.bone_parents):
        if parent >= 0:
            position[bone] = position[parent] + rotations[parent] @ (
                person.bone_heads[bone] - person.bone_heads[parent]
            )
    wanted = np.zeros_like(person.vertices)
    for k in range(4):
        bone = person.skin_bones[:, k]
        moved = position[bone] + np.einsum("vij,vj->vi", rotations[bone], person.vertices - person.bone_heads[bone])
        wanted += person.skin_weights[:, k : k + 1] * moved
    np.testing.assert_allclose(posed.vertices, wanted, atol=1e-12)
    np.testing.assert_allclose(posed.bone_positions, position, atol=1e-12)


def test_identity_rotations_give_the_rest_pose() -> None:
    person = load_person("child")
    posed = person.pose(np.tile(np.eye(3), (len(person.bone_names), 1, 1)), person.bone_heads[0])
    np.testing.assert_allclose(posed.vertices, person.vertices, atol=1e-12)
    np.testing.assert_allclose(posed.joints, person.joint_rest, atol=1e-12)


def test_bad_requests_for_a_person_say_what_was_expected() -> None:
    with pytest.raises(InputError, match="man, woman, child, heavy, got 'dog'"):
        load_person("dog")
    with pytest.raises(InputError, match=r"expected shape \(34, 3, 3\)"):
        load_person("man").pose(np.eye(3)[None], [0, 0, 0])


# ---- retarget ----


@pytest.mark.parametrize("name", PERSON_NAMES)
def test_zero_is_a_straight_body_with_hanging_arms(name: str) -> None:
    j = pose(name)
    for side, left in (("L", 1), ("R", -1)):
        for upper, lower in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
            bone = j[f"{lower}_{side}"] - j[f"{upper}_{side}"]
            assert bone[2] / np.linalg.norm(bone) < -0.98
        assert left * j[f"shoulder_{side}"][1] > 0.1
        assert j[f"toe_{side}"][0] > j[f"heel_{side}"][0]


@pytest.mark.parametrize(("side", "left"), [("L", 1.0), ("R", -1.0)])
def test_links_bend_the_right_way_and_only_their_own_side(side: str, left: float) -> None:
    other = "R" if side == "L" else "L"
    straight = pose()
    elbow = pose(**{f"elbow_{side}": quat.about(1, -np.pi / 2)})
    forearm = elbow[f"wrist_{side}"] - elbow[f"elbow_{side}"]
    assert forearm[0] / np.linalg.norm(forearm) > 0.98
    knee = pose(**{f"knee_{side}": quat.about(1, np.pi / 2)})
    shin = knee[f"ankle_{side}"] - knee[f"knee_{side}"]
    assert shin[0] / np.linalg.norm(shin) < -0.98
    raised = pose(**{f"shoulder_{side}": quat.about(0, left * np.pi / 2)})
    arm = raised[f"elbow_{side}"] - raised[f"shoulder_{side}"]
    assert left * arm[1] / np.linalg.norm(arm) > 0.98
    for joint in ("elbow", "wrist", "knee", "ankle", "shoulder"):
        for bent in (elbow, knee, raised):
            np.testing.assert_allclose(bent[f"{joint}_{other}"], straight[f"{joint}_{other}"], atol=1e-12)


def test_palms_face_the_thighs() -> None:
    person = load_person("man")
    posed = person.pose(Retarget(person).bone_rotations(neutral()), [0, 0, 1])
    j = dict(zip(JOINT_NAMES, posed.joints, strict=True))
    hand = posed.vertices[np.array(person.bone_names)[person.skin_bones[:, 0]] == "wrist.L"]
    # A hand is flat: its thinnest direction is the palm's normal. It must point sideways, not forward.
    _, _, axes = np.linalg.svd(hand - hand.mean(0))
    assert abs(axes[2][1]) > 0.6
    # The thumb points forward: the knuckles' side of the hand reaches further to the front than to the back.
    assert hand[:, 0].max() - j["hand_L"][0] > j["hand_L"][0] - hand[:, 0].min()


# ---- motion ----


def test_the_room_is_empty_first_then_somebody_walks_in() -> None:
    motion = Motion(load_person("man"), empty_s=2.0)
    assert motion.pose(0.0) is None
    assert motion.pose(1.999) is None
    assert motion.action(1.0) == "empty"
    first = motion.pose(2.0)
    assert first is not None
    assert motion.action(2.0) == "walk"
    assert first.joints[JOINT["pelvis_centre"], 0] < -2.0  # at the door
    later = motion.pose(8.0)
    assert later is not None
    assert np.linalg.norm(later.joints[JOINT["pelvis_centre"], :2]) < 1.0


@pytest.mark.parametrize("name", PERSON_NAMES)
def test_bone_lengths_never_change_and_joints_stay_in_the_body(name: str) -> None:
    motion = Motion(load_person(name), seed=1)
    pairs = [("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")]
    index = np.array([[JOINT[f"{a}_{s}"], JOINT[f"{b}_{s}"]] for a, b in pairs for s in "LR"])
    lengths = []
    for t in TIMES:
        posed = motion.pose(t)
        assert posed is not None
        lengths.append(np.linalg.norm(posed.joints[index[:, 0]] - posed.joints[index[:, 1]], axis=1))
        low, high = posed.vertices.min(0), posed.vertices.max(0)
        assert (posed.joints > low - 0.01).all()
        assert (posed.joints < high + 0.01).all()
    # A limb is two bones in line, whose axial twist differs: at most a millimetre off that line.
    assert np.ptp(lengths, axis=0).max() < 1e-3
    np.testing.assert_allclose(lengths[0][::2], lengths[0][1::2], rtol=0.02)


@pytest.mark.parametrize("name", PERSON_NAMES)
def test_joints_lie_inside_the_skin(name: str) -> None:
    motion = Motion(load_person(name), seed=1)
    for t in TIMES[::8]:
        posed = motion.pose(t)
        assert posed is not None
        # The winding number: how much of the sphere around a point the mesh covers, 1 inside and 0 outside.
        corners = posed.vertices[motion.person.faces][None] - posed.joints[:, None, None]
        a, b, c = (corners[:, :, k] / np.linalg.norm(corners[:, :, k], axis=-1, keepdims=True) for k in range(3))
        top = np.einsum("jfi,jfi->jf", a, np.cross(b, c))
        bottom = 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1)
        winding = np.arctan2(top, bottom).sum(1) / (2 * np.pi)
        for joint, inside in zip(JOINT_NAMES, winding, strict=True):
            if joint.startswith(("head_top", "fingertip", "toe", "heel")):  # taken from the skin of a finer mesh
                nearest = np.linalg.norm(posed.vertices - posed.joints[JOINT[joint]], axis=1).min()
                assert inside > 0.5 or nearest < 0.03, (joint, t)
            else:
                assert inside > 0.5, (joint, t, motion.action(t))


def test_somebody_who_does_not_jump_touches_the_floor(man_motion: Motion) -> None:
    highest = {}
    for t in np.arange(1.6, man_motion.duration_s, 0.1):
        posed = man_motion.pose(t)
        assert posed is not None
        lowest = posed.vertices[:, 2].min()
        assert lowest > -1e-9
        highest[man_motion.action(t)] = max(highest.get(man_motion.action(t), 0.0), float(lowest))
        if man_motion.action(t) in ("wave", "squat", "sit", "reach", "arms_up", "t_pose"):
            for side in "LR":
                assert posed.joints[JOINT[f"ankle_{side}"], 2] < 0.16
    assert highest["jump"] > 0.15
    for action in ("wave", "squat", "sit", "reach", "stretch", "point", "dance"):
        assert highest[action] < 0.1, action


def test_feet_stay_where_they_are_during_planted_motions(man_motion: Motion) -> None:
    times = [t for t in np.arange(1.6, man_motion.duration_s, 1 / 30) if man_motion.action(t) == "squat"]
    ankles = np.array([man_motion.pose(t).joints[[JOINT["ankle_L"], JOINT["ankle_R"]], :2] for t in times[20:]])
    assert np.ptp(ankles, axis=0).max() < 0.06


def test_the_motion_has_no_jumps_not_even_where_it_repeats(man_motion: Motion) -> None:
    # A fast kick reaches 13 m/s; a swapped limb or a teleport would be 20 m/s and more.
    step = 1 / 60
    times = np.arange(man_motion.empty_s, man_motion.empty_s + man_motion.duration_s + 3, step)
    joints = np.array([man_motion.pose(t).joints for t in times])
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(1) / step
    assert speed.max() < 13.0
    around_the_seam = np.abs(times[:-1] - man_motion.empty_s - man_motion.duration_s) < 0.3
    assert around_the_seam.sum() > 20
    assert speed[around_the_seam].max() < 5.0  # the next motion may start at once


@pytest.mark.parametrize("seed", range(4))
def test_the_person_stays_within_the_carve_volume(seed: int) -> None:
    rig = default_rig()
    motion = Motion(load_person("man"), seed=seed)
    inside = []
    for t in np.arange(6.0, 90.0, 0.5):
        joints = motion.pose(t).joints
        inside.append((joints > rig.volume_min) & (joints < rig.volume_max))
        pelvis = joints[JOINT["pelvis_centre"], :2]
        assert np.linalg.norm(pelvis) < 1.0
    assert np.mean(inside) > 0.995


def test_a_pose_is_a_pure_function_of_time_and_seed() -> None:
    person = load_person("woman")
    a, b, other = Motion(person, seed=5), Motion(person, seed=5), Motion(person, seed=6)
    forwards = [a.pose(t).joints for t in TIMES]
    backwards = [b.pose(t).joints for t in TIMES[::-1]][::-1]
    np.testing.assert_array_equal(forwards, backwards)
    assert np.abs(np.array([other.pose(t).joints for t in TIMES]) - forwards).max() > 0.3


def test_every_motion_of_the_playlist_is_played(man_motion: Motion) -> None:
    played = {man_motion.action(t) for t in np.arange(1.6, man_motion.duration_s, 0.2)}
    assert played == {*PLAYLIST, "walk", "turn"}
    wave = Motion(load_person("man"), playlist=["wave"])
    assert {wave.action(t) for t in np.arange(1.6, 30, 0.2)} <= {"wave", "walk", "turn"}
    assert "wave" in motion_names()
    for bad, message in ((["fly"], "fly"), ([], "none at all")):
        with pytest.raises(ConfigError, match=message):
            Motion(load_person("man"), playlist=bad)
    with pytest.raises(ConfigError, match="empty_s"):
        Motion(load_person("man"), empty_s=-1.0)


def test_waving_raises_the_right_hand_only() -> None:
    motion = Motion(load_person("man"), playlist=["wave"])
    times = [t for t in np.arange(1.6, 12, 0.1) if motion.action(t) == "wave"]
    joints = np.array([motion.pose(t).joints for t in times])
    head = joints[:, JOINT["head_centre"], 2]
    assert (joints[:, JOINT["wrist_R"], 2] > head).any()
    assert (joints[:, JOINT["wrist_L"], 2] < joints[:, JOINT["shoulder_L"], 2]).all()
