# SPDX-License-Identifier: Apache-2.0
"""The motions a simulated person can do: real clips (DeepMimic) and a few authored ones.

An authored motion is a list of key poses; a key pose names the angles that differ from standing, in degrees:

- `root`, `chest`, `neck`: (bend forward, lean to the own left, turn left)
- `hip_L`, `shoulder_R`, ...: (swing forward, abduction, outward axial turn)
- `knee_L`, `elbow_R`, ...: (flexion,); ankles are set so that the sole stays level, unless they are named
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.simulation import _quaternions as quat
from limbloc_ros.simulation.person import baked
from limbloc_ros.simulation.retarget import LINKS

Array = NDArray[np.float64]

#: All motions are sampled at this rate, frames per second.
RATE = 30.0

Key = Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class Action:
    """A motion at 30 frames per second, starting at the origin and heading along x.

    Attributes:
        name: e.g. `wave`.
        rotations: [F, 13, 4] link rotations relative to their parents (LINKS), w x y z.
        path: [F, 2] root position on the floor, in leg lengths.
        height: [F] root height in leg lengths, or None: the lowest point of the body touches the floor.
        planted: both feet stay where they are: the root's place follows from the legs, not from `path`.
    """

    name: str
    rotations: Array
    path: Array
    height: Array | None
    planted: bool


STAND: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("root", "chest", "neck"), (0.0, 0.0, 0.0)),
    **{f"hip_{s}": (4.0, 1.0, 0.0) for s in "LR"},
    **{f"knee_{s}": (6.0,) for s in "LR"},
    **{f"shoulder_{s}": (4.0, 4.0, 0.0) for s in "LR"},
    **{f"elbow_{s}": (14.0,) for s in "LR"},
}


def both(**angles: tuple[float, ...]) -> dict[str, tuple[float, ...]]:
    """The same angles for the left and the right link: both(knee=(90,)) -> knee_L and knee_R."""
    return {f"{link}_{side}": value for link, value in angles.items() for side in "LR"}


_WAVE_ARM = {"shoulder_R": (15.0, 100.0, 80.0)}
_SQUAT = {
    "root": (22.0, 0.0, 0.0),
    **both(hip=(98.0, 14.0, 8.0), knee=(104.0,), shoulder=(75.0, 8.0, 0.0), elbow=(20.0,)),
}
_SIT = {
    "root": (6.0, 0.0, 0.0),
    "chest": (8.0, 0.0, 0.0),
    **both(hip=(82.0, 9.0, 4.0), knee=(80.0,), shoulder=(30.0, 4.0, -10.0), elbow=(52.0,)),
}
_HIPS = both(shoulder=(-24.0, 42.0, -48.0), elbow=(82.0,))

# name -> [(seconds from the key before, key), ...]; the first and the last key are standing.
AUTHORED: dict[str, Sequence[tuple[float, Key]]] = {
    "wave": [
        (0.6, {**_WAVE_ARM, "elbow_R": (50.0,), "neck": (0.0, -5.0, -12.0)}),
        *[(0.3, {**_WAVE_ARM, "elbow_R": (e,), "neck": (0.0, -5.0, -12.0)}) for e in (95.0, 45.0, 95.0, 45.0, 90.0)],
        (0.7, {}),
    ],
    "arms_up": [
        (0.9, both(shoulder=(0.0, 92.0, 0.0), elbow=(8.0,))),
        (0.8, {"chest": (-6.0, 0.0, 0.0), **both(shoulder=(0.0, 165.0, 0.0), elbow=(12.0,))}),
        (0.6, {"chest": (-8.0, 0.0, 0.0), **both(shoulder=(0.0, 168.0, 0.0), elbow=(12.0,))}),
        (0.9, both(shoulder=(85.0, 10.0, 0.0), elbow=(10.0,))),
        (0.7, {}),
    ],
    "reach": [
        (
            0.9,
            {
                "chest": (-4.0, -8.0, 18.0),
                "neck": (-18.0, 0.0, 10.0),
                "shoulder_R": (150.0, 10.0, 0.0),
                "elbow_R": (12.0,),
            },
        ),
        (
            0.7,
            {
                "chest": (-4.0, -8.0, 22.0),
                "neck": (-18.0, 0.0, 10.0),
                "shoulder_R": (158.0, 8.0, 0.0),
                "elbow_R": (5.0,),
            },
        ),
        (
            1.1,
            {
                "root": (22.0, 0.0, 0.0),
                "chest": (28.0, 8.0, -28.0),
                "neck": (10.0, 0.0, 0.0),
                "shoulder_L": (88.0, 4.0, 0.0),
                "elbow_L": (10.0,),
                **both(hip=(52.0, 4.0, 0.0), knee=(42.0,)),
            },
        ),
        (
            0.6,
            {
                "root": (24.0, 0.0, 0.0),
                "chest": (30.0, 8.0, -30.0),
                "neck": (10.0, 0.0, 0.0),
                "shoulder_L": (92.0, 4.0, 0.0),
                "elbow_L": (5.0,),
                **both(hip=(56.0, 4.0, 0.0), knee=(46.0,)),
            },
        ),
        (1.0, {}),
    ],
    "squat": [(1.0, _SQUAT), (0.35, _SQUAT), (0.9, {}), (0.9, _SQUAT), (1.0, {})],
    "sit": [
        (1.1, _SIT),
        (0.7, {**_SIT, "neck": (0.0, 0.0, 35.0)}),
        (0.7, {**_SIT, "neck": (0.0, 0.0, -25.0)}),
        (1.1, {}),
    ],
    "stretch": [
        (0.8, _HIPS),
        (0.8, {**_HIPS, "chest": (0.0, 22.0, 0.0), "root": (0.0, 4.0, 0.0)}),
        (1.0, {**_HIPS, "chest": (0.0, -22.0, 0.0), "root": (0.0, -4.0, 0.0)}),
        (0.9, {**_HIPS, "chest": (4.0, 0.0, 38.0), "neck": (0.0, 0.0, 20.0)}),
        (1.1, {**_HIPS, "chest": (4.0, 0.0, -38.0), "neck": (0.0, 0.0, -20.0)}),
        (0.9, {}),
    ],
    "point": [
        (
            0.7,
            {"shoulder_L": (88.0, 20.0, 0.0), "elbow_L": (6.0,), "neck": (0.0, 0.0, 15.0), "chest": (0.0, 0.0, -8.0)},
        ),
        (
            0.9,
            {"shoulder_L": (92.0, 55.0, 0.0), "elbow_L": (6.0,), "neck": (0.0, 0.0, 40.0), "chest": (0.0, 0.0, 10.0)},
        ),
        (0.8, {"shoulder_L": (84.0, 30.0, 0.0), "elbow_L": (60.0,), "neck": (0.0, 0.0, 10.0)}),
        (0.7, {}),
    ],
    "t_pose": [
        (0.9, both(shoulder=(0.0, 84.0, 0.0), elbow=(4.0,))),
        (0.7, both(shoulder=(0.0, 86.0, 0.0), elbow=(4.0,))),
        (0.9, {}),
    ],
}


def _link_rotations(angles: Mapping[str, Array]) -> Array:
    """[F, 13, 4] from angles in rad by link, each [F, n] as in the module's docstring."""
    out = []
    for link in LINKS:
        part, _, side = link.partition("_")
        out_sign = 1.0 if side == "L" else -1.0
        if part == "ankle" and link not in angles:
            pitch = angles["root"][:, 0] - angles[f"hip_{side}"][:, 0] + angles[f"knee_{side}"][:, 0]
            out.append(quat.about(1, -pitch))
            continue
        a = angles[link]
        if part in ("knee", "elbow"):
            out.append(quat.about(1, a[:, 0] if part == "knee" else -a[:, 0]))
        elif part in ("root", "chest", "neck"):
            lean = quat.multiply(quat.about(0, -a[:, 1]), quat.about(1, a[:, 0]))
            out.append(quat.multiply(quat.about(2, a[:, 2]), lean))
        else:
            swing = quat.multiply(quat.about(1, -a[:, 0]), quat.about(0, out_sign * a[:, 1]))
            out.append(quat.multiply(swing, quat.about(2, out_sign * a[:, 2])))
    return np.stack(out, axis=1)


def _authored(name: str, keys: Sequence[tuple[float, Key]]) -> Action:
    """Ease from key to key, with a little breathing and swaying on top."""
    times = np.concatenate([[0.0], np.cumsum([seconds for seconds, _ in keys])])
    poses: list[Key] = [{}, *[key for _, key in keys]]
    t = np.arange(round(times[-1] * RATE) + 1) / RATE
    step = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(keys) - 1)
    u = np.clip((t - times[step]) / (times[step + 1] - times[step]), 0.0, 1.0)
    ease = (u * u * (3 - 2 * u))[:, None]
    angles = {}
    for link, standing in STAND.items():
        table = np.radians([pose.get(link, standing) for pose in poses])
        angles[link] = table[step] * (1 - ease) + table[step + 1] * ease
    angles["chest"][:, 0] += 0.015 * np.sin(2 * np.pi * t / 3.1)
    angles["neck"][:, 2] += 0.04 * np.sin(2 * np.pi * t / 4.3)
    return Action(name, _link_rotations(angles), np.zeros((len(t), 2)), None, planted=True)


def _clips() -> dict[str, Action]:
    data = baked("motions.npz")
    lengths = data["lengths"].astype(np.int64)
    begin = np.cumsum(lengths) - lengths
    found = {}
    for name, start, length, frame_s in zip(data["names"], begin, lengths, data["frame_s"], strict=True):
        rows = slice(start, start + length)
        q = data["rotations"][rows].astype(np.float64)
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        duration = (length - 1) * float(frame_s)
        at = np.arange(int(duration * RATE) + 1) / RATE / float(frame_s)
        k = np.minimum(at.astype(np.int64), length - 2)
        share = at - k
        rotations = quat.mix(q[k], q[k + 1], share[:, None])
        root = data["root"][rows].astype(np.float64)
        root = root[k] * (1 - share[:, None]) + root[k + 1] * share[:, None]
        path = root[:, :2]
        # Turn the clip so that it starts at the origin, heading along x.
        turn = -float(quat.heading(rotations[0, 0]))
        rotations[:, 0] = quat.multiply(quat.about(2, turn), rotations[:, 0])
        c, s = np.cos(turn), np.sin(turn)
        path = (path - path[0]) @ np.array([[c, s], [-s, c]])
        found[str(name)] = Action(str(name), rotations, path, root[:, 2], planted=False)
    return found


@cache
def all_actions() -> dict[str, Action]:
    """Every motion by its name; `walk` is one cycle of a straight walk, `stand` two seconds of standing."""
    authored = {name: _authored(name, keys) for name, keys in AUTHORED.items()}
    return {**_clips(), **authored, "stand": _authored("stand", [(1.0, {}), (1.0, {})])}
