# SPDX-License-Identifier: Apache-2.0
"""Several people: which part of the hull is whose, from frame to frame.

The hull of a room with several people comes in separate parts, one a body, as long as nobody touches anybody; carving
has already dropped parts that are too small and phantoms (`hull._people_among`). Each frame

1. **assigns** parts to tracks. A track predicts where its body is now; the cost of a part is how far the predicted body
   lies from it, and it from the body. The assignment of least total cost (Hungarian method) wins. Several tracks may
   take the same part, at a price: then their bodies touch.
2. **divides** a part that several tracks take. Each voxel goes to the nearest of the predicted flesh figures; the cut
   is the surface half-way between them, which is a signed distance too, so that fits see a closed body.
3. **fits** a figure to what each track got, by a `PoseEstimator` of its own: exactly the chain of a single person.
4. **judges** newcomers. A part that nobody takes begins a track without a number. It is taken for a person when its
   fits have explained it a few times; chairs, tables and boxes never are, and are looked at ever more rarely.

People have numbers 1, 2, ...; a newcomer gets the lowest that is free. A number becomes free when its body has not
been seen for `FORGET_S`; who comes back sooner, near the place, is still the same. The first of the returned bodies is
the one that has been followed longest.

A single body in an empty room is not judged at all: its fit is the result, with its own reliable flag, bit for bit as
with a `max_people` of 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import figure
from limbloc_ros.core.confidence import CUT_M2
from limbloc_ros.core.config import FitConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.joint_angles import ContinuousAngles
from limbloc_ros.core.parts import FURTHER_PARTS, Part, Sight, divide, nearest
from limbloc_ros.core.pipeline import PoseEstimator
from limbloc_ros.core.pose import Flesh, Pose

Array = NDArray[np.float64]

#: A body that has not been seen for so long loses its number, s.
FORGET_S = 2.0
#: A part may be so far from where a body is expected, m, and so much more for each second since it was seen.
GATE_M, GATE_M_S = 0.4, 1.5
#: A body lies within a part that others have taken when it is no further than this from it, m (points are coarse).
WITHIN_M, WITHIN_M_S = 0.10, 0.3
#: Price of sharing a part, m, and how much of the tracks' volumes a shared part must have.
SHARE_M, SHARED_VOLUME = 0.12, 0.6
#: Fits in favour, one after the other, that make a person, and against that make furniture. That is looked at again,
#: from scratch, after REST_S and then after twice as long each time, up to LONGEST_REST_S; sooner, after HASTE_S, when
#: its centre has moved by MOVED_M or its volume changed by this share: somebody who has just come in.
PERSON, FURNITURE = 3, -3
REST_S, LONGEST_REST_S, HASTE_S = 2.0, 16.0, 0.8
MOVED_M, CHANGED = 0.10, 0.10
#: Who had no such fit for so long is no longer taken for a person, s: perhaps it is the chair that somebody left.
DOUBT_S = 10.0
#: Nobody walks faster, m/s; no prediction reaches further, s.
FASTEST_M_S, HORIZON_S = 2.5, 0.5
#: A figure that is that likely wrong need not be a person; one with an arm in the wrong place still is.
NOBODY = 0.5
#: With somebody or something else in the room a figure is only trusted when it is less likely wrong than this, for
#: they hide each other, and there is less to judge by. Less still when several share a part, which was cut apart by
#: guess: an arm of one may have gone to the other. (Of people who touched, 11 of 42 wrong poses were below the usual
#: bound and none below 0.09; of 122 right ones 58, and 45 below 0.06. Of two who crossed at 2.5 Hz, one of one wrong
#: pose was between 0.09 and the usual bound, and none of 96 right ones.)
COMPANY_DOUBTFUL, TOUCHING_DOUBTFUL = 0.09, 0.06
#: Statures of people, m.
STATURES_M = (0.8, 2.3)


@dataclass(frozen=True)
class Body:
    """One person in one frame: the number, and the pose or why there is none."""

    number: int
    outcome: Pose | NoPerson


@dataclass(eq=False)
class _Track:
    """A body, or a piece of furniture, that is followed.

    Attributes:
        number: of the person; 0 while it is not known to be one.
        since_ns, seen_ns: when it was first and last seen.
        state: the figure that was last fitted.
        points, centre, volume_m3: what it last had of the hull; the volume is of frames in which it shared nothing.
        velocity: [3] m/s.
        shared: whether it shared its part when it was last seen.
        score: how many fits in a row were in favour of a person, or (negative) against.
        trusted_ns: when the last one was in favour.
        shown_ns: since when it is among the bodies that are returned.
        looked_ns, looked_at, looked_m3: when, where and in how large a part a figure was last fitted.
        rest_s: how long furniture rests before that is done again.
        outcome: of that fit.
    """

    estimator: PoseEstimator
    angles: ContinuousAngles
    since_ns: int
    seen_ns: int
    points: Array
    centre: Array
    volume_m3: float
    number: int = 0
    state: FigureState | None = None
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    shared: bool = False
    score: int = 0
    trusted_ns: int = 0
    shown_ns: int | None = None
    looked_ns: int | None = None
    looked_at: Array = field(default_factory=lambda: np.zeros(3))
    looked_m3: float = 0.0
    rest_s: float = REST_S
    outcome: Pose | NoPerson = field(default_factory=lambda: NoPerson("not seen yet"))

    def absent_s(self, stamp_ns: int) -> float:
        """How long it has not been seen, s."""
        return abs(stamp_ns - self.seen_ns) * 1e-9

    def shift(self, stamp_ns: int) -> Array:
        """How far it should have moved since it was last seen, m."""
        return self.velocity * min(self.absent_s(stamp_ns), HORIZON_S)

    def flesh(self, stamp_ns: int) -> Flesh | None:
        """Where the figure should be; None for furniture, which has none."""
        if self.state is None or (self.number == 0 and self.score <= 0):
            return None
        moved = FigureState(self.state.root + self.shift(stamp_ns), self.state.rotations, self.state.shape)
        return figure.place(moved).flesh()

    def see(self, part: Part, stamp_ns: int, shared: bool) -> None:
        """Take note of what it has of the hull now."""
        seconds = (stamp_ns - self.seen_ns) * 1e-9
        if shared == self.shared and 0.0 < seconds <= HORIZON_S:  # cutting a hull apart moves its centre
            measured = (part.centre - self.centre) / seconds
            measured *= min(1.0, FASTEST_M_S / max(float(np.linalg.norm(measured)), 1e-9))
            self.velocity = 0.5 * (self.velocity + measured)
        elif seconds > HORIZON_S:
            self.velocity = np.zeros(3)
        if not shared:
            self.volume_m3 = part.volume_m3
        self.points, self.centre, self.shared, self.seen_ns = part.points, part.centre, shared, stamp_ns

    def judge(self, stamp_ns: int, outcome: Pose | NoPerson) -> None:
        """Take note of a fit."""
        if self.score == FURNITURE:
            self.rest_s = REST_S if self._changed() else min(2.0 * self.rest_s, LONGEST_REST_S)
        self.outcome, self.looked_ns = outcome, stamp_ns
        self.looked_at, self.looked_m3 = self.centre, self.volume_m3
        good = False
        if isinstance(outcome, Pose):
            self.state = FigureState.from_vector(outcome.parameters)
            good = outcome.risk < NOBODY and STATURES_M[0] <= outcome.sizes["stature"] <= STATURES_M[1]
        if good:
            self.trusted_ns = stamp_ns
        self.score = min(max(self.score, 0) + 1, PERSON) if good else max(min(self.score, 0) - 1, FURNITURE)

    def trusted(self, company: bool) -> Pose | NoPerson:
        """The outcome of the last fit, not relied on where it is doubtful in company."""
        pose, bound = self.outcome, TOUCHING_DOUBTFUL if self.shared else COMPANY_DOUBTFUL
        if not company or isinstance(pose, NoPerson) or not pose.reliable or pose.risk < bound:
            return pose
        what = "touches this person" if self.shared else "is there, and this figure somewhat in doubt"
        return replace(pose, reliable=False, doubt=f"somebody else {what}")

    def rests(self, stamp_ns: int) -> bool:
        """Furniture need not be looked at in every frame."""
        if self.looked_ns is None:
            return False
        return (stamp_ns - self.looked_ns) * 1e-9 < (HASTE_S if self._changed() else self.rest_s)

    def _changed(self) -> bool:
        moved = float(np.linalg.norm(self.centre - self.looked_at))
        return moved > MOVED_M or abs(self.volume_m3 - self.looked_m3) > CHANGED * self.looked_m3


class People:
    """Follows everybody through a sequence of hulls.

    Args:
        config: `max_people`, and how a figure is fitted.
        consecutive: False for frames that have nothing to do with each other: then the largest body of each is all.
    """

    def __init__(self, config: FitConfig, consecutive: bool = True) -> None:
        self.config = config
        #: Fits whoever comes into an empty room.
        self.estimator = PoseEstimator(config)
        self._consecutive = consecutive
        self._tracks: list[_Track] = []
        #: Taken for a person without proof while there is nobody else.
        self._alone: _Track | None = None

    @property
    def max_people(self) -> int:
        """How many parts of a hull matter."""
        return self.config.max_people if self._consecutive else 1

    def reset(self) -> None:
        """Forget everybody (a new recording, a jump back in time)."""
        self._tracks, self._alone = [], None
        self.estimator.reset()

    def look(self, hull: Hull) -> Sight:
        """What there is to see in a carved hull, for `follow`."""
        return Sight.of(hull, self.max_people)

    def follow(self, sight: Sight | NoPerson, stamp_ns: int) -> tuple[Body, ...]:
        """The bodies in the next frame.

        Args:
            sight: the parts of its hull, or why there is none.
            stamp_ns: its acquisition stamp; stamps must not go back (`reset` first).

        Returns:
            everybody who is followed, the one followed longest first; never empty: who is not seen in this frame is
            there with the reason, and so is the person who is missing from an empty room.
        """
        reason = (
            sight.reason if isinstance(sight, NoPerson) else "the hull holds no voxel: is anybody in the carve volume?"
        )
        if isinstance(sight, NoPerson) or not sight.parts:
            sight = Sight((), list)
        company = len(self._tracks) > 1 or len(sight.parts) > 1
        taken = self._follow_many(sight, stamp_ns) if company else self._follow_one(sight, stamp_ns)
        self._appoint(stamp_ns)
        shown = [track for track in self._tracks if track.number or track is self._alone]
        bodies = []
        for track in shown:
            track.shown_ns = stamp_ns if track.shown_ns is None else track.shown_ns
        for track in sorted(shown, key=lambda track: (track.shown_ns, track.number)):
            outcome: Pose | NoPerson = NoPerson(reason if not sight.parts else "no part of the hull is this person")
            if any(track is other for other in taken):
                outcome = track.trusted(company)
                if self._consecutive:
                    outcome = track.angles.follow(outcome, stamp_ns)
            bodies.append(Body(track.number or 1, outcome))
        return tuple(bodies) or (Body(1, NoPerson(reason)),)

    def _follow_one(self, sight: Sight, stamp_ns: int) -> list[_Track]:
        """Nobody but one: whatever there is, is that."""
        if not sight.parts:
            return []
        if not self._tracks:
            self._tracks.append(self._begin(sight.parts[0], stamp_ns))
        track = self._tracks[0]
        if track.absent_s(stamp_ns) > FORGET_S:
            track.number, track.score = 0, 0
            if track.state is None:  # who stood in the doorway is not who comes in now
                track.estimator.reset()
        if not track.number:
            self._alone = track
        track.see(sight.parts[0], stamp_ns, shared=False)
        track.judge(stamp_ns, sight.fit(0, track.estimator))
        return [track]

    def _follow_many(self, sight: Sight, stamp_ns: int) -> list[_Track]:
        taken: list[_Track] = []
        newcomers: list[tuple[_Track, int]] = []
        fits: list[tuple[_Track, Callable[[], Pose | NoPerson]]] = []
        found = self._assign(sight.parts, stamp_ns)
        for n, part in enumerate(sight.parts):
            claimants = [track for track, m in found if m == n]
            if not claimants:
                if len(self._tracks) < self.max_people + FURTHER_PARTS:
                    claimants = [self._begin(part, stamp_ns)]
                    self._tracks += claimants
                else:
                    continue
            if len(claimants) == 1:
                track = claimants[0]
                track.see(part, stamp_ns, shared=False)
                if self._alone is None and not any(other.number for other in self._tracks):
                    self._alone = track  # the largest part in a room in which nobody is known
                taken.append(track)
                if track is self._alone or track.number or (track.looked_ns is not None and track.score > FURNITURE):
                    fits.append((track, partial(sight.fit, n, track.estimator)))
                elif not track.rests(stamp_ns) and not self._half_inside(sight, n):
                    newcomers.append((track, n))
                continue
            pieces = divide(sight.hulls()[n], [_distance(track, stamp_ns) for track in claimants])
            bodies = [(track, track.flesh(stamp_ns)) for track in claimants]
            for track, piece in zip(claimants, pieces, strict=True):
                if piece is None:
                    continue
                taken.append(track)
                if track.flesh(stamp_ns) is None:  # what is cut off by where furniture stood says nothing new of it
                    track.seen_ns, track.shared = stamp_ns, True
                    continue
                track.see(Part.of(piece), stamp_ns, shared=True)
                others = [flesh for other, flesh in bodies if flesh is not None and other is not track]
                fits.append((track, partial(track.estimator.estimate, piece, others + sight.others(n))))
        # Fits from scratch take as long as many followed frames: one newcomer in each frame, who has waited longest.
        newcomers.sort(key=lambda entry: entry[0].looked_ns or 0)
        for track, n in newcomers[: 1 if self.config.temporal else None]:
            track.estimator.reset()  # what has led astray is of no use
            fits.append((track, partial(sight.fit, n, track.estimator)))
        for (track, _), outcome in zip(fits, _side_by_side([fit for _, fit in fits]), strict=True):
            track.judge(stamp_ns, outcome)
        return taken

    def _half_inside(self, sight: Sight, n: int) -> bool:
        """Whether part n is cut by the carve volume's walls: whoever comes in is searched when wholly there.

        A search is long, and of half a person in vain; three in vain would have the newcomer rest. Where every frame is
        fitted alone, all parts are: the fits may have been done already.
        """
        return self.config.temporal and sight.hulls()[n].cut_area_m2 >= CUT_M2

    def _begin(self, part: Part, stamp_ns: int) -> _Track:
        estimator = PoseEstimator(self.config) if self._tracks else self.estimator
        return _Track(estimator, ContinuousAngles(), stamp_ns, stamp_ns, part.points, part.centre, part.volume_m3)

    def _assign(self, parts: Sequence[Part], stamp_ns: int) -> list[tuple[_Track, int]]:
        """Which track has which part; several may have the same."""
        tracks = self._tracks
        if not tracks or not parts:
            return []
        apart, cost = np.empty((len(tracks), len(parts))), np.empty((len(tracks), len(parts)))
        for t, track in enumerate(tracks):
            flesh = track.flesh(stamp_ns)
            own = track.points + track.shift(stamp_ns) if flesh is None else flesh.centres
            for n, part in enumerate(parts):
                apart[t, n] = nearest(part.points, own).mean()
                back = nearest(own, part.points) if flesh is None else figure.flesh_distance(part.points, flesh)[0]
                cost[t, n] = apart[t, n] + 0.5 * np.maximum(back, 0.0).mean()
        waited = np.array([[min(track.absent_s(stamp_ns), 1.0)] for track in tracks])
        never = 1e3
        first = np.where(apart < GATE_M + GATE_M_S * waited, cost, never)
        again = np.where(apart < WITHIN_M + WITHIN_M_S * waited, cost + SHARE_M, never)
        # What is not known to be a person stands back.
        first += np.array([[0.0 if track.number else 0.05] for track in tracks])
        table = np.concatenate([first] + [again] * (len(tracks) - 1), axis=1)
        chosen = [(r, c % len(parts)) for r, c in _cheapest_pairs(table) if table[r, c] < never]
        return [(tracks[r], n) for r, n in self._not_crowded(chosen, parts, cost)]

    def _not_crowded(self, chosen: list[tuple[int, int]], parts: Sequence[Part], cost: Array) -> list[tuple[int, int]]:
        """A hull is never smaller than what is in it: without a part that cannot hold all who claim it."""
        for n, part in enumerate(parts):
            while True:
                mine = [r for r, m in chosen if m == n]
                needed = sum(self._tracks[r].volume_m3 for r in mine)
                if len(mine) < 2 or part.volume_m3 >= SHARED_VOLUME * needed:
                    break
                chosen.remove((max(mine, key=lambda r: (not self._tracks[r].number, cost[r, n])), n))
        return chosen

    def _appoint(self, stamp_ns: int) -> None:
        """Forget who is gone, give numbers to newcomers."""
        for track in self._tracks:
            if track.number and (stamp_ns - track.trusted_ns) * 1e-9 > DOUBT_S:
                track.number, track.score = 0, FURNITURE
        gone = [track for track in self._tracks if track.absent_s(stamp_ns) > FORGET_S]
        # The last one is kept until somebody else comes: the only person of a room is always the same.
        last = max(self._tracks, key=lambda track: (track.number > 0, track.seen_ns), default=None)
        present = [track for track in self._tracks if track not in gone]
        newcomers = [track for track in present if not track.number and track.score == PERSON]
        others = newcomers or [track for track in present if track.number]
        kept = [track for track in self._tracks if track not in gone or (track is last and not others)]
        for track in self._tracks:
            if track not in kept:
                track.estimator.reset()
        self._tracks = kept
        for track in newcomers:
            used = {other.number for other in self._tracks}
            if self._alone in self._tracks and self._alone is not track and self._alone.score > 0:
                used.add(1)
            track.number = next((number for number in range(1, self.max_people + 1) if number not in used), 0)
        numbered = any(track.number for track in self._tracks)
        if not numbered and len(self._tracks) == 1:
            self._alone = self._tracks[0]
        elif self._alone not in self._tracks or self._alone.number or (numbered and self._alone.score <= 0):
            self._alone = None

    # ---- resuming ----

    def snapshot(self) -> dict[str, Any]:
        """Everything that later frames depend on, as plain values; only for frames that are fitted alone."""
        return {
            "alone": next((n for n, track in enumerate(self._tracks) if track is self._alone), None),
            "tracks": [_plain(track) for track in self._tracks],
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on as if the frames up to a snapshot had just been followed.

        Raises:
            InputError: it is no snapshot.
        """
        try:
            self._tracks = [_track(values, PoseEstimator(self.config)) for values in snapshot["tracks"]]
            self._alone = None if snapshot["alone"] is None else self._tracks[snapshot["alone"]]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"what is kept of the people of an unfinished run is damaged ({error!r})") from None


def _side_by_side(fits: Sequence[Callable[[], Pose | NoPerson]]) -> list[Pose | NoPerson]:
    """Fit several people at the same time: kernels leave the interpreter to others, and no fit depends on another."""
    if len(fits) < 2:
        return [fit() for fit in fits]
    with ThreadPoolExecutor(len(fits)) as pool:
        return list(pool.map(lambda fit: fit(), fits))


def _distance(track: _Track, stamp_ns: int) -> Callable[[Array], Array]:
    """Signed distance [Q], m, of points [Q, 3] to where a track's body should be."""
    flesh = track.flesh(stamp_ns)
    if flesh is not None:
        return lambda query: figure.flesh_distance(query, flesh)[0]
    points = track.points + track.shift(stamp_ns)
    spacing = 0.5 * (track.volume_m3 / max(len(points), 1)) ** (1 / 3)
    return lambda query: nearest(points, query) - spacing


#: What of a track a snapshot holds as it is, and as lists.
_PLAIN = (
    "number",
    "since_ns",
    "seen_ns",
    "volume_m3",
    "shared",
    "score",
    "trusted_ns",
    "shown_ns",
    "looked_ns",
    "looked_m3",
    "rest_s",
)
_ARRAYS = ("points", "centre", "velocity", "looked_at")


def _plain(track: _Track) -> dict[str, Any]:
    values = {name: getattr(track, name) for name in _PLAIN}
    arrays = {name: np.asarray(getattr(track, name)).tolist() for name in _ARRAYS}
    state = None if track.state is None else track.state.to_vector().tolist()
    return {**values, **arrays, "state": state, "angles": track.angles.snapshot()}


def _track(values: Mapping[str, Any], estimator: PoseEstimator) -> _Track:
    fields: dict[str, Any] = {name: values[name] for name in _PLAIN}
    fields |= {name: np.array(values[name], dtype=np.float64) for name in _ARRAYS}
    fields["state"] = None if values["state"] is None else FigureState.from_vector(np.array(values["state"]))
    fields["angles"] = ContinuousAngles()
    fields["angles"].restore(*values["angles"])
    return _Track(estimator=estimator, **fields)


def _cheapest_pairs(table: Array) -> list[tuple[int, int]]:
    """Each row's column, none twice, so that the sum is least; there are as many columns as rows, or more."""
    if len(table) == 1:
        return [(0, int(table[0].argmin()))]
    from scipy.optimize import linear_sum_assignment  # a tenth of a second, for which one person need not wait

    return [(int(r), int(c)) for r, c in zip(*linear_sum_assignment(table), strict=True)]
