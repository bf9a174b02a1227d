# SPDX-License-Identifier: Apache-2.0
"""Run -> report: the paper's results section made from a run, as PNG pictures and one HTML page."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from pathlib import Path

from limbloc_ros.files import write_bytes
from limbloc_ros.report.compare import limb_angles
from limbloc_ros.report.page import Section, Table, build_page
from limbloc_ros.report.plots_motion import ranges_table
from limbloc_ros.report.plots_people import people_table
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import Sample
from limbloc_ros.report.sections import comparison_pictures, run_pictures, sample_pictures
from limbloc_ros.report.summary import agreement_table, error_table, jump_table, summary

PAGE = "report.html"


def write_report(
    run: RunData,
    samples: Sequence[Sample],
    out_dir: str | Path,
    *,
    created: datetime.datetime | None = None,
    on_picture: Callable[[str, int, int], None] | None = None,
) -> Path:
    """Write the report's pictures and its page into `out_dir`, which is made if need be.

    Args:
        run: the results.
        samples: frames to show in 3D (six are a good number); without any the 3D pictures are left out and the page
            says so.
        out_dir: gets one PNG per picture and `report.html`, which holds them all and needs no other file.
        created: date on the page; by default now.
        on_picture: called with a picture's name, its number from 0 and how many there are, before each is drawn.

    Returns:
        the page's path.

    Raises:
        OutputError: the folder cannot be written to.
    """
    folder = Path(out_dir)
    todo = [*sample_pictures(run, samples), *run_pictures(run), *comparison_pictures(run)]
    sections = [_summary_section(run, samples)]
    for number, picture in enumerate(todo):
        if on_picture is not None:
            on_picture(picture.heading, number, len(todo))
        png = picture.make()
        write_bytes(folder / f"{picture.key}.png", png)
        sections.append(Section(picture.key, picture.heading, picture.text, png, wide=picture.wide))
    sections += _closing_sections(run)
    when = (created or datetime.datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M %Z").strip()
    about = [line for line in (run.source, f"limbloc_ros {run.version}, {when}") if line]
    page = build_page(run.title, about, sections, f"Made by limbloc_ros {run.version} on {when}.")
    write_bytes(folder / PAGE, page.encode("utf-8"))
    return folder / PAGE


def _summary_section(run: RunData, samples: Sequence[Sample]) -> Section:
    text = "" if samples else "No frame was given with its hull, so the pictures of hull and figure are left out."
    return Section("summary", "Summary", text, tables=[Table(summary(run))])


def _closing_sections(run: RunData) -> list[Section]:
    found = []
    people = people_table(run)
    if people:
        people_head = ("person", "frames", "reliable", "seen")
        found.append(Section("people", "People", tables=[Table(people, people_head)]))
    errors = error_table(run)
    if errors:
        joint_head = ("joint", "mean (mm)", "median (mm)", "RMS (mm)", "95th percentile (mm)", "within 5 cm")
        text = "Distance from the " + ("true joints" if run.truth_kind == "true" else "reference")
        text += ", over the frames with a person. " + " ".join(f"{line}." for line in run.truth_about)
        found.append(Section("errors", "Error by joint", text.strip(), tables=[Table(errors, joint_head)]))
    if run.truth is not None:
        angle_head = ("angle", "frames", "bias", "95 % limits", "mean abs.", "RMS", "r")
        text = (
            "Run minus reference, degrees. The first eight angles are told by the joints' places alone, so that any "
            "system's joints give them."
        )
        rows = agreement_table(limb_angles(run.joints), limb_angles(run.truth))
        rows += agreement_table(run.angles, run.truth_angles)
        if rows:
            found.append(Section("agreement", "Agreement of angles", text, tables=[Table(rows, angle_head)]))
    ranges = ranges_table(run)
    if ranges:
        range_head = ("angle", "least", "median", "greatest", "range", "usual", "outside usual")
        text = "Degrees; zero is a person who stands straight with hanging arms."
        found.append(Section("ranges", "Ranges of motion", text, tables=[Table(ranges, range_head)]))
    jumped = jump_table(run)
    if jumped:
        text = "Frames at which a joint moved far more than usual from one frame to the next."
        found.append(Section("jumps", "Jumps", text, tables=[Table(jumped, ("frame", "time", "joints"))]))
    reasons = run.missing_reasons()
    if reasons:
        rows = [[reason, str(count)] for reason, count in reasons]
        found.append(Section("missing", "Frames without a person", tables=[Table(rows, ("reason", "frames"))]))
    made = [["command", run.command]] if run.command else []
    rows = [*made, *([name, value] for name, value in run.settings.items())]
    if rows:
        found.append(Section("settings", "How it was made", tables=[Table(rows, code_values=True)]))
    return found
