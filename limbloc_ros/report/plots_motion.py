# SPDX-License-Identifier: Apache-2.0
"""Plots of the movement: where the body's ends went, and which ranges the joints used."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from limbloc_ros.core.pose import Array
from limbloc_ros.report.plots import (
    GREY,
    INK,
    SIDES,
    STYLE,
    USUAL_DEG,
    legend_above,
    new_figure,
    paired,
    sided,
    time_axis,
    trace,
    words,
)
from limbloc_ros.report.run import RunData

#: Joint (without its side) -> how it is called in the plot of heights.
_HEIGHTS = (("head_top", "head"), ("wrist", "wrists"), ("toe", "toes"))
#: A dot on the floor plan about every so many seconds.
_MARK_S = 1.0


def trajectories(run: RunData) -> Figure:
    """The paths of pelvis, hands and feet seen from above, and the heights of head, hands and feet over time."""
    time, unit = time_axis(run)
    with rc_context(STYLE):
        figure = new_figure(12, 6.2)
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.1))
        plan = halves[0].subplots()
        paths = [("pelvis_centre", "", 2.2), *((f"{j}_{s}", s, 1.2) for j in ("wrist", "ankle") for s in "LR")]
        for name, side, width in paths:
            colour, _, _ = SIDES[side]
            path = run.joint_path(name)
            style = "--" if name.startswith("wrist") else "-"
            if run.consecutive:
                plan.plot(path[:, 0], path[:, 1], style, color=colour, linewidth=width, alpha=0.9 if not side else 0.6)
            else:
                plan.plot(path[:, 0], path[:, 1], ".", color=colour, markersize=5)
        pelvis = run.joint_path("pelvis_centre")
        if run.consecutive:
            _time_marks(plan, run, pelvis)
        plan.set_aspect("equal", adjustable="datalim")
        plan.set_xlabel("x (m)")
        plan.set_ylabel("y (m)")
        plan.set_title("seen from above")
        handles = [
            Line2D([], [], color=INK, linewidth=2.2, label="pelvis"),
            Line2D([], [], color=GREY, linestyle="--", label="wrists"),
            Line2D([], [], color=GREY, label="ankles"),
        ]
        plan.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=10.5)
        rows = halves[1].subplots(len(_HEIGHTS), 1, sharex=True)
        for row, (joint, text) in zip(rows, _HEIGHTS, strict=True):
            for side in ("",) if joint == "head_top" else "LR":
                colour, style, label = SIDES[side]
                trace(row, run, time, run.joint_path(f"{joint}_{side}" if side else joint)[:, 2], colour, label, style)
            row.set_ylabel(f"{text}, z (m)")
            low, high = row.get_ylim()
            if high - low < 0.2:
                low, high = (low + high) / 2 - 0.1, (low + high) / 2 + 0.1
            row.set_ylim(low, high + (0.3 * (high - low) if row is rows[1] else 0.0))  # the legend above the lines
        rows[1].legend(loc="upper right", ncols=2, fontsize=10.5)
        rows[0].set_title("heights over the floor")
        rows[-1].set_xlabel(unit)
    return figure


def ranges_of_motion(run: RunData) -> Figure:
    """Every joint angle's range in the run, beside the usual human range."""
    groups = {
        name: sides
        for name, sides in paired(run.angles).items()
        if any(sided(name, side) in USUAL_DEG for side in sides)
    }
    with rc_context(STYLE):
        figure = new_figure(11, 1.2 + 0.36 * len(groups))
        axes = figure.subplots()
        for row, (name, sides) in enumerate(groups.items()):
            low, high = USUAL_DEG[sided(name, next(iter(sides)))]
            axes.barh(row, high - low, left=low, height=0.78, color="#E9ECEF", zorder=1)
            for side, value in sides.items():
                seen = np.degrees(value[np.isfinite(value)])
                if not len(seen):
                    continue
                at = row + {"L": -0.18, "R": 0.18, "": 0.0}[side]
                colour, _, _ = SIDES[side]
                ends, (few, middle, most) = (seen.min(), seen.max()), np.percentile(seen, (5, 50, 95))
                axes.plot(ends, (at, at), color=colour, linewidth=1.2, zorder=2)
                axes.plot((few, most), (at, at), color=colour, linewidth=5, solid_capstyle="butt", zorder=3)
                axes.plot(middle, at, "|", color="white", markersize=6, markeredgewidth=1.6, zorder=4)
        axes.axvline(0, color=INK, linewidth=0.8, zorder=1.5)
        axes.set_yticks(range(len(groups)), [words(name) for name in groups], fontsize=11)
        axes.set_ylim(len(groups) - 0.4, -0.6)
        axes.margins(x=0.02)
        axes.autoscale(axis="x")
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("degrees")
        handles = [Line2D([], [], color=SIDES[s][0], linewidth=5, label=SIDES[s][2]) for s in ("L", "R", "")]
        handles.append(Line2D([], [], color="#E9ECEF", linewidth=9, label="usual human range"))
        legend_above(figure, handles, ncols=4, fontsize=11)
    return figure


def ranges_table(run: RunData) -> list[list[str]]:
    """Angle, least, median, greatest, range and usual range in degrees, share of frames outside the usual range."""
    table = []
    for name, value in run.angles.items():
        seen = np.degrees(value[np.isfinite(value)])
        if not len(seen) or name not in USUAL_DEG:
            continue
        low, high = USUAL_DEG[name]
        outside = float(np.mean((seen < low) | (seen > high)))
        numbers = (seen.min(), np.median(seen), seen.max(), np.ptp(seen))
        usual = f"{low:.0f} to {high:.0f}"
        table.append([words(name), *(f"{v:.0f}" for v in numbers), usual, f"{100 * outside:.0f} %"])
    return table


def _time_marks(axes: Any, run: RunData, path: Array) -> None:
    """Dots with the time along a path, and an open one where it begins."""
    seconds = run.seconds
    seen = np.flatnonzero(np.isfinite(path).all(axis=1))
    if not len(seen):
        return
    axes.plot(*path[seen[0], :2], "o", markerfacecolor="white", markeredgecolor=INK, markersize=8, zorder=5)
    total = seconds[seen[-1]] - seconds[seen[0]]
    step = _MARK_S * max(1, round(total / 8))
    for mark in np.arange(step, total + 1e-9, step):
        at = seen[np.argmin(np.abs(seconds[seen] - seconds[seen[0]] - mark))]
        axes.plot(*path[at, :2], "o", color=INK, markersize=5, zorder=5)
        text = axes.annotate(f"{mark:.0f} s", path[at, :2], xytext=(6, 5), textcoords="offset points", zorder=6)
        text.set(fontsize=10, path_effects=[withStroke(linewidth=2.5, foreground="white")])
