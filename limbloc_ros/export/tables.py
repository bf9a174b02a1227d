# SPDX-License-Identifier: Apache-2.0
"""A run -> one wide CSV table: a row per frame with time, confidence, every joint and every angle."""

from __future__ import annotations

import csv
import io
import math

from limbloc_ros.core.pose import JOINT_NAMES, Pose
from limbloc_ros.recordings.results import Run, stamp_text


def csv_text(run: Run, *, first: int = 0, last: int | None = None, only_reliable: bool = False) -> str:
    """The table's text; frames without a pose have empty cells, and say why in the last column.

    Columns: `frame`, `stamp_s`, `reliable`, `energy`, per joint `<joint>_x_m`, `_y_m`, `_z_m` (world axes, z up) and
    `<joint>_sigma_m`, per angle `<angle>_rad`, `reason`.
    """
    names = run.angle_names
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{joint}_{what}_m" for joint in JOINT_NAMES for what in ("x", "y", "z", "sigma")]
    writer.writerow(["frame", "stamp_s", "reliable", "energy", *columns, *(f"{n}_rad" for n in names), "reason"])
    for number, frame in list(enumerate(run.frames))[first : None if last is None else last + 1]:
        stamp = stamp_text(frame.stamp_ns)
        pose = frame.outcome
        if not isinstance(pose, Pose):
            writer.writerow([number, stamp, 0, "", *[""] * (len(columns) + len(names)), pose.reason])
        elif only_reliable and not pose.reliable:
            writer.writerow([number, stamp, 0, "", *[""] * (len(columns) + len(names)), "not reliable"])
        else:
            cells = [
                f"{value:.6f}"
                for place, sigma in zip(pose.joints, pose.sigma, strict=True)
                for value in (*place, sigma)
            ]
            angles = [pose.angles.get(name, math.nan) for name in names]
            known = ["" if math.isnan(angle) else f"{angle:.6f}" for angle in angles]
            writer.writerow([number, stamp, int(pose.reliable), f"{pose.energy:.6g}", *cells, *known, ""])
    return text.getvalue()
