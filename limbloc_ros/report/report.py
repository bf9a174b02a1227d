# SPDX-License-Identifier: Apache-2.0
"""Run -> report: the paper's results section made from a run, as PNG pictures and one HTML page."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from limbloc_ros.core.errors import InputError
from limbloc_ros.report import pictures, plots
from limbloc_ros.report.overlay import overlay_montage
from limbloc_ros.report.page import Section, Table, build_page
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import Sample
from limbloc_ros.report.summary import error_table, summary

PAGE = "report.html"
#: So many of the samples are also shown with the hull's fields (geodesic distance, curvature, normals).
FIELD_SAMPLES = 3


@dataclass(frozen=True)
class _Picture:
    key: str
    heading: str
    text: str
    make: Callable[[], bytes]
    wide: bool = False


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
        InputError: the folder cannot be written to.
    """
    folder = Path(out_dir)
    todo = [*_sample_pictures(run, samples), *_run_pictures(run)]
    sections = [_summary_section(run, samples)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, picture in enumerate(todo):
            if on_picture is not None:
                on_picture(picture.heading, number, len(todo))
            png = picture.make()
            _write(folder / f"{picture.key}.png", png)
            sections.append(Section(picture.key, picture.heading, picture.text, png, wide=picture.wide))
        sections += _closing_sections(run)
        when = (created or datetime.datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M %Z").strip()
        about = [line for line in (run.source, f"limbloc_ros {run.version}, {when}") if line]
        page = build_page(run.title, about, sections, f"Made by limbloc_ros {run.version} on {when}.")
        _write(folder / PAGE, page.encode("utf-8"))
    except OSError as error:
        raise InputError(
            f"the report cannot be written to {folder}: {error.strerror or error}; make room or choose another folder"
        ) from error
    return folder / PAGE


def figure_png(figure: Figure) -> bytes:
    """A matplotlib figure as PNG, the same bytes for the same figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return image_png(np.ascontiguousarray(rgba[..., 2::-1]))


def image_png(bgr: np.ndarray) -> bytes:
    """A uint8 bgr image as PNG."""
    done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise InputError(f"an image of shape {bgr.shape} cannot be encoded as PNG")
    return bytes(data)


def _sample_pictures(run: RunData, samples: Sequence[Sample]) -> list[_Picture]:
    if not samples:
        return []
    few = _spread(samples, FIELD_SAMPLES)
    found = [
        _Picture(
            "stick_figure",
            "Stick figure over the hull",
            f"{len(samples)} frames of the run, as in the paper's figs. 8 and 9: the fitted stick figure inside the "
            "visual hull. The person's own left is blue, the right orange. All frames have the same scale; lines on "
            "the floor are 0.5 m apart.",
            lambda: figure_png(pictures.stick_over_hull(run, samples)),
        ),
        _Picture(
            "flesh_figure",
            "Flesh figure over the hull",
            "The same frames with the fitted flesh figure (the model of the paper's fig. 2, right). Where the pale "
            "hull stands out beyond the figure, or the figure beyond the hull, the energy of eq. 2 counts it.",
            lambda: figure_png(pictures.flesh_over_hull(run, samples)),
        ),
        _Picture(
            "geodesic_distance",
            "Geodesic distance",
            "The hull coloured by the distance along its surface from the point nearest the centre of mass, as in the "
            "paper's fig. 1 (right), with a line every 10 cm. Hands, feet and head are its far ends; where an arm "
            "touches the trunk the short cut shows (the paper's closed loop problem).",
            lambda: figure_png(pictures.geodesic_sheet(run, few)),
        ),
        _Picture(
            "curvature",
            "Curvature",
            "The hull coloured by curvature, the mean angle between a surface voxel's normal and its neighbours', as "
            "in the paper's fig. 4: flat is pale, sharply curved is blue.",
            lambda: figure_png(pictures.curvature_sheet(run, few)),
        ),
        _Picture(
            "normals",
            "Surface normals",
            "Normals of every sixth surface voxel by the 3D Sobel filter (eq. 1), as in the paper's fig. 3. Colour is "
            "direction: red, green and blue are the shares along x, y and z.",
            lambda: figure_png(pictures.normals_sheet(run, few)),
        ),
    ]
    anchored = [sample for sample in samples if sample.anchors]
    if anchored:
        found.append(
            _Picture(
                "anchor_points",
                "Anchor points",
                "What the paper's engine went by, as in its figs. 6 and 7: the points found on the hull by curvature "
                "and geodesic distance. The person's own left is blue, the right orange.",
                lambda: figure_png(pictures.anchors_sheet(run, _spread(anchored, FIELD_SAMPLES))),
            )
        )
    with_images = [sample for sample in samples if sample.images and sample.rig is not None]
    if with_images:
        shown = with_images[len(with_images) // 2]
        found.append(
            _Picture(
                "overlay",
                "Stick figure over the images",
                f"Frame {shown.frame_index}: the stick figure projected into each camera's own image, lens distortion "
                "included. Each image is cut to the part around the person.",
                lambda: image_png(_overlay(shown)),
                wide=True,
            )
        )
    return found


def _run_pictures(run: RunData) -> list[_Picture]:
    found = []
    if run.found.any():
        order = "consecutive frames" if run.consecutive else "unrelated frames"
        marks = " Jumps, steps far longer than usual, carry a cross; frames without a person are grey gaps."
        found.append(
            _Picture(
                "head_path",
                "Path of the head",
                f"The head's position in {len(run.joints)} {order}, as in the paper's fig. 10."
                + (marks if run.consecutive else ""),
                lambda: figure_png(plots.head_path(run)),
                wide=True,
            )
        )
        if run.angles:
            found.append(
                _Picture(
                    "joint_angles",
                    "Joint angles",
                    "All joint angles of the figure over time, left blue and right orange (dashed)."
                    + (marks if run.consecutive else ""),
                    lambda: figure_png(plots.joint_angles(run)),
                    wide=True,
                )
            )
        found.append(
            _Picture(
                "energy",
                "Energy and confidence",
                "Above, the XOR energy of eq. 2. Below, the error that the fit itself expects of the joints"
                + (", and their true error." if run.truth is not None else "."),
                lambda: figure_png(plots.energy_and_confidence(run)),
                wide=True,
            )
        )
        found.append(
            _Picture(
                "bone_lengths",
                "Bone lengths",
                "Lengths of the stick figure's bones over time. One person's bones do not change, so the spread "
                "(standard deviation, in brackets) shows how steady the fit is.",
                lambda: figure_png(plots.bone_lengths(run)),
                wide=True,
            )
        )
    if any(np.isfinite(value).any() for value in run.stage_ms.values()):
        found.append(
            _Picture(
                "stage_times",
                "Time per stage",
                "Process time of each stage on one core.",
                lambda: figure_png(plots.stage_times(run)),
            )
        )
    return found


def _summary_section(run: RunData, samples: Sequence[Sample]) -> Section:
    text = "" if samples else "No frame was given with its hull, so the pictures of hull and figure are left out."
    return Section("summary", "Summary", text, tables=[Table(summary(run))])


def _closing_sections(run: RunData) -> list[Section]:
    found = []
    errors = error_table(run)
    if errors:
        head = ("joint", "mean (mm)", "median (mm)", "95th percentile (mm)", "within 5 cm")
        text = "Distance from the true joints, over the frames with a person."
        found.append(Section("errors", "Error by joint", text, tables=[Table(errors, head)]))
    reasons = run.missing_reasons()
    if reasons:
        rows = [(reason, str(count)) for reason, count in reasons]
        found.append(Section("missing", "Frames without a person", tables=[Table(rows, ("reason", "frames"))]))
    made = [("command", run.command)] if run.command else []
    rows = [*made, *run.settings.items()]
    if rows:
        found.append(Section("settings", "How it was made", tables=[Table(rows, code_values=True)]))
    return found


def _overlay(sample: Sample) -> np.ndarray:
    if sample.rig is None:
        raise InputError(f"frame {sample.frame_index}: an overlay needs the rig of its images, got none")
    return overlay_montage(sample.images, sample.rig, sample.pose.joints, close_up=True, panel_width_px=300, columns=4)


def _spread(samples: Sequence[Sample], count: int) -> list[Sample]:
    if len(samples) <= count:
        return list(samples)
    return [samples[round(k)] for k in np.linspace(0, len(samples) - 1, count)]


def _write(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it: no reader ever sees half of it."""
    temporary = path.with_name(f".{path.name}.writing")
    temporary.write_bytes(data)
    temporary.replace(path)
