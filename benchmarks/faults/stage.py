# SPDX-License-Identifier: Apache-2.0
"""The simulated room as a stage: the person comes and goes on cue, furniture is moved in, the lights change."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.pose import JOINT
from limbloc_ros.simulation.motion import Motion
from limbloc_ros.simulation.person import Person, PosedPerson, load_person
from limbloc_ros.simulation.room import SimulatedRoom

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Posture = Callable[[PosedPerson], PosedPerson]

#: Corners and outward triangles of the unit cube.
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
_SIDES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]], dtype=np.int32,
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Prop:
    """A thing of boxes: vertices [V, 3] m in world axes, triangles [F, 3], coloured as one of the person's clothes."""

    vertices: Array
    faces: NDArray[np.int32]
    garment: int

    def moved(self, offset: Array) -> Prop:
        """The same thing elsewhere."""
        return dataclasses.replace(self, vertices=self.vertices + offset)


def boxes(*corners: tuple[tuple[float, float, float], tuple[float, float, float]], garment: int) -> Prop:
    """A thing made of boxes, each given by its lower and upper corner, m; `garment` is a column of GARMENTS."""
    vertices = [np.array(low) + _CORNERS * (np.array(high) - np.array(low)) for low, high in corners]
    faces = [_SIDES + 8 * k for k in range(len(corners))]
    return Prop(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), garment)


#: How fast the person moves, of life: at five images a second as far from image to image as in life at ten.
PACE = 0.5
#: In the room he paces slowly from side to side, m and s, standing relaxed: a posture that is followed without errors,
#: so that those that are seen come from the faults.
SWAY_M, SWAY_S = 0.35, 12.0

#: The guest walks in and stands beside him, so far away, m.
GUEST_AWAY_M = np.array([0.0, 1.0, 0.0])

#: A chair with a seat at 45 cm and a back of 95 cm, beside the middle of the room.
CHAIR = boxes(
    ((-0.22, -0.22, 0.40), (0.22, 0.22, 0.46)),
    ((-0.22, 0.18, 0.46), (0.22, 0.22, 0.95)),
    *(((x, y, 0.0), (x + 0.04, y + 0.04, 0.40)) for x in (-0.22, 0.18) for y in (-0.22, 0.18)),
    garment=1,
)
#: A parcel of 40 x 30 x 30 cm.
BOX = boxes(((-0.15, -0.20, -0.15), (0.15, 0.20, 0.15)), garment=2)


def lying(posed: PosedPerson) -> PosedPerson:
    """On the back on the floor."""
    turn = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    middle = posed.joints.mean(axis=0)
    vertices = (posed.vertices - middle) @ turn.T
    floor = np.array([0.0, 0.0, -vertices[:, 2].min()])
    joints = (posed.joints - middle) @ turn.T
    return PosedPerson(vertices + floor, joints + floor, turn @ posed.bone_rotations, posed.bone_positions)


def at(x: float, y: float) -> Posture:
    """The same motion with the pelvis above (x, y), m."""

    def move(posed: PosedPerson) -> PosedPerson:
        here = posed.joints[JOINT["pelvis_centre"]]
        return posed.moved([x - here[0], y - here[1], 0.0])

    return move


class _Shown:
    """Stands in for the room's Motion: what is on the stage now, whatever the time."""

    def __init__(self, mesh: PosedPerson | None) -> None:
        self.mesh = mesh

    def pose(self, _: float) -> PosedPerson | None:
        return self.mesh


class Stage(SimulatedRoom):
    """A room whose play is directed while it runs.

    Attributes:
        time_s: where on the way in from the door the person is; `pace` says how fast he goes on (negative: backwards,
            and out). Once inside he stays in that posture and sways.
        posture: changes the person before he is drawn, or None.
        chair: where a chair stands on the floor [2], m, or None. box: whether the person carries one.
        light: what the cameras' images go through, or None.
        guest_pace: how fast a second person goes on her way in (negative: out).
        guest_joints: [25, 3] where she is, m, or None.
    """

    def __init__(self, rig: Rig, motions: tuple[str, ...], seed: int = 0) -> None:
        super().__init__(rig, "man", seed, empty_s=1.0, playlist=motions)
        self.script: Motion = self.motion
        self.body, self._body_tone = self.person, self._tone
        self.time_s, self.pace, self._inside_s = 0.0, 0.0, 0.0
        self.posture: Posture | None = None
        self.chair: tuple[float, float] | None = None
        self.box = False
        self.light: Callable[[Image], Image] | None = None
        self.entered_s = _entered_s(self.script)
        self.guest = Motion(load_person("woman"), seed + 1, empty_s=1.0, playlist=motions)
        self.guest_time_s, self.guest_pace, self.guest_entered_s = 0.0, 0.0, _entered_s(self.guest)
        self.guest_joints: Array | None = None

    def enter(self) -> None:
        """The person is in the room at once."""
        self.time_s, self.pace = self.entered_s, 0.0

    def leave(self) -> None:
        """The person walks out of the door, backwards."""
        self.pace = -PACE

    def come_in(self) -> None:
        """And comes in again."""
        self.time_s, self.pace = self.script.empty_s, PACE

    def clear(self) -> None:
        """Nobody and nothing is there."""
        self.time_s, self.pace = 0.0, 0.0
        self.posture, self.chair, self.box = None, None, False
        self.guest_time_s, self.guest_pace = 0.0, 0.0

    def shoot(self, seconds: float, clock_s: float) -> tuple[dict[str, Image], Array | None]:
        """Let `seconds` pass; all cameras' images and the true joints [25, 3], None while nobody is there.

        `clock_s` is the time of day, which the noise and the drift of the light depend on.
        """
        self.time_s = min(max(self.time_s + self.pace * seconds, 0.0), self.entered_s)
        posed = self.script.pose(self.time_s)
        if posed is not None and self.time_s == self.entered_s:
            self._inside_s += seconds
            posed = posed.moved([0.0, SWAY_M * math.sin(2 * math.pi * self._inside_s / SWAY_S), 0.0])
        else:
            self._inside_s = 0.0
        if posed is not None and self.posture is not None:
            posed = self.posture(posed)
        self.guest_time_s += self.guest_pace * seconds
        self.guest_time_s = min(max(self.guest_time_s, 0.0), self.guest_entered_s)
        guest = self.guest.pose(self.guest_time_s)
        guest = None if guest is None else guest.moved(GUEST_AWAY_M)
        self.guest_joints = None if guest is None else guest.joints.copy()
        self._show(posed, guest)
        images = {name: self.render(name, clock_s) for name in self.rig.names}
        if self.light is not None:
            images = {name: self.light(image) for name, image in images.items()}
        return images, None if posed is None else posed.joints.copy()

    def _show(self, posed: PosedPerson | None, guest: PosedPerson | None) -> None:
        """Put people and things on the stage as one mesh, which is what the renderer draws."""
        drawn: list[tuple[Array, NDArray[np.int32], Array, Array, Array]] = []
        if posed is not None:
            drawn.append(_worn(posed, self.body, self._body_tone))
        if guest is not None:
            drawn.append(_worn(guest, self.guest.person, np.ones(len(guest.vertices))))
        if self.chair is not None:
            drawn.append(_plain(CHAIR.moved(np.array([*self.chair, 0.0]))))
        if self.box and posed is not None:
            drawn.append(_plain(BOX.moved(posed.joints[JOINT["torso_centre"]] + 0.28 * _forward(posed))))
        self._instant = None
        if not drawn:
            self.motion = _Shown(None)  # type: ignore[assignment]
            return
        first = np.cumsum([0, *(len(vertices) for vertices, *_ in drawn)])
        mesh = np.concatenate([vertices for vertices, *_ in drawn])
        faces = np.concatenate([row[1] + n for row, n in zip(drawn, first, strict=False)])
        self.person = dataclasses.replace(
            self.body, vertices=mesh, faces=faces.astype(np.int32), garments=np.concatenate([row[2] for row in drawn])
        )
        self._tone = np.concatenate([row[3] for row in drawn])
        self._stripe = np.concatenate([row[4] for row in drawn])
        nothing = np.zeros((0, 3))
        self.motion = _Shown(PosedPerson(mesh, nothing, np.zeros((0, 3, 3)), nothing))  # type: ignore[assignment]


def _worn(posed: PosedPerson, body: Person, tone: Array) -> tuple[Array, NDArray[np.int32], Array, Array, Array]:
    """Vertices, faces, garments, tones and stripes of somebody."""
    return posed.vertices, body.faces, body.garments, tone, body.vertices[:, 2]


def _plain(thing: Prop) -> tuple[Array, NDArray[np.int32], Array, Array, Array]:
    """The same of a thing."""
    count = len(thing.vertices)
    worn = np.full((count, 4), -1.0)
    worn[:, thing.garment] = 1.0
    return thing.vertices, thing.faces, worn, np.ones(count), np.full(count, 0.5)


def _entered_s(script: Motion) -> float:
    """Where in the motion somebody has come in."""
    times = np.arange(script.empty_s, script.empty_s + 20.0, 0.05)
    return float(next(t for t in times if script.action(t) != "walk"))


def _forward(posed: PosedPerson) -> Array:
    """Where the chest looks, in the floor's plane."""
    left = posed.joints[JOINT["shoulder_L"]] - posed.joints[JOINT["shoulder_R"]]
    forward = np.array([left[1], -left[0], 0.0])
    return forward / np.linalg.norm(forward)
