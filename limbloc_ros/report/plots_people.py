# SPDX-License-Identifier: Apache-2.0
"""Everybody of a run with several people: where they went, and when they were there."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from limbloc_ros.core.pose import JOINT
from limbloc_ros.report.plots import BLUE, GREEN, GREY, INK, ORANGE, STYLE, new_figure, time_axis
from limbloc_ros.report.run import RunData

#: By id, in turn.
COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")


def everybody(run: RunData) -> Figure:
    """The pelvis of everybody seen from above, and when each was there; thin where the pose was not reliable."""
    time, unit = time_axis(run)
    with rc_context(STYLE):
        figure = new_figure(12, 5.2)
        axes: Any = figure.subplots(1, 2, width_ratios=(1.0, 1.2))
        plan, when = axes
        for row, (name, joints) in enumerate(run.people.items()):
            colour = COLOURS[row % len(COLOURS)]
            pelvis = joints[:, JOINT["pelvis_centre"]]
            plan.plot(pelvis[:, 0], pelvis[:, 1], color=colour, label=name)
            there, sure = np.isfinite(pelvis[:, 0]), run.people_reliable[name]
            when.plot(time, np.where(there, row, np.nan), color=colour, linewidth=1.5)
            when.plot(time, np.where(there & sure, row, np.nan), color=colour, linewidth=7, solid_capstyle="butt")
        plan.set_aspect("equal", adjustable="datalim")
        plan.set_xlabel("x (m)")
        plan.set_ylabel("y (m)")
        plan.set_title("seen from above")
        plan.legend(loc="best")
        when.set_yticks(range(len(run.people)), list(run.people), color=INK)
        when.set_ylim(-0.6, len(run.people) - 0.4)
        when.set_xlim(float(time[0]), float(max(time[-1], time[0] + 1e-3)))
        when.set_xlabel(unit)
        when.set_title("who was there", color=INK)
        when.grid(axis="y", color=GREY, alpha=0.2)
    return figure


def people_table(run: RunData) -> list[list[str]]:
    """Id, frames with a pose, of these reliable, first and last seen, of everybody; empty for one person."""
    rows = []
    for name, joints in run.people.items():
        there = np.isfinite(joints[:, 0, 0])
        seen = np.flatnonzero(there)
        span = f"{run.seconds[seen[0]]:.1f} to {run.seconds[seen[-1]]:.1f} s" if len(seen) else "never"
        rows.append([name, str(len(seen)), str(int((there & run.people_reliable[name]).sum())), span])
    return rows
