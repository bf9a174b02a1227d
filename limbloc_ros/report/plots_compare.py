# SPDX-License-Identifier: Apache-2.0
"""Plots of a run beside a reference: error over time and by joint, angles over each other, Bland-Altman."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from limbloc_ros.core.pose import JOINT, LIMB_JOINTS, Array
from limbloc_ros.export.stick_drawing import side_of
from limbloc_ros.report.compare import agreement
from limbloc_ros.report.plots import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    SIDES,
    STYLE,
    legend_above,
    new_figure,
    over,
    paired,
    sided,
    time_axis,
    trace,
    words,
)
from limbloc_ros.report.run import RunData

CLAIM_MM = 50.0


def error_over_time_and_by_joint(run: RunData) -> Figure:
    """Distance of the limb joints from the reference: over time, and its spread joint by joint."""
    error = run.error_m
    assert error is not None, "only called with a reference"
    limbs = [name for name in LIMB_JOINTS if np.isfinite(error[:, JOINT[name]]).any()]
    millimetres = 1000 * error[:, [JOINT[name] for name in limbs]]
    time, unit = time_axis(run)
    with rc_context(STYLE):
        figure = new_figure(12, 5.6)
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
        axes = halves[0].subplots()
        trace(axes, run, time, over(np.nanmedian, millimetres), BLUE, "median joint")
        trace(axes, run, time, over(np.nanmax, millimetres), ORANGE, "worst joint")
        axes.axhline(CLAIM_MM, color=INK, linewidth=1)
        axes.annotate(
            "5 cm", (0, CLAIM_MM), xytext=(4, 3), xycoords=("axes fraction", "data"), textcoords="offset points"
        )
        axes.set_ylim(0, max(60.0, 1.22 * float(np.nanmax(millimetres))))  # the legend above the lines
        axes.set_ylabel("distance from the reference (mm)")
        axes.set_xlabel(unit)
        axes.set_title("over time")
        axes.legend(loc="upper right", ncols=2)
        by_joint = halves[1].subplots()
        for row, (name, column) in enumerate(zip(limbs, millimetres.T, strict=True)):
            low, start, middle, end, high = np.nanpercentile(column, (5, 25, 50, 75, 95))
            by_joint.plot((low, high), (row, row), color=GREY, marker="|", markersize=9, zorder=2)
            by_joint.barh(row, end - start, left=start, height=0.62, color=SIDES[side_of(name)][0], zorder=3)
            by_joint.plot((middle, middle), (row - 0.31, row + 0.31), color="white", linewidth=1.8, zorder=4)
        by_joint.axvline(CLAIM_MM, color=INK, linewidth=1)
        by_joint.set_yticks(range(len(limbs)), [words(name) for name in limbs], fontsize=10.5)
        by_joint.invert_yaxis()
        by_joint.grid(axis="y", visible=False)
        by_joint.set_xlim(0, None)
        by_joint.set_xlabel("mm: median, quarter to three quarters, 5 to 95 %")
        by_joint.set_title("by joint")
    return figure


def angles_over_each_other(run: RunData, ours: Mapping[str, Array], theirs: Mapping[str, Array]) -> Figure:
    """Angles that both tell, over time: the run in colour, the reference in grey behind it."""
    groups = paired(ours)
    time, unit = time_axis(run)
    with rc_context(STYLE):
        figure = new_figure(12, 0.5 + 2.1 * len(groups))
        grid = figure.subplots(len(groups), 2, sharex=True, sharey="row", squeeze=False)
        for row, (name, sides) in zip(grid, groups.items(), strict=True):
            for axes, side in zip(row, "LR", strict=True):
                full = sided(name, side)
                trace(axes, run, time, np.degrees(theirs[full]), GREY, "reference").set_linewidth(3.2)
                trace(axes, run, time, np.degrees(sides[side]), SIDES[side][0], "run")
                axes.set_title(words(full))
                axes.tick_params(labelbottom=True)
            row[0].set_ylabel("degrees")
        handles = [Line2D([], [], color=GREY, linewidth=3.2, label="reference")]
        handles += [Line2D([], [], color=SIDES[side][0], label=f"run, {SIDES[side][2]}") for side in "LR"]
        legend_above(figure, handles, ncols=3)
        for axes in grid[-1]:
            axes.set_xlabel(unit)
    return figure


def bland_altman(ours: Mapping[str, Array], theirs: Mapping[str, Array]) -> Figure:
    """Difference over mean of each angle, with the bias and the 95 % limits of agreement (Bland and Altman 1986)."""
    groups = paired(ours)
    with rc_context(STYLE):
        columns = 2
        rows = -(-len(groups) // columns)
        figure = new_figure(12, 0.4 + 3.1 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.ravel()[len(groups) :]:
            axes.set_visible(False)
        for axes, (name, sides) in zip(grid.ravel(), groups.items(), strict=False):
            run_all, reference_all = [], []
            for side, value in sides.items():
                a, b = np.degrees(value), np.degrees(theirs[sided(name, side)])
                axes.plot((a + b) / 2, a - b, ".", color=SIDES[side][0], markersize=6, alpha=0.7, label=SIDES[side][2])
                run_all.append(a)
                reference_all.append(b)
            found = agreement(np.concatenate(run_all), np.concatenate(reference_all))
            if found is not None:
                low, high = found.limits
                axes.axhline(0, color="#C9CED4", linewidth=1)
                for level, style in ((found.bias, "-"), (low, "--"), (high, "--")):
                    axes.axhline(level, color=INK, linewidth=1.1, linestyle=style)
                    axes.annotate(
                        f"{level:+.1f}", (1, level), xytext=(4, 0), xycoords=("axes fraction", "data"),
                        textcoords="offset points", va="center", fontsize=10,
                    )  # fmt: skip
                reach = 1.35 * max(abs(low), abs(high), 5.0)
                inside = np.abs(np.concatenate(run_all) - np.concatenate(reference_all))
                axes.set_ylim(-max(reach, 1.05 * float(np.nanmax(inside))), max(reach, 1.05 * float(np.nanmax(inside))))
            axes.set_title(words(name))
            axes.set_xlabel("mean of run and reference (degrees)")
            axes.set_ylabel("run - reference (degrees)")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        legend_above(figure, handles, labels=labels, ncols=2, markerscale=1.6)
    return figure
