# SPDX-License-Identifier: Apache-2.0
"""Several people: whose part of the hull is whose, who is a person at all, and that one alone notices nothing."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from typing import Any

import numpy as np
import pytest

from limbloc_ros.core import hull as hulls
from limbloc_ros.core.confidence import CUT_M2, DOUBTFUL
from limbloc_ros.core.config import FitConfig, HullConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import NOBODY, Hull, components, largest_component
from limbloc_ros.core.joint_angles import ContinuousAngles
from limbloc_ros.core.parts import Part, Sight, candidates, divide
from limbloc_ros.core.people import COMPANY_DOUBTFUL, FORGET_S, PERSON, TOUCHING_DOUBTFUL, People
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.pose import JOINT, Pose
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.results import NOT_THERE, Run
from limbloc_ros.recordings.sources import MaskSet
from limbloc_ros.simulation.company import chair, company
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

STEP_NS = 100_000_000
PELVIS = JOINT["pelvis_centre"]


@cache
def room(people: int, together: str, cameras: int = 6, with_chair: bool = False) -> SimulatedRoom:
    things = [chair([(0.0, 0.0, -1.1, 0.3)])] if with_chair else []
    rig = default_rig(cameras, 320, 240)
    return SimulatedRoom(rig, motions=company(people, together, empty_s=0.0), things=things)


def masks(stage: SimulatedRoom, t: float) -> dict[str, np.ndarray]:
    return {name: stage.render_with_mask(name, t)[1] for name in stage.rig.names}


def carved(stage: SimulatedRoom, t: float) -> Hull:
    hull = Carver(stage.rig).carve(masks(stage, t))
    assert isinstance(hull, Hull)
    return hull


def holds(hull: Hull, joints: np.ndarray) -> bool:
    """Whether the middle of somebody's trunk lies inside."""
    index = np.floor(joints[JOINT["torso_centre"]] / hull.voxel_m).astype(int) - hull.index_min
    return bool((index >= 0).all() and (index < hull.sdf.shape).all() and hull.sdf[tuple(index)] < 0)


# --- the hull's parts ---


def test_everybody_has_a_part_of_the_hull_and_phantoms_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three cameras and three people make volume that nobody fills, as large as a person."""
    stage = room(3, "apart", cameras=3)
    true = stage.everybodys_joints(7.5)
    parts = components(carved(stage, 7.5))
    assert sorted(k for part in parts for k in range(3) if holds(part, true[k])) == [0, 1, 2]
    assert len(parts) == 3
    monkeypatch.setattr(hulls, "PHANTOM_SHARE", -1.0)
    with_phantoms = components(carved(stage, 7.5))
    assert len([part for part in with_phantoms if not any(holds(part, joints) for joints in true)]) >= 2


def test_parts_are_what_a_search_over_the_whole_grid_gives() -> None:
    hull = carved(room(3, "apart"), 7.5)
    labels, sizes, _ = hulls._parts(hull)
    assert len(sizes) == 4
    reach = int(np.ceil(hull.band_m / hull.voxel_m))
    for part, label in zip(components(hull), np.argsort(-sizes[1:]) + 1, strict=True):
        box = np.zeros(hull.sdf.shape, bool)
        for i, j, k in np.argwhere(labels == label):
            box[
                max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1, max(k - reach, 0) : k + reach + 1
            ] = 1
        wanted = (hull.sdf < np.float32(hull.band_m)) & box & ((labels == 0) | (labels == label))
        indices, values = part.shell()
        np.testing.assert_array_equal(indices, np.argwhere(wanted) + hull.index_min)
        np.testing.assert_array_equal(values, hull.sdf[wanted])
        assert part.cut_by is not None
        assert hull.cut_by is not None
        np.testing.assert_array_equal(part.cut_by[part.sdf < np.float32(part.band_m)], hull.cut_by[wanted])
    np.testing.assert_array_equal(largest_component(hull).sdf, components(hull)[0].sdf)


def test_small_parts_are_dropped_and_a_single_one_stays_itself() -> None:
    hull = carved(room(2, "apart"), 7.5)
    assert len(components(hull)) == 2
    stage = room(2, "apart")
    strict = Carver(stage.rig, HullConfig(min_further_voxels=50_000)).carve(masks(stage, 7.5))
    assert isinstance(strict, Hull)
    assert components(strict) == [strict]
    np.testing.assert_array_equal(strict.sdf, largest_component(hull).sdf)
    assert candidates(hull, 1)[0].inside_count == strict.inside_count


def test_two_balls_are_cut_apart_half_way() -> None:
    grid = (np.stack(np.meshgrid(*[np.arange(n) for n in (60, 30, 30)], indexing="ij"), -1) + 0.5) * 0.02
    centres = np.array([[0.4, 0.3, 0.3], [0.7, 0.3, 0.3]])
    away = np.linalg.norm(grid[..., None, :] - centres, axis=-1) - 0.2
    sdf = np.minimum(away.min(-1), 0.06).astype(np.float32)
    hull = Hull(
        0.02, (0, 0, 0), sdf, 0.06, cut_by=np.zeros(sdf.shape, np.uint8), viewpoints=np.ones((1, 3), np.float32)
    )
    pieces = divide(hull, [lambda q, c=c: np.linalg.norm(q - c, axis=1) - 0.2 for c in centres])
    for piece, side in zip(pieces, (-1, 1), strict=True):
        assert piece is not None
        indices, values = piece.shell()
        x = (indices[:, 0] + 0.5) * 0.02
        assert (side * (x[values < 0] - 0.55) > -0.01).all()
        assert abs((values < 0).sum() - (sdf < 0).sum() / 2) < 0.02 * (sdf < 0).sum()
        # the cut is a smooth surface of the piece, which no camera made
        border = (np.abs(x - 0.55) < 0.011) & (values > -0.01) & (np.abs(values) < 0.011)
        who = piece.cut_by[piece.sdf < np.float32(0.06)]
        assert border.sum() > 50
        assert (who[border & (values > sdf[tuple(indices.T)])] == NOBODY).all()
    assert divide(hull, [lambda q: np.full(len(q), -1.0), lambda q: np.full(len(q), 1.0)])[1] is None


# --- who is who: a real hull and a real pose, moved about ---


@cache
def somebody() -> tuple[Hull, Pose]:
    seen = Sight.of(carved(room(2, "apart"), 7.5), 2)
    pose = seen.fit(0, PoseEstimator(FitConfig(temporal=True)))
    assert isinstance(pose, Pose)
    assert pose.reliable
    return seen.hulls()[0], pose


def at(x: float, y: float, good: bool = True) -> tuple[Part, Pose]:
    """Somebody's part and pose with the pelvis above (x, y)."""
    hull, pose = somebody()
    shift = np.array([x, y, 0.0]) - pose.joints[PELVIS] * [1, 1, 0]
    state = FigureState.from_vector(pose.parameters)
    moved = FigureState(state.root + shift, state.rotations, state.shape)
    part = Part.of(hull)
    return (
        Part(part.points + shift, part.centre + shift, part.volume_m3),
        dataclasses.replace(
            pose, joints=pose.joints + shift, parameters=moved.to_vector(), reliable=good, risk=1.0 - good
        ),
    )


def sight(*found: tuple[Part, Pose]) -> Sight:
    return Sight(tuple(part for part, _ in found), lambda: pytest.fail("no hull is needed"), tuple(p for _, p in found))


def whereabouts(bodies: tuple) -> dict[int, tuple[float, float]]:
    return {
        body.number: tuple(np.round(body.outcome.joints[PELVIS][:2], 6))
        for body in bodies
        if isinstance(body.outcome, Pose)
    }


class Film:
    """Frames in order through People."""

    def __init__(self, **config: object) -> None:
        self.people, self.frame = People(FitConfig(**config)), 0  # type: ignore[arg-type]

    def show(self, *found: tuple[Part, Pose], skip_s: float = 0.0) -> dict[int, tuple[float, float]]:
        self.frame += 1 + round(skip_s * 1e9) // STEP_NS
        self.bodies = self.people.follow(sight(*found) if found else NoPerson("empty"), self.frame * STEP_NS)
        return whereabouts(self.bodies)


def test_newcomers_are_numbered_after_some_reliable_fits() -> None:
    film = Film()
    assert film.show(at(0, 0)) == {1: (0, 0)}  # alone: at once, as ever
    film.show(at(0, 0))
    for _ in range(PERSON - 1):
        assert film.show(at(0, 0), at(1, 0)) == {1: (0, 0)}
    assert film.show(at(1, 0), at(0, 0)) == {1: (0, 0), 2: (1, 0)}
    assert film.show(at(0, 0), at(1, 0), at(0, 1, good=False)) == {1: (0, 0), 2: (1, 0)}


def test_furniture_is_never_anybody_and_is_looked_at_ever_more_rarely() -> None:
    film = Film()
    film.show(at(0, 0))
    looks = 0
    for _ in range(100):
        found = sight(at(0, 0), at(1, 0, good=False))
        track = film.people._tracks[-1]
        before = track.looked_ns
        film.frame += 1
        assert list(whereabouts(film.people.follow(found, film.frame * STEP_NS))) == [1]
        looks += film.people._tracks[-1].looked_ns != before
    assert looks < 8


def test_furniture_that_was_there_first_makes_room_for_a_person() -> None:
    film = Film()
    for _ in range(5):
        assert film.show(at(0, 0, good=False)) == {1: (0, 0)}  # alone it is shown, but never reliable
    for _ in range(PERSON):
        found = film.show(at(0, 0, good=False), at(1, 0))
    assert found == {1: (1, 0)}
    assert film.show(at(0, 0, good=False)) == {}  # the person has left


def test_people_keep_their_numbers_while_they_cross() -> None:
    film = Film()
    first: dict[float, int] = {}
    for step in range(30):
        x = -1.0 + step / 15
        found = [at(x, 0.25), at(-x, -0.25)]
        where = film.show(*(found if step % 2 else found[::-1]))
        if step >= PERSON:
            assert len(where) == 2
            number = {round(y, 2): n for n, (_, y) in where.items()}
            first = first or number
            assert number == first


def test_a_number_is_kept_for_a_while_and_then_free_again() -> None:
    film = Film()
    for _ in range(4):
        film.show(at(-1, 0), at(1, 0))
    first, second = (number for number, _ in sorted(film.show(at(-1, 0), at(1, 0)).items(), key=lambda item: item[1]))
    assert {first, second} == {1, 2}
    assert film.show(at(-1, 0)) == {first: (-1, 0)}
    assert [isinstance(body.outcome, NoPerson) for body in film.bodies if body.number == second] == [True]
    assert film.show(at(-1, 0), at(1.1, 0), skip_s=0.5)[second] == (1.1, 0)
    film.show(at(-1, 0))
    film.show(at(-1, 0), skip_s=FORGET_S + 0.5)
    assert [body.number for body in film.bodies] == [first]
    for _ in range(PERSON):
        where = film.show(at(-1, 0), at(0, 1))
    assert where == {first: (-1, 0), second: (0, 1)}
    assert film.bodies[0].number == first  # who has been there longest


def test_who_stood_in_the_doorway_is_not_who_comes_in_later(monkeypatch: pytest.MonkeyPatch) -> None:
    resets = []
    monkeypatch.setattr(PoseEstimator, "reset", lambda estimator: resets.append(estimator))
    film = Film(temporal=True)
    part, pose = at(0, 0)
    half: Any = NoPerson("somebody is half outside of the carve volume")
    film.show((part, half))
    film.show((part, half), skip_s=FORGET_S - 0.5)
    assert not resets
    film.show((part, half), skip_s=FORGET_S + 0.5)
    assert len(resets) == 1
    film.show((part, pose))
    film.show((part, pose), skip_s=FORGET_S + 0.5)  # who had a figure keeps it
    assert len(resets) == 1


def test_the_only_person_of_a_room_is_always_the_first() -> None:
    film = Film()
    film.show(at(0, 0))
    assert film.show() == {}
    assert [body.number for body in film.bodies] == [1]
    assert film.show(at(1.4, -1.4), skip_s=60.0) == {1: (1.4, -1.4)}


def test_no_more_than_wanted() -> None:
    film = Film(max_people=2)
    for _ in range(6):
        where = film.show(at(-1, 0), at(1, 0), at(0, 1))
    assert sorted(where) == [1, 2]
    alone = Film(max_people=1)
    assert alone.show(at(-1, 0)) == {1: (-1, 0)}


def test_a_run_goes_on_from_a_snapshot() -> None:
    film, other = Film(), Film()
    story = [[at(-1 + 0.05 * n, 0), at(1, 0), at(0, 1, good=False)][: 1 + n // 2] for n in range(12)]
    expected = [film.show(*frame) for frame in story]
    for n, frame in enumerate(story):
        assert other.show(*frame) == expected[n]
        plain = json.loads(json.dumps(other.people.snapshot()))
        resumed = People(FitConfig())
        resumed.resume(plain)
        assert json.loads(json.dumps(resumed.snapshot())) == plain
        other.people = resumed
    assert [b.outcome.angles for b in film.bodies] == [b.outcome.angles for b in other.bodies]
    with pytest.raises(InputError, match="damaged"):
        People(FitConfig()).resume({"tracks": [{}]})


# --- the whole chain on bodies that the fit did not draw ---


def test_one_person_is_fitted_as_ever() -> None:
    """Bit for bit what the estimator and the angles over time give by themselves."""
    stage = SimulatedRoom(default_rig(6, 320, 240), empty_s=0.0)
    config = FitConfig(temporal=True)
    estimator, angles, people = PoseEstimator(config), ContinuousAngles(), People(config)
    for n, t in enumerate(np.arange(2.0, 2.8, 0.1)):
        hull = carved(stage, float(t))
        expected = angles.follow(estimator.estimate(hull), n * STEP_NS)
        (body,) = people.follow(people.look(hull), n * STEP_NS)
        assert isinstance(expected, Pose)
        assert isinstance(body.outcome, Pose)
        assert body.number == 1
        assert body.outcome.joints.tobytes() == expected.joints.tobytes()
        assert body.outcome.angles == expected.angles


def test_two_who_touch_keep_their_bodies_apart() -> None:
    stage = room(2, "touching")
    people = People(FitConfig(temporal=True))
    shared, owner, errors = 0, {}, []
    for t in np.arange(5.2, 7.0, 0.1):
        seen = people.look(carved(stage, float(t)))
        bodies = people.follow(seen, round(t * 1e9))
        shared += len(seen.parts) == 1
        true = stage.everybodys_joints(float(t))
        for body in bodies:
            if isinstance(body.outcome, Pose) and len(bodies) == 2:
                away = [np.linalg.norm(body.outcome.joints - joints, axis=1).mean() for joints in true]
                assert owner.setdefault(body.number, int(np.argmin(away))) == int(np.argmin(away))
                errors.append(min(away))
    assert shared > 5
    assert sorted(owner) == [1, 2]
    assert sorted(owner.values()) == [0, 1]
    assert np.median(errors) < 0.06, np.round(errors, 3)
    assert np.mean(errors) < 0.09


def test_who_touches_somebody_is_trusted_with_less_doubt_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shared part is cut by where the figures should be: an arm of one may have gone to the other."""
    risk = 0.5 * (TOUCHING_DOUBTFUL + COMPANY_DOUBTFUL)
    somebody()  # is fitted once, for real

    def fit(_: PoseEstimator, hull: Hull, others: tuple = ()) -> Pose:
        centre = Part.of(hull).centre
        return dataclasses.replace(at(centre[0], centre[1])[1], risk=risk)

    monkeypatch.setattr(PoseEstimator, "estimate", fit)
    stage, people, seen = room(2, "touching"), People(FitConfig(temporal=True)), set()
    for t in np.arange(5.2, 7.0, 0.2):
        sight = people.look(carved(stage, float(t)))
        bodies = people.follow(sight, round(t * 1e9))
        if len(bodies) == 2:
            seen |= {(len(sight.parts), body.outcome.reliable, body.outcome.doubt) for body in bodies}
    assert seen == {(2, True, ""), (1, False, "somebody else touches this person")}
    risk = 0.5 * TOUCHING_DOUBTFUL
    assert all(body.outcome.reliable for body in people.follow(sight, round(7e9)))
    risk, sight = 0.5 * (COMPANY_DOUBTFUL + DOUBTFUL), people.look(carved(room(2, "apart"), 7.5))
    people.reset()
    assert len(sight.parts) == 2
    assert not any(body.outcome.reliable for body in people.follow(sight, 0))


def test_who_comes_in_is_searched_when_wholly_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a person is fitted in vain, and three fits in vain make furniture that rests."""
    stage = room(3, "crossing")
    people = People(FitConfig(temporal=True))
    estimate, cut = PoseEstimator.estimate, []

    def fit(self: PoseEstimator, hull: Hull, others: tuple = ()) -> Pose | NoPerson:
        if self is not people.estimator:  # the first is fitted from the start
            cut.append(hull.cut_area_m2)
        return estimate(self, hull, others)

    monkeypatch.setattr(PoseEstimator, "estimate", fit)
    seen_cut = 0
    for t in np.arange(0.6, 1.8, 0.2):
        seen = people.look(carved(stage, float(t)))
        seen_cut += sum(part.cut_area_m2 >= CUT_M2 for part in seen.hulls()[1:])
        people.follow(seen, round(t * 1e9))
    assert seen_cut > 2
    assert cut == [area for area in cut if area < CUT_M2]


def test_a_chair_beside_somebody_is_not_a_person() -> None:
    stage = room(2, "apart", with_chair=True)
    people = People(FitConfig(temporal=True))
    for t in np.arange(4.5, 6.2, 0.1):
        seen = people.look(carved(stage, float(t)))
        bodies = people.follow(seen, round(t * 1e9))
        assert len(seen.parts) == 3
    true = stage.everybodys_joints(float(t))
    assert sorted(body.number for body in bodies) == [1, 2]
    for body in bodies:
        assert isinstance(body.outcome, Pose)
        assert min(np.linalg.norm(body.outcome.joints - joints, axis=1).mean() for joints in true) < 0.05


class Silhouettes:
    """Some instants of a simulated room as a source of the offline run."""

    def __init__(self, stage: SimulatedRoom, times: list[float]) -> None:
        self.rig, self.notes, self.frames = stage.rig, [], len(times)
        self.identity = self.about = {"input": "simulated", "consecutive": True}
        self._sets = [MaskSet(round(t * 1e9), masks(stage, t)) for t in times]

    def mask_sets(self) -> object:
        return iter(self._sets)


def test_offline_any_number_of_jobs_gives_everybody_the_same(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where they touch, for which the parent process carves and fits by itself; and the files hold everybody."""
    monkeypatch.setattr("limbloc_ros.core.people.PERSON", 1)  # frames that are fitted alone take a second each
    source = Silhouettes(room(2, "touching"), [5.0, 5.9, 6.1])
    assert len(components(carved(room(2, "touching"), 6.1))) == 1
    config = OfflineConfig(fit=FitConfig(temporal=False))
    runs = [process(source, config, jobs=jobs) for jobs in (1, 2)]  # type: ignore[arg-type]
    assert runs[0].numbers == (1, 2)
    runs[0].save(tmp_path)
    loaded = Run.load(tmp_path)
    for other in (runs[1], loaded):
        for number in (1, 2):
            np.testing.assert_array_equal(runs[0].of(number).joints, other.of(number).joints)
            np.testing.assert_array_equal(runs[0].of(number).angles, other.of(number).angles)
            assert runs[0].of(number).reasons == other.of(number).reasons
    assert all(frame.number == 1 for frame in loaded.frames)
    table = np.load(tmp_path / "joints.npz")
    assert table["people"].tolist() == ["p1", "p2"]
    assert table["people_joints"].shape == (3, 2, 25, 3)
    np.testing.assert_array_equal(table["people_joints"][:, 0], table["joints"])
    np.testing.assert_array_equal(table["people_joints"][:, 1], np.load(tmp_path / "people/p2/joints.npz")["joints"])
    assert Run.load(tmp_path / "people" / "p2").of(2).frames[-1].outcome != NOT_THERE
