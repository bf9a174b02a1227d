# SPDX-License-Identifier: Apache-2.0
"""Is a rig right? Footage of a person tells: how tall they come out, where their feet are, whether cameras agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.rig.consistency import (
    LOW_PX,
    MOST_VOXELS,
    Grid,
    Mask,
    Scores,
    cover,
    inside,
    make_grid,
    mean_scores,
    score,
)
from limbloc_ros.rig.faults import Frame, Move, best_delay, best_move, contradiction, exchange, pair_table, swapped_pair
from limbloc_ros.rig.geometry import Look, cameras_up, where_they_look

Array = NDArray[np.float64]

#: Contradiction up to which a rig is good, and from which on something is wrong (ragged masks alone reach 0.06).
GOOD, BAD = 0.04, 0.10
#: A camera is guilty when without it at least so much of the contradiction is gone, and this share of it. Ragged masks
#: alone can do that, so that a guilt below CLEAR counts only where a delay or another pose explains it.
GUILTY, GUILTY_SHARE, CLEAR = 0.02, 0.4, 0.05
#: The share of a camera's contradiction that may be left when its fault is found.
EXPLAINED = 0.4
#: A hull of a person is this long, m, however they lie or stretch and however fat it is.
SHORTEST_M, TALLEST_M = 0.4, 5.0
#: Feet further than this from the floor are not on it, m: below it, and above it.
BELOW_M, ABOVE_M = 0.12, 0.35
#: Frames that are compared, and frames around them that are tried when a camera may be late.
COMPARED, DELAYS = 6, 12
#: The person is looked for with more voxels than the silhouettes are compared with.
SEARCH_VOXELS = 300_000

UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37}


@dataclass(frozen=True)
class Finding:
    """Something that was seen.

    Attributes:
        kind: `unit`, `up`, `floor`, `height`, `swap`, `time`, `place`, `mask`, `masks` or `view`.
        text: in words, with figures and what to do.
        cameras: whom it concerns.
        severe: the rig should not be used like this.
    """

    kind: str
    text: str
    cameras: tuple[str, ...] = ()
    severe: bool = True


@dataclass
class Report:
    """The outcome of a check.

    Attributes:
        findings: what is wrong; empty when nothing is.
        scores: how the cameras agree, mean over the compared frames; None when nothing could be compared.
        pairs: [C, C] contradiction of each pair.
        facts: plain figures, (name, value).
        move: the pose that would make a guilty camera agree, by its name.
        overlays: camera -> (small mask, where the hull of all others projects) of one frame, for the picture.
    """

    findings: list[Finding] = field(default_factory=list)
    scores: Scores | None = None
    pairs: Array | None = None
    facts: list[tuple[str, str]] = field(default_factory=list)
    move: dict[str, Move] = field(default_factory=dict)
    overlays: dict[str, tuple[Mask, Mask]] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Nothing severe was found."""
        return not any(finding.severe for finding in self.findings)

    def say(self, kind: str, text: str, cameras: tuple[str, ...] = (), severe: bool = True) -> None:
        """Add a finding."""
        self.findings.append(Finding(kind, text, cameras, severe))


def check(rig: Rig, recording: Sequence[Frame], *, fps: float | None = None, height_m: float | None = None) -> Report:
    """Find out whether a rig fits footage of one person.

    Args:
        rig: the cameras; the carve volume is not needed.
        recording: small masks by camera index (`consistency.shrink_masks`), consecutive when fps is given.
        fps: frames a second; None: the frames are not consecutive, and no camera's time is looked at.
        height_m: how tall the person is, if that is known.

    Returns:
        what was found. Nothing is raised: a rig of any kind can be checked.
    """
    report = Report()
    look = where_they_look([camera.T_world_camera for camera in rig.cameras])
    if not look.common and len(rig.cameras) > 1:
        behind = [c.name for c, depth in zip(rig.cameras, look.depths, strict=True) if depth <= 0]
        detail = f"; it lies behind {', '.join(behind)}" if behind else ""
        report.say(
            "view",
            f"the cameras do not look at one place: their axes miss each other by {100 * look.miss:.0f} % of the "
            f"distance{detail}. Are the poses those of the cameras in the world, not the inverse?",
            tuple(behind),
        )
    usable = [i for i, frame in enumerate(recording) if len(frame) >= 2]
    if not usable:
        report.say("masks", "no frame shows somebody in two cameras or more: nothing can be compared")
        return report
    most = max(len(recording[i]) for i in usable)
    full = [i for i in usable if len(recording[i]) == most]
    chosen = spread(full, COMPARED)
    grid, _ = find_person(rig, look, [recording[i] for i in chosen])
    if grid is None:
        report.say(
            "masks",
            "the silhouettes have no volume in common, not even those of most cameras: are these masks of this rig, "
            "with one person in the middle of the room?",
        )
        return report
    right: Sequence[Frame] = _agreement(rig, report, grid, recording, chosen, fps)
    again: Grid | None = grid
    if report.findings:  # look for the person anew, now that it is known who is right
        again, right = find_person(rig, look, right)
    if again is not None:
        _world(rig, report, again, right, height_m)
    return report


def spread(items: Sequence[int], count: int) -> list[int]:
    """At most `count` of the items, evenly."""
    at = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return [items[i] for i in at]


def find_person(
    rig: Rig, look: Look, frames: Sequence[Frame], voxels: int = MOST_VOXELS, low_px: int = LOW_PX
) -> tuple[Grid | None, Sequence[Frame]]:
    """Voxels around where the person is, first coarsely in all that the cameras see; whatever the unit and the up."""
    half = 0.9 * float(np.median(look.distances))
    # For the search lenses may be plain: where the person is matters, not their outline.
    plain = tuple(replace(camera, distortion=np.zeros(0), distortion_model="none") for camera in rig.cameras)
    grid = make_grid(replace(rig, cameras=plain), look.point - half, look.point + half, SEARCH_VOXELS, low_px)
    for finer in (False, True):
        most = [hull_voxels(grid, frame, tolerant=True) for frame in frames]
        inside_any = np.unique(np.concatenate(most)) if most else np.zeros(0, np.int64)
        if len(inside_any) == 0:
            return (None if not finer else grid), frames
        points = grid.points[inside_any]
        margin = 2.5 * grid.voxel
        if not finer:
            grid = make_grid(rig, points.min(axis=0) - margin, points.max(axis=0) + margin, voxels, low_px)
    return grid, frames


def hull_voxels(grid: Grid, frame: Frame, tolerant: bool = False) -> NDArray[np.int64]:
    """Voxels that all cameras keep, or (tolerant) those that the fewest deny, up to a third of the cameras."""
    denials = np.zeros(len(grid.points), np.int64)
    seen = np.zeros(len(grid.points), np.int64)
    for c, mask in frame.items():
        denials += ~inside(grid, c, mask)
        seen += grid.pixels[c] >= 0
    enough = seen > max(1, len(frame) // 2)
    for allowed in range(1 + (len(frame) // 3 if tolerant else 0)):
        voxels = np.flatnonzero((denials <= allowed) & enough)
        if len(voxels) >= 30:
            return voxels
    return np.zeros(0, np.int64)


def _world(rig: Rig, report: Report, grid: Grid, frames: Sequence[Frame], height_m: float | None) -> None:
    """Unit, up and floor, from how big the person comes out and where."""
    hulls = [grid.points[voxels] for frame in frames if len(voxels := hull_voxels(grid, frame, tolerant=True))]
    if not hulls:
        return
    up, agreement = cameras_up([camera.T_world_camera for camera in rig.cameras])
    longest = float(np.median([np.ptp(points, axis=0).max() for points in hulls]))
    heights = [float(np.ptp(points[:, 2])) for points in hulls]
    lows = [float(points[:, 2].min() - 0.5 * grid.voxel) for points in hulls]
    low = float(np.median(lows))
    report.facts += [
        ("person's height in the hull", f"{np.median(heights):.2f} m (median)"),
        ("lowest point of the hull", f"{low:.2f} m"),
    ]
    unit = 1.0
    if not SHORTEST_M <= longest <= TALLEST_M:
        name, unit = min(UNITS.items(), key=lambda item: abs(math.log(longest / item[1] / 1.7)))
        fits = SHORTEST_M <= longest / unit <= TALLEST_M
        guess = f"the rig is in {name} (1.0 = {1000 / unit:g} mm)" if fits else "its scale is wrong"
        unit = unit if fits else 1.0
        report.say(
            "unit",
            f"the person comes out {longest:,.4g} long: {guess}. A rig file is in metres: import again with --unit",
        )
    tilt = math.degrees(math.acos(float(np.clip(up[2], -1, 1)))) if agreement > 0.3 else 0.0
    flipped = tilt > 120
    if flipped:
        report.say(
            "up",
            f"the world is upside down: the cameras' images have their up along -z, the hull reaches from "
            f"{low / unit:.2f} to {max(float(p[:, 2].max()) for p in hulls) / unit:.2f} m and hangs head down. z must "
            "point up: import again with --up -z (if all cameras hang upside down, turn their images)",
        )
    elif tilt > 50:
        axis = "xyz"[int(np.abs(up[:2]).argmax())]
        sign = "-" if up[int(np.abs(up[:2]).argmax())] < 0 else ""
        report.say(
            "up",
            f"z does not point up: the cameras' images have their up along {sign}{axis} ({tilt:.0f} degrees off): "
            f"import again with --up {sign}{axis}",
        )
    elif unit == 1.0 and low < -BELOW_M:
        report.say(
            "floor",
            f"the person's feet are {-low:.2f} m below the floor (z = 0): the floor is not where the rig says; import "
            f"again with --floor {low:.2f}, or lay the board on the floor",
        )
    elif unit == 1.0 and low > ABOVE_M:
        report.say(
            "floor",
            f"the person's lowest point is {low:.2f} m above the floor (z = 0): on a step, or the floor is not where "
            "the rig says?",
            severe=False,
        )
    if height_m is not None and unit == 1.0 and not flipped:
        tall = float(np.percentile(heights, 75)) - grid.voxel
        ratio = tall / height_m
        if not 0.93 < ratio < 1.07:
            report.say(
                "height",
                f"a person of {height_m:.2f} m comes out {tall:.2f} m tall: lengths are off by "
                f"{100 * (ratio - 1):+.0f} % (or nobody stood upright): was the board's square measured?",
            )


def _agreement(
    rig: Rig, report: Report, grid: Grid, recording: Sequence[Frame], chosen: Sequence[int], fps: float | None
) -> list[dict[int, Mask]]:
    """Which cameras contradict the others, and why; returns the frames exchanged back and without the guilty."""
    names = rig.names
    frames: list[dict[int, Mask]] = [dict(recording[i]) for i in chosen]
    report.scores = mean_scores([score(grid, frame) for frame in frames], names)
    report.pairs = pair_table(grid, frames[::2], names)
    for c, view in enumerate(grid.views):
        pairs = [
            (frame, hull_voxels(grid, {k: m for k, m in frame.items() if k != c})) for frame in frames if c in frame
        ]
        if pairs:
            frame, rest = max(pairs, key=lambda pair: int(pair[0][c].sum()))
            report.overlays[view.camera.name] = frame[c], cover(grid, c, rest)
    frames = _undo_swaps(report, grid, frames, names)
    excused: set[int] = set()
    while len(names) - len(excused) >= 3:
        scores = mean_scores([score(grid, frame) for frame in frames], names)
        guilty = _guilty(scores, excused)
        if not guilty:
            break
        if _strangers(report, scores, guilty[0]):
            excused.add(guilty[0])
            continue
        trials = [_explain(grid, recording, frames, camera, fps) for camera in guilty]
        best = min(trials, key=lambda trial: trial.left)
        _tell(report, grid, scores, best, [grid.names[c] for c in guilty if c != best.camera], fps)
        excused.add(best.camera)
        if not report.findings[-1].severe:
            break  # ragged masks: what else would be found is of the same kind
        frames = [{c: m for c, m in frame.items() if c != best.camera} for frame in frames]
    together = report.scores.together
    if together > BAD and not report.findings:
        report.say(
            "masks",
            f"{100 * together:.0f} % of the foreground is not explained by the hull, and no single camera is to blame: "
            "poor masks, or the calibration is poor all over",
        )
    return frames


def _undo_swaps(
    report: Report, grid: Grid, frames: list[dict[int, Mask]], names: Sequence[str]
) -> list[dict[int, Mask]]:
    """The frames with exchanged cameras put right, each exchange reported."""
    for _ in range(len(names) // 2):
        before = contradiction(grid, frames)
        if not before > BAD:
            break
        best = swapped_pair(grid, frames[::2])
        scores = mean_scores([score(grid, frame) for frame in frames], names)
        alone = float(np.nanmin(scores.without)) if np.isfinite(scores.without).any() else np.inf
        if best is None or best[1] > 0.5 * before or best[1] > 0.7 * alone:
            break
        (a, b), after = best
        frames = [exchange(frame, a, b) for frame in frames]
        report.say(
            "swap",
            f"{names[a]} and {names[b]} are exchanged: with their images swapped, the unexplained foreground falls "
            f"from {100 * before:.0f} to {100 * after:.0f} %. Swap their names in the rig file, or the cables",
            (names[a], names[b]),
        )
    return frames


def _guilty(scores: Scores, excused: set[int]) -> list[int]:
    """The camera without which the others agree, and those that are nearly as suspicious; empty when there is none."""
    blame = np.where(np.isfinite(scores.blame), scores.blame, -1.0)
    blame[list(excused)] = -1.0
    worst = float(blame.max())
    if not worst > max(GUILTY, GUILTY_SHARE * scores.together):
        return []
    return [int(c) for c in np.argsort(-blame) if blame[c] > 0.7 * worst][:3]


@dataclass(frozen=True)
class _Trial:
    """What was tried to explain one camera's contradiction; `left` is what remains of it, 0 to 1."""

    camera: int
    left: float
    delay: int = 0
    move: Move | None = None


def _explain(
    grid: Grid,
    recording: Sequence[Frame],
    frames: Sequence[Frame],
    camera: int,
    fps: float | None,
) -> _Trial:
    """Try whether a delay or another pose makes a camera agree."""
    trials = [_Trial(camera, 1.0)]
    keep: set[int] = set().union(*frames)
    if fps is not None:
        reach = min(DELAYS, (len(recording) - 1) // 3)
        inner = spread([i for i in range(reach, len(recording) - reach) if camera in recording[i]], COMPARED)
        window = [{c: m for c, m in frame.items() if c in keep} for frame in recording]
        if reach and inner:
            delay, curve = best_delay(grid, window, inner, camera, reach)
            rest = contradiction(grid, [{c: m for c, m in window[i].items() if c != camera} for i in inner])
            now, then = float(curve[reach]), float(np.nanmin(curve))
            if delay:
                trials.append(_Trial(camera, max(0.0, then - rest) / max(now - rest, 1e-6), delay))
    half = list(frames)[::2] if len(frames) > 4 else list(frames)
    move = best_move(grid, half, camera) if trials[-1].left > 0.15 else None
    if move is not None:
        rest = contradiction(grid, [{c: m for c, m in frame.items() if c != camera} for frame in half])
        trials.append(_Trial(camera, max(0.0, move.after - rest) / max(move.before - rest, 1e-6), move=move))
    # A delay has one parameter, a pose has six: the delay has the benefit of the doubt.
    return min(trials, key=lambda trial: trial.left - 0.15 * bool(trial.delay))


def _strangers(report: Report, scores: Scores, camera: int) -> bool:
    """Whether a camera only shows foreground of its own: a camera out of place takes from all others' hull as well."""
    own = float(scores.unexplained[camera])
    others = float(np.nanmean(np.delete(scores.unexplained, camera)))
    stray = others < GOOD / 2 and own > 6 * others
    if stray:
        name = scores.names[camera]
        report.say(
            "mask",
            f"{name} shows foreground that no other camera knows: {100 * own:.0f} % of its own, while that of the "
            "others is explained. The rig is not to blame: something else moves there. Name that place under `ignore` "
            "in the rig file, or take a better background picture",
            (name,),
            severe=False,
        )
    return stray


def _tell(report: Report, grid: Grid, scores: Scores, trial: _Trial, rivals: Sequence[str], fps: float | None) -> None:
    """Say what is wrong with a camera that contradicts the others: late, moved, or its masks."""
    name = grid.names[trial.camera]
    before, without = scores.together, float(scores.without[trial.camera])
    seen = (
        f"{name} contradicts the others: {100 * before:.0f} % of the foreground is not explained, "
        f"{100 * without:.0f} % without it"
    )
    if rivals:
        seen += f" (nearly the same without {' or '.join(rivals)})"
    left = f"so corrected, {100 * trial.left:.0f} % of that contradiction is left"
    if trial.left < EXPLAINED and trial.delay:
        way = "late" if trial.delay > 0 else "early"
        report.say(
            "time",
            f"{seen}. It is {way} by {abs(trial.delay)} frames ({1000 * abs(trial.delay) / (fps or 1):.0f} ms): "
            f"{left}. Trigger the cameras together, or cut its video",
            (name,),
        )
    elif trial.left < EXPLAINED and trial.move is not None and trial.move.shift_px > 2:
        move = trial.move
        report.move[name] = move
        stands = f" and stands {100 * move.shift_m:.0f} cm elsewhere" if move.shift_m > 0.01 else ""
        report.say(
            "place",
            f"{seen}. It was moved: it looks {math.degrees(move.turn_rad):.1f} degrees away from where the rig file "
            f"says (its image is off by {move.shift_px:.0f} px){stands}; {left}. Calibrate it again",
            (name,),
        )
    else:
        report.say(
            "mask",
            f"{seen}. Neither a delay nor another pose explains it: look at its masks (background, shadows, something "
            "in front), its lens and its image size",
            (name,),
            severe=before - without > CLEAR,
        )
