# SPDX-License-Identifier: Apache-2.0
"""What a simulated person does when: a walk into the room, then motion after motion with walks in between.

The whole sequence is laid out once from (person, seed); the pose at time t is then a pure function of t, so that
camera nodes in separate processes draw the same person without talking to each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.simulation import _quaternions as quat
from limbloc_ros.simulation.actions import RATE, Action, all_actions
from limbloc_ros.simulation.person import Person, PosedPerson
from limbloc_ros.simulation.retarget import Retarget

Array = NDArray[np.float64]

#: The default motions of one round; the first three come in this order, the others are shuffled by the seed.
PLAYLIST: tuple[str, ...] = (
    "wave", "arms_up", "dance",
    "reach", "squat", "kick", "sit", "stretch", "twirl", "point", "jump", "t_pose", "punch",
)  # fmt: skip

#: The root stays within this distance of the room's centre once the person has come in, m.
REACH_M = 0.8
#: Where the person comes from: the door, m.
DOOR = np.array([-2.35, 0.0])

_BLEND_S = 0.45
_TURN_RATE = math.radians(130.0)
_WALK_PACE = 0.85  # walks play at this share of the clip's speed


@dataclass(frozen=True)
class _Piece:
    """A stretch of the track in world axes: rotations [F, 13, 4], root on the floor [F, 2] m, height [F] m."""

    name: str
    rotations: Array
    path: Array
    clearance: Array

    def first(self, frames: int) -> _Piece:
        """Its first frames only."""
        return _Piece(self.name, self.rotations[:frames], self.path[:frames], self.clearance[:frames])


class Motion:
    """The motion of one person through time.

    Args:
        person: who moves.
        seed: the order and places of the motions; the same seed gives the same motion.
        empty_s: the room stays empty this long, for the background to be learnt.
        playlist: names of motions (see `motion_names`), repeated for ever.
    """

    def __init__(
        self, person: Person, seed: int = 0, empty_s: float = 1.5, playlist: Sequence[str] | None = None
    ) -> None:
        actions = all_actions()
        order = list(PLAYLIST if playlist is None else playlist)
        unknown = [name for name in order if name not in actions]
        if unknown or not order:
            raise ConfigError(f"playlist: expected some of {', '.join(motion_names())}, got {unknown or 'none at all'}")
        if not (math.isfinite(empty_s) and empty_s >= 0):
            raise ConfigError(f"empty_s: expected 0 or more seconds, got {empty_s}")
        rng = np.random.default_rng(seed)
        if playlist is None:
            order[3:] = rng.permutation(order[3:]).tolist()
        self.person = person
        self.empty_s = float(empty_s)
        self._retarget = Retarget(person, arm_gap_rad=0.20 if person.name == "heavy" else 0.07)
        self._clearances: dict[str, Array] = {}
        self._last: tuple[float, PosedPerson] | None = None
        self._lay_out(order, rng)

    @property
    def duration_s(self) -> float:
        """Seconds from the person's appearance to the end of the first round; later rounds leave out the entrance."""
        return len(self._path) / RATE

    def _frame(self, t: float) -> float | None:
        """The place in the track at time t, in frames; None while the room is empty."""
        since = (t - self.empty_s) * RATE
        if since < 0:
            return None
        loop = len(self._path) - self._loop_start
        return since if since < self._loop_start else self._loop_start + (since - self._loop_start) % loop

    def action(self, t: float) -> str:
        """The name of the motion at time t s; `empty` before the person comes."""
        frame = self._frame(t)
        return "empty" if frame is None else self._names[int(frame)]

    def pose(self, t: float) -> PosedPerson | None:
        """The person at time t s, or None while the room is empty. A pure function of t (the last result is kept)."""
        if self._last is not None and self._last[0] == t:
            return self._last[1]
        frame = self._frame(t)
        if frame is None:
            return None
        n = len(self._path)
        k, share = int(frame), frame - int(frame)
        after = k + 1 if k + 1 < n else self._loop_start
        rotations = quat.mix(self._rotations[k], self._rotations[after], np.full(len(self._rotations[k]), share))
        xy = self._path[k] * (1 - share) + self._path[after] * share
        clearance = self._clearance[k] * (1 - share) + self._clearance[after] * share
        posed = self._grounded(rotations, xy, float(clearance))
        self._last = (t, posed)
        return posed

    def _grounded(self, rotations: Array, xy: Array, clearance: float) -> PosedPerson:
        """Pose the body so that its lowest vertex is `clearance` m above the floor."""
        posed = self.person.pose(self._retarget.bone_rotations(rotations), np.array([xy[0], xy[1], 0.0]))
        return posed.moved([0.0, 0.0, clearance - posed.vertices[:, 2].min()])

    # ---- laying out the track ----

    def _lay_out(self, order: list[str], rng: np.random.Generator) -> None:
        actions = all_actions()
        start = rng.uniform(-0.25, 0.25, 2)
        entrance = self._walk(DOOR, math.atan2(*(start - DOOR)[::-1]), start)
        pieces = [entrance]
        place, heading = entrance.path[-1], float(quat.heading(entrance.rotations[-1, 0]))
        home = (place, heading)
        for name, following in zip(order, [*order[1:], None], strict=True):
            action = actions[name]
            turned = self._best_heading(action, place, heading)
            if abs(_wrapped(turned - heading)) > 0.3:
                pieces.append(self._turn(place, heading, turned))
                heading = float(quat.heading(pieces[-1].rotations[-1, 0]))
            pieces.append(self._place(action, place, heading))
            place, heading = pieces[-1].path[-1], float(quat.heading(pieces[-1].rotations[-1, 0]))
            target = home[0]
            if following is not None:
                # Across the room, and as far from its middle as lets the next motion pass through the middle.
                span = np.linalg.norm(actions[following].path[:, None] - actions[following].path[None], axis=-1).max()
                radius = float(np.clip(span * self.person.leg_m / 2, rng.uniform(0.25, 0.55), 0.7))
                angle = math.atan2(place[1], place[0]) + rng.uniform(0.6 * math.pi, 1.4 * math.pi)
                target = radius * np.array([math.cos(angle), math.sin(angle)])
            pieces.append(self._walk(place, heading, target))
            place, heading = pieces[-1].path[-1], float(quat.heading(pieces[-1].rotations[-1, 0]))
        pieces.append(self._turn(place, heading, home[1]))
        self._take(join_pieces(pieces, home[0]), loop_start=len(pieces[0].path))

    def _take(self, joined: Sequence[_Piece], loop_start: int) -> None:
        """Make the track of these; the part from frame `loop_start` on repeats for ever."""
        self._loop_start = loop_start
        self._rotations = np.concatenate([p.rotations for p in joined])
        self._path = np.concatenate([p.path for p in joined])
        self._clearance = np.concatenate([p.clearance for p in joined])
        self._names = [p.name for p in joined for _ in p.path]
        # End the loop on the pose that comes before its start.
        n, goal = round(_BLEND_S * RATE), self._rotations[self._loop_start - 1]
        share = _smooth(np.linspace(0, 1, n))
        self._rotations[-n:] = quat.mix(self._rotations[-n:], np.tile(goal, (n, 1, 1)), share[:, None])

    def _clearance_of(self, action: Action) -> Array:
        """[F] height of the lowest vertex above the floor: 0 but in jumps, whose root height the clip tells."""
        if action.height is None:
            return np.zeros(len(action.path))
        if action.name not in self._clearances:
            lowest = np.empty(len(action.path))
            for k, rotations in enumerate(action.rotations):
                posed = self.person.pose(self._retarget.bone_rotations(rotations), np.zeros(3))
                lowest[k] = posed.vertices[:, 2].min() + action.height[k] * self.person.leg_m
            # Feet of another shape never stand exactly: call what lies within 4 cm of the usual level the floor.
            above = np.maximum(lowest - np.percentile(lowest, 20) - 0.04, 0.0)
            self._clearances[action.name] = np.convolve(np.pad(above, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
        return self._clearances[action.name]

    def _place(self, action: Action, place: Array, heading: float) -> _Piece:
        """Put a motion into the room; it begins at `place`, looking along `heading`."""
        rotations = action.rotations.copy()
        rotations[:, 0] = quat.multiply(quat.about(2, heading), rotations[:, 0])
        if action.planted:
            path = self._planted(rotations) + place
        else:
            path = action.path @ _rotation(heading).T * self.person.leg_m + place
        return _Piece(action.name, rotations, path, self._clearance_of(action))

    def _planted(self, rotations: Array) -> Array:
        """[F, 2] how the root moves while the middle between the ankles stays, starting at 0."""
        ankles = [self.person.bone("foot.L"), self.person.bone("foot.R")]
        bones = (self._retarget.bone_rotations(q) for q in rotations)
        between = np.array([self.person.pose(b, np.zeros(3)).bone_positions[ankles, :2].mean(0) for b in bones])
        return np.asarray(between[0] - between)

    def _best_heading(self, action: Action, place: Array, heading: float) -> float:
        """The heading, near the present one if possible, with which the motion stays within REACH_M."""
        path = action.path * self.person.leg_m
        best, best_cost = heading, math.inf
        for turn in np.radians(np.arange(-180, 180, 15)):
            far = np.linalg.norm(path @ _rotation(heading + turn).T + place, axis=1).max()
            cost = max(far - REACH_M, 0.0) * 10 + abs(turn) * 0.05
            if cost < best_cost:
                best, best_cost = heading + float(turn), cost
        return best

    def _walk(self, place: Array, heading: float, target: Array) -> _Piece:
        """Walk to `target`, turning on the way like a person: slower when it lies aside."""
        cycle = all_actions()["walk"]
        length = len(cycle.path)
        stride = float(cycle.path[-1, 0]) * self.person.leg_m * (length / (length - 1))
        speed_m = _WALK_PACE * stride / (length / RATE)
        at, phase, pace = np.array(place, dtype=np.float64), 0.0, 0.3
        phases: list[float] = []
        places: list[Array] = []
        headings: list[float] = []
        vigours: list[float] = []
        while len(places) < 20 * RATE:
            way = target - at
            distance = float(np.linalg.norm(way))
            if distance < 0.06:
                break
            error = _wrapped(math.atan2(way[1], way[0]) - heading)
            heading += float(np.clip(error, -_TURN_RATE / RATE, _TURN_RATE / RATE))
            facing = max(math.cos(min(abs(error), math.pi / 2)), 0.0) ** 2
            wanted = (0.25 + 0.75 * min(distance / 0.5, 1.0)) * facing
            pace += float(np.clip(wanted - pace, -0.08, 0.05))
            at = at + pace * speed_m / RATE * np.array([math.cos(heading), math.sin(heading)])
            phase += _WALK_PACE * max(pace, 0.45)
            phases.append(phase % length)
            places.append(at)
            headings.append(heading)
            vigours.append(max(pace, 0.3))
        if not places:
            phases, places, headings, vigours = [0.0], [at], [heading], [0.3]
        return self._stepping("walk", np.array(phases), np.array(places), np.array(headings), np.array(vigours))

    def _turn(self, place: Array, heading: float, wanted: float) -> _Piece:
        """Turn on the spot with small steps."""
        change = _wrapped(wanted - heading)
        n = max(round(abs(change) / _TURN_RATE * RATE * 1.4), 8)
        headings = heading + change * _smooth(np.arange(1.0, n + 1) / n)
        phases = np.arange(float(n)) * _WALK_PACE % len(all_actions()["walk"].path)
        return self._stepping("turn", phases, np.tile(place, (n, 1)), headings, np.full(n, 0.4))

    def _stepping(self, name: str, phases: Array, places: Array, headings: Array, vigours: Array) -> _Piece:
        """The walk cycle at given phases; a vigour below 1 makes smaller steps."""
        walk, stand = all_actions()["walk"].rotations, all_actions()["stand"].rotations[0]
        k = phases.astype(np.int64)
        rotations = quat.mix(walk[k % len(walk)], walk[(k + 1) % len(walk)], (phases - k)[:, None])
        rotations = quat.mix(np.tile(stand, (len(k), 1, 1)), rotations, vigours[:, None])
        lean = quat.multiply(quat.about(2, -quat.heading(rotations[:, 0])), rotations[:, 0])
        rotations[:, 0] = quat.multiply(quat.about(2, headings), lean)
        return _Piece(name, rotations, places, np.zeros(len(k)))


def join_pieces(pieces: Sequence[_Piece], home: Array) -> list[_Piece]:
    """Pieces one after the other, each eased into the next; the last, a turn, slides to `home` [2] m.

    The last step back to the start of the loop is smaller than a foot.
    """
    slide = _smooth(np.linspace(0, 1, len(pieces[-1].path)))[:, None]
    pieces[-1].path[:] += slide * (home - pieces[-1].path[-1])
    joined = [pieces[0]]
    for piece in pieces[1:]:
        joined.append(_eased(joined[-1], piece))
    return joined


def motion_names() -> tuple[str, ...]:
    """The names a playlist may hold."""
    return tuple(sorted(all_actions()))


def _rotation(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _wrapped(angle: float) -> float:
    """The same angle within -pi..pi."""
    return math.remainder(angle, 2 * math.pi)


def _smooth(u: Array) -> Array:
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u * u * (3 - 2 * u))


def _eased(before: _Piece, piece: _Piece) -> _Piece:
    """`piece`, changed at its beginning so that it continues the last pose of `before`: the jump fades away."""
    n = min(round(_BLEND_S * RATE), len(piece.path))
    left = 1 - _smooth(np.arange(1, n + 1) / (n + 1))
    rotations, clearance = piece.rotations.copy(), piece.clearance.copy()
    jump = quat.multiply(before.rotations[-1], quat.inverse(piece.rotations[0]))
    rotations[:n] = quat.multiply(quat.power(np.tile(jump, (n, 1, 1)), left[:, None]), rotations[:n])
    clearance[:n] += left * (before.clearance[-1] - piece.clearance[0])
    return _Piece(piece.name, rotations, piece.path, clearance)
