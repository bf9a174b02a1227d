# SPDX-License-Identifier: Apache-2.0
"""Several people in one room: who they are and what they do together; and a chair that is pushed about.

Each person follows a course: steps such as `go` to a place, `face` a direction, `do` a motion, wait `until` a time. As
for a person alone, everything is a pure function of the arguments and the time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.simulation import _quaternions as quat
from limbloc_ros.simulation.actions import RATE, all_actions
from limbloc_ros.simulation.motion import Motion, join_pieces
from limbloc_ros.simulation.person import PERSON_NAMES, Person, load_person

Array = NDArray[np.float64]

#: What several people do. `apart`: everybody at a place of their own. `crossing`: they walk past each other, 0.7 m
#: between the lanes. `touching`: the first two meet in the middle, shoulder to shoulder, and part again.
TOGETHER = ("apart", "crossing", "touching")
#: Most people in a room.
MOST = 4

#: They come in and stand at this distance from the middle, m, each from an own side.
_FAR_M, _HOME_M = 2.2, 0.95
_SIDES_DEG = {1: (180,), 2: (180, 0), 3: (180, 45, 315), 4: (180, 0, 90, 270)}
#: Between the middles of two people who touch, and from the middle to a lane, m.
_TOUCH_M, _LANE_M = 0.46, 0.35
#: Done in place, with the feet where they are.
_PLANTED = ("wave", "reach", "squat", "point", "stretch", "arms_up", "t_pose")
#: A crossing takes this long, everybody's turn included, s.
_SLOT_S = 5.0

Step = tuple[str, float] | tuple[str, str] | tuple[str, tuple[float, float]]


class Course(Motion):
    """A person who follows steps; the whole course repeats after its end, without the entrance.

    Args:
        person: who.
        steps: the first is the entrance, `("from", (x, y))` and then `("go", (x, y))`; then any of `("go", (x, y))`,
            `("face", rad)`, `("do", name of a motion)`, `("until", s)`: stand until so long after the appearance.
        seed, empty_s: as for Motion.
    """

    def __init__(self, person: Person, steps: Sequence[Step], seed: int = 0, empty_s: float = 1.5) -> None:
        self._steps = tuple(steps)
        super().__init__(person, seed, empty_s, ["stand"])

    def _lay_out(self, order: list[str], rng: np.random.Generator) -> None:
        actions = all_actions()
        (_, begin), (_, home), *steps = self._steps
        place, target = np.array(begin, dtype=np.float64), np.array(home, dtype=np.float64)
        pieces = [self._walk(place, math.atan2(*(target - place)[::-1]), target)]
        start = (pieces[0].path[-1], float(quat.heading(pieces[0].rotations[-1, 0])))
        for what, value in [*steps, ("go", tuple(start[0])), ("face", start[1])]:
            place, heading = pieces[-1].path[-1], float(quat.heading(pieces[-1].rotations[-1, 0]))
            if what == "go":
                pieces.append(self._walk(place, heading, np.array(value, dtype=np.float64)))
            elif what == "face":
                assert isinstance(value, float)
                pieces.append(self._turn(place, heading, value))
            elif what == "do":
                pieces.append(self._place(actions[str(value)], place, heading))
            else:
                assert isinstance(value, float)
                missing = round(value * RATE) - sum(len(piece.path) for piece in pieces)
                stand = actions["stand"]
                while missing > 0:
                    piece = self._place(stand, place, heading)
                    pieces.append(piece.first(missing))
                    missing -= len(pieces[-1].path)
        self._take(join_pieces(pieces, start[0]), loop_start=len(pieces[0].path))


def company(people: int, together: str, seed: int = 0, empty_s: float = 1.5, person: str = "man") -> tuple[Motion, ...]:
    """The motions of several people in one room.

    Args:
        people: 1 to MOST; one alone does what Motion does by itself.
        together: one of TOGETHER.
        seed: of what they do in which order.
        empty_s: the room stays empty this long.
        person: the first; the others are the other PERSON_NAMES in order.

    Raises:
        ConfigError: a number or a word out of range.
    """
    if not 1 <= people <= MOST:
        raise ConfigError(f"people: expected 1 to {MOST}, got {people}")
    if together not in TOGETHER:
        raise ConfigError(f"together: expected one of {', '.join(TOGETHER)}, got {together!r}")
    names = [person, *(name for name in PERSON_NAMES if name != person)][:people]
    rng = np.random.default_rng([seed, 23])
    courses = []
    sides = _SIDES_DEG[MOST if together == "crossing" else people]  # lanes are at right angles
    for k, name in enumerate(names):
        side = math.radians(sides[k])
        at = np.array([math.cos(side), math.sin(side)])
        home = (float(_HOME_M * at[0]), float(_HOME_M * at[1]))
        entrance: list[Step] = [("from", (float(_FAR_M * at[0]), float(_FAR_M * at[1]))), ("go", home)]
        steps = [*entrance, *_steps(together, k, home, side, rng)]
        courses.append(Course(load_person(name), steps, seed, empty_s))
    return tuple(courses)


def _steps(together: str, k: int, home: tuple[float, float], side: float, rng: np.random.Generator) -> list[Step]:
    inwards = math.remainder(side + math.pi, 2 * math.pi)
    planted: list[Step] = [("do", str(name)) for name in rng.permutation(_PLANTED)]
    if together == "apart" or (together == "touching" and k > 1):
        return [("until", 4.0), ("face", inwards), *planted]
    if together == "crossing":
        # Two cross while the others wait: the lanes of the first two run along x, those of the others along y.
        axis = np.array([math.cos(side), math.sin(side)])
        lane = _LANE_M * np.array([-axis[1], axis[0]])
        near, far = _HOME_M * axis + lane, -_HOME_M * axis + lane
        turn = 4.0 + (_SLOT_S if k > 1 else 0.0)
        steps: list[Step] = [("go", (float(near[0]), float(near[1])))]
        for back_and_forth in range(2):
            steps += [
                ("until", turn + 4 * _SLOT_S * back_and_forth),
                ("go", (float(far[0]), float(far[1]))),
                ("until", turn + 4 * _SLOT_S * back_and_forth + 2 * _SLOT_S),
                ("go", (float(near[0]), float(near[1]))),
            ]
        return [*steps, ("until", 4.0 + 8 * _SLOT_S)]
    # side by side, both looking along y
    meet = (math.copysign(_TOUCH_M / 2, home[0]), 0.0)
    before = (math.copysign(_TOUCH_M / 2 + 0.25, home[0]), -0.45)
    once: list[Step] = [("go", before), ("go", meet), ("face", math.pi / 2)]
    return [
        ("until", 4.0), *once, ("until", 10.0), ("go", home), ("face", inwards), ("until", 15.0), planted[0],
        ("until", 20.0), *once, ("until", 26.0), ("go", home), ("face", inwards), ("until", 31.0),
    ]  # fmt: skip


@dataclass(frozen=True)
class Thing:
    """A piece of furniture that is pushed about.

    Attributes:
        vertices: [V, 3] m, at rest around the origin of the floor. faces: int32 [F, 3], counter-clockwise from outside.
        bgr: its colour.
        places: (s since the start, x, y in m, heading in rad), in order; it is not there before the first, moves
            evenly from each to the next, and stays at the last.
    """

    vertices: Array
    faces: NDArray[np.int32]
    bgr: tuple[int, int, int]
    places: tuple[tuple[float, float, float, float], ...]

    def at(self, t: float) -> Array | None:
        """[V, 3] m, world, at time t s; None while it is not there."""
        table = np.array(self.places)
        if t < table[0, 0]:
            return None
        x, y, heading = (float(np.interp(t, table[:, 0], table[:, c])) for c in (1, 2, 3))
        c, s = math.cos(heading), math.sin(heading)
        turned = self.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(turned + np.array([x, y, 0.0]))


def chair(places: Sequence[tuple[float, float, float, float]]) -> Thing:
    """A wooden chair: a seat 46 cm high, a back of 95 cm, four legs."""
    boxes = [
        ((-0.23, -0.23, 0.40), (0.23, 0.23, 0.46)),
        ((-0.23, -0.23, 0.46), (-0.18, 0.23, 0.95)),
        *(((x, y, 0.0), (x + 0.05, y + 0.05, 0.40)) for x in (-0.23, 0.18) for y in (-0.23, 0.18)),
    ]
    return boxes_thing(boxes, (60, 96, 140), places)


def boxes_thing(
    boxes: Sequence[tuple[tuple[float, ...], tuple[float, ...]]],
    bgr: tuple[int, int, int],
    places: Sequence[tuple[float, float, float, float]],
) -> Thing:
    """A thing made of boxes, each given by its lower and its upper corner, m."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    sides = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]], dtype=np.int32,
    )  # fmt: skip
    vertices = [np.array(low) + corners * (np.array(high) - np.array(low)) for low, high in boxes]
    faces = [sides + np.int32(8 * k) for k in range(len(boxes))]
    return Thing(np.concatenate(vertices), np.concatenate(faces), bgr, tuple(places))
