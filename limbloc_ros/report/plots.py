# SPDX-License-Identifier: Apache-2.0
"""The report's plots over time: head path, joint angles, energy, confidence, stage times, bone lengths, error.

Gaps stay gaps: frames without a person are NaN, which breaks the line, and their span is shaded. Jumps carry a mark.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from limbloc_ros.core.joint_angles import NATIVE_ANGLES
from limbloc_ros.core.pose import JOINT, LIMB_JOINTS, Array
from limbloc_ros.report.run import JUMP_M, JUMP_RAD, RunData, jumps

#: Okabe and Ito's colours, which colour-blind people can tell apart; blue and orange are also left and right.
BLUE, ORANGE, GREEN, GREY, INK = "#0072B2", "#D55E00", "#009E73", "#8A929C", "#303640"
SIDES = {"L": (BLUE, "-", "left"), "R": (ORANGE, "--", "right"), "": (INK, "-", "middle")}
STYLE: dict[str, Any] = {
    "font.size": 12,
    "axes.titlesize": 12.5,
    "axes.labelsize": 12,
    "axes.edgecolor": "#B8BEC6",
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E7EB",
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}
DPI = 110
#: Angle -> its usual human range, degrees; only those that cannot turn round and round.
USUAL_DEG = {a.name: (float(np.degrees(a.low)), float(np.degrees(a.high))) for a in NATIVE_ANGLES if not a.continuous}
#: Height that is kept free for a legend above all plots, inch.
LEGEND_IN = 0.42


def new_figure(width_in: float, height_in: float) -> Figure:
    """An Agg figure that lays itself out; no window, no global state."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def legend_above(figure: Figure, handles: Sequence[Any], **options: Any) -> None:
    """A legend of one line above all axes (`loc="outside upper center"`, which Matplotlib has from 3.7 on)."""
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0, 0, 1, 1 - LEGEND_IN / figure.get_figheight()))
    figure.legend(handles=handles, loc="upper center", **options)


def head_path(run: RunData) -> Figure:
    """Fig. 10: where the head was, in 3D and over time; jumps are marked."""
    path = run.joint_path("head_centre")
    broken = jumps(path, JUMP_M) if run.consecutive else np.zeros(len(path), dtype=np.bool_)
    time, unit = time_axis(run)
    with rc_context(STYLE):
        figure = new_figure(11, 5.2)
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.05, 1.0))
        space, side = halves
        axes = space.add_subplot(projection="3d")
        if run.consecutive:
            axes.plot(*path.T, color=GREY, linewidth=1.0)
        points = axes.scatter(*path.T, c=time, cmap="viridis", s=18, depthshade=False)
        if broken.any():
            axes.scatter(*path[broken].T, marker="x", c=ORANGE, s=70, linewidths=2.2, depthshade=False)
        _equal_box(axes, path)
        axes.set_xlabel("x (m)", labelpad=8)
        axes.set_ylabel("y (m)", labelpad=8)
        axes.set_zlabel("z (m)", labelpad=6)
        axes.tick_params(labelsize=10)
        axes.locator_params(nbins=4)
        axes.view_init(elev=24, azim=-55)
        space.colorbar(points, ax=axes, shrink=0.62, pad=0.12, label=unit)
        rows = side.subplots(3, 1, sharex=True)
        for row, name, colour, value in zip(rows, "xyz", (BLUE, ORANGE, GREEN), path.T, strict=True):
            trace(row, run, time, value, colour)
            row.plot(time[broken], value[broken], "x", color="black", markersize=8, markeredgewidth=2)
            row.set_ylabel(f"{name} (m)")
            _at_least(row, value, 0.1)
        rows[0].set_title(f"head centre, {_count(int(broken.sum()), 'jump')}" if run.consecutive else "head centre")
        rows[-1].set_xlabel(unit)
    return figure


def joint_angles(run: RunData) -> Figure:
    """All joint angles over time, the left and right of a joint together; jumps are marked, and where the usual human
    range ends."""
    panels = {
        name: {side: np.degrees(value) for side, value in members.items()}
        for name, members in paired(run.angles).items()
    }
    return _small_multiples(run, panels, "degrees", float(np.degrees(JUMP_RAD)), least_span=20.0, limits=USUAL_DEG)


def bone_lengths(run: RunData) -> Figure:
    """The stick figure's bones over time: one person's do not change, so their spread shows the fit's."""
    lengths = {name.split(" - ")[0].removesuffix("_L").removesuffix("_R") + " - " + name.split(" - ")[1]: 100 * value
               for name, value in run.bone_lengths().items()}  # fmt: skip
    return _small_multiples(run, paired(lengths), "cm", math.inf, least_span=6.0, spread=True)


def paired(series: Mapping[str, Array]) -> dict[str, dict[str, Array]]:
    """Series by what they measure, then by side: `knee_flexion_L`, `l_knee` and `knee_flexion_R` go together in pairs.

    A trailing `_L` / `_R`, the same before a last word (`knee_L_x`), or a leading `l_` / `r_` (ROS4HRI) tells the side.
    """
    groups: dict[str, dict[str, Array]] = {}
    for name, value in series.items():
        base, side = name, ""
        for mark in "LR":
            if name.endswith(f"_{mark}"):
                base, side = name[:-2], mark
            elif f"_{mark}_" in name:
                base, side = name.replace(f"_{mark}_", "_", 1), mark
            elif name.startswith(f"{mark.lower()}_") and f"{'lr'['LR'.index(mark) ^ 1]}{name[1:]}" in series:
                base, side = name[2:], mark
        groups.setdefault(base, {})[side] = value
    return groups


def energy_and_confidence(run: RunData) -> Figure:
    """XOR energy (eq. 2) and the expected joint error over time, against the true error when it is known."""
    time, unit = time_axis(run)
    doubtful = run.found & ~run.reliable
    error = run.error_m
    with rc_context(STYLE):
        figure = new_figure(11, 6.2)
        top, bottom = figure.subplots(2, 1, sharex=True)
        trace(top, run, time, run.energy, BLUE)
        if doubtful.any():
            top.plot(time[doubtful], run.energy[doubtful], "o", color=ORANGE, markersize=7, label="not reliable")
            top.legend(loc="lower right")
        top.set_ylabel("XOR energy (1)")
        top.set_ylim(0, max(0.3, 1.15 * _largest(run.energy)))
        top.set_title("energy: 0 is a perfect overlap of figure and hull")
        limbs = [JOINT[name] for name in LIMB_JOINTS]
        trace(bottom, run, time, 100 * over(np.nanmedian, run.sigma[:, limbs]), BLUE, "expected (sigma), median joint")
        trace(bottom, run, time, 100 * over(np.nanmax, run.sigma[:, limbs]), BLUE, "expected, worst joint", ":")
        if error is not None:
            trace(
                bottom, run, time, 100 * over(np.nanmedian, error[:, limbs]), ORANGE, f"{run.truth_kind}, median joint"
            )
            trace(
                bottom, run, time, 100 * over(np.nanmax, error[:, limbs]), ORANGE, f"{run.truth_kind}, worst joint", ":"
            )
        bottom.axhline(5, color=INK, linewidth=1)
        bottom.annotate(
            "5 cm", (1, 5), xytext=(4, 0), xycoords=("axes fraction", "data"), textcoords="offset points", va="center"
        )
        bottom.set_yscale("log")
        low, high = bottom.get_ylim()
        bottom.set_ylim(min(low, 0.8), max(1.3 * high, 12.0))
        bottom.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bottom.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        bottom.yaxis.set_minor_locator(NullLocator())
        bottom.set_ylabel("joint error (cm)")
        bottom.set_xlabel(unit)
        bottom.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=10.5)
    return figure


def stage_times(run: RunData) -> Figure:
    """Process time of each stage: median (bar) and 95th percentile (line)."""
    stages = [(name, value) for name, value in run.stage_ms.items() if np.isfinite(value).any()]
    with rc_context(STYLE):
        figure = new_figure(11, 1.5 + 0.42 * len(stages))
        axes = figure.subplots()
        for row, (_, value) in enumerate(stages):
            median, p95 = np.nanpercentile(value, (50, 95))
            axes.barh(row, median, color=BLUE, height=0.62)
            axes.plot([median, p95], [row, row], color=INK, linewidth=1.6)
            axes.plot([p95], [row], "|", color=INK, markersize=11, markeredgewidth=1.6)
            text = f"{median:.1f} ms, 95 %: {p95:.1f} ms"
            axes.annotate(text, (p95, row), xytext=(8, 0), textcoords="offset points", va="center")
        axes.set_yticks(range(len(stages)), [words(name) for name, _ in stages])
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_xlim(0, 1.25 * axes.get_xlim()[1])  # room for the numbers
        axes.set_xlabel("process time per frame (ms): median, line to the 95th percentile")
    return figure


def words(name: str) -> str:
    """An identifier as words: `upper_arm` -> `upper arm`."""
    return name.replace("_", " ")


def _small_multiples(
    run: RunData,
    panels: Mapping[str, Mapping[str, Array]],
    unit: str,
    jump: float,
    least_span: float,
    spread: bool = False,
    columns: int = 3,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """One small plot per quantity, left and right in their colours."""
    time, time_unit = time_axis(run)
    rows = max(1, -(-len(panels) // columns))
    with rc_context(STYLE):
        height = LEGEND_IN + 0.3 + 2.2 * rows
        figure = new_figure(12, height)
        engine: Any = figure.get_layout_engine()
        engine.set(h_pad=0.09)  # inch: a title is to be nearer to its own plot than to the numbers above it
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes in grid.ravel()[len(panels) :]:
            axes.set_visible(False)
        shown: dict[str, Any] = {}
        for axes, (name, sides) in zip(grid.ravel(), panels.items(), strict=False):
            for side, value in sides.items():
                colour, style, text = SIDES[side]
                shown.setdefault(text, trace(axes, run, time, value, colour, style=style))
                broken = jumps(value, jump) if run.consecutive else np.zeros(len(value), dtype=np.bool_)
                if broken.any():
                    marks = axes.plot(
                        time[broken], value[broken], "x", color="black", markersize=7, markeredgewidth=1.8
                    )
                    shown.setdefault("jump", marks[0])
            title = words(name)
            if spread:
                usual = [np.nanstd(v) for v in sides.values() if np.isfinite(v).any()]
                title += f"  (± {max(usual):.1f} {unit})" if usual else ""
            axes.set_title(title, fontsize=11.5)
            axes.tick_params(labelsize=10, labelbottom=True)
            _at_least(axes, np.concatenate(list(sides.values())), least_span)
            if limits and (full := sided(name, next(iter(sides)))) in limits:
                low, high = limits[full]
                axes.set_title(f"{title}  ({low:.0f} to {high:.0f})", fontsize=11.5)
                band = _shade_outside(axes, low, high)
                if band is not None:
                    shown.setdefault("beyond the usual range", band)
        for axes in grid[:, 0]:
            axes.set_ylabel(unit)
        for column in range(min(columns, len(panels))):
            last = (len(panels) - 1 - column) // columns
            grid[last, column].set_xlabel(time_unit)
        order = [t for t in ("left", "right", "middle", "jump", "beyond the usual range") if t in shown]
        if order:
            handles = [shown[text] for text in order]
            legend_above(figure, handles, labels=order, ncols=len(order), fontsize=12)
    return figure


def sided(name: str, side: str) -> str:
    """The angle's own name from its name in `paired`: `knee_flexion`, L -> `knee_L_flexion`."""
    joint, _, what = name.partition("_")
    return f"{joint}_{side}_{what}" if side else name


def _shade_outside(axes: Any, low: float, high: float) -> Any:
    """Shade beyond the usual range of an angle where that is near; the shaded area, None where there is none."""
    bottom, top = axes.get_ylim()
    reach = 0.35 * (top - bottom)  # so far the axis may grow to show a limit
    floor, ceiling = min(bottom, low - 0.1 * reach), max(top, high + 0.1 * reach)
    floor, ceiling = (floor if floor > bottom - reach else bottom), (ceiling if ceiling < top + reach else top)
    band = None
    for start, end, limit in ((floor, low, low), (high, ceiling, high)):
        if start < end:
            band = axes.axhspan(start, end, color="#F7DCD0", linewidth=0, zorder=0.5)
            axes.axhline(limit, color="#D98C66", linewidth=1, zorder=0.6)
    axes.set_ylim(floor, ceiling)
    return band


def time_axis(run: RunData) -> tuple[Array, str]:
    """The time axis: seconds, or frame numbers when the frames are unrelated."""
    return (run.seconds, "time (s)") if run.consecutive else (np.arange(len(run.joints), dtype=np.float64), "frame")


def trace(
    axes: Any, run: RunData, time: Array, value: Array, colour: str, text: str | None = None, style: str = "-"
) -> Any:
    """A line with gaps; points where a value stands alone between gaps or frames are unrelated; gaps shaded."""
    if not getattr(axes, "limbloc_shaded", False):
        axes.limbloc_shaded = True
        for start, end in gaps(run.found):
            half = 0.5 * (time[-1] - time[0]) / max(1, len(time) - 1)
            axes.axvspan(time[start] - half, time[end] + half, color="#ECEFF2", linewidth=0, zorder=0)
    if not run.consecutive:
        return axes.plot(time, value, ".", color=colour, markersize=7, label=text)[0]
    line = axes.plot(time, value, style, color=colour, label=text)[0]
    alone = np.isfinite(value) & ~np.isfinite(np.r_[np.nan, value[:-1]]) & ~np.isfinite(np.r_[value[1:], np.nan])
    axes.plot(time[alone], value[alone], ".", color=colour, markersize=5)
    return line


def gaps(found: Sequence[bool] | NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last frame of each run of frames without a person."""
    lost = np.flatnonzero(np.diff(np.r_[False, ~np.asarray(found, dtype=np.bool_), False].astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in lost.reshape(-1, 2)]


def _equal_box(axes: Any, path: Array) -> None:
    """The same scale on x, y and z, at least 30 cm wide."""
    seen = path[np.isfinite(path).all(axis=1)]
    if not len(seen):
        seen = np.zeros((1, 3))
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    half = max(0.15, float((seen.max(axis=0) - seen.min(axis=0)).max()) / 2) * 1.05
    for limit, m in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        limit(m - half, m + half)
    axes.set_box_aspect((1, 1, 1))


def _at_least(axes: Any, value: Array, span: float) -> None:
    """Do not blow up small changes: the axis spans at least `span`."""
    seen = value[np.isfinite(value)]
    if len(seen) and np.ptp(seen) < span:
        middle = (seen.min() + seen.max()) / 2
        axes.set_ylim(middle - span / 2, middle + span / 2)


def over(reduce: Any, values: Array) -> Array:
    """`reduce` over the joints [F, J] -> [F]; NaN where a frame has none."""
    out = np.full(len(values), np.nan)
    some = np.isfinite(values).any(axis=1)
    out[some] = reduce(values[some], axis=1)
    return out


def _largest(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0


def _count(number: int, noun: str) -> str:
    return f"no {noun}s" if number == 0 else f"1 {noun}" if number == 1 else f"{number} {noun}s"
