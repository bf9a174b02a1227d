# SPDX-License-Identifier: Apache-2.0
"""Which pictures a report has, with their captions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from limbloc_ros.core.errors import InputError
from limbloc_ros.report import pictures, plots, plots_compare, plots_motion, plots_people
from limbloc_ros.report.compare import limb_angles
from limbloc_ros.report.overlay import overlay_montage
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import Sample

#: So many of the samples are also shown with the hull's fields (geodesic distance, curvature, normals).
FIELD_SAMPLES = 3


@dataclass(frozen=True)
class ReportPicture:
    """One picture: file name and anchor, heading, caption, how it is made, and whether it wants the page's width."""

    key: str
    heading: str
    text: str
    make: Callable[[], bytes]
    wide: bool = False


def sample_pictures(run: RunData, samples: Sequence[Sample]) -> list[ReportPicture]:
    if not samples:
        return []
    few = _spread(samples, FIELD_SAMPLES)
    found = [
        ReportPicture(
            "stick_figure",
            "Stick figure over the hull",
            f"{len(samples)} frames of the run, as in the paper's figs. 8 and 9: the fitted stick figure inside the "
            "visual hull. The person's own left is blue, the right orange. All frames have the same scale; lines on "
            "the floor are 0.5 m apart.",
            lambda: figure_png(pictures.stick_over_hull(run, samples)),
        ),
        ReportPicture(
            "flesh_figure",
            "Flesh figure over the hull",
            "The same frames with the fitted flesh figure (the model of the paper's fig. 2, right). Where the pale "
            "hull stands out beyond the figure, or the figure beyond the hull, the energy of eq. 2 counts it.",
            lambda: figure_png(pictures.flesh_over_hull(run, samples)),
        ),
        ReportPicture(
            "geodesic_distance",
            "Geodesic distance",
            "The hull coloured by the distance along its surface from the point nearest the centre of mass, as in the "
            "paper's fig. 1 (right), with a line every 10 cm. Hands, feet and head are its far ends; where an arm "
            "touches the trunk the short cut shows (the paper's closed loop problem).",
            lambda: figure_png(pictures.geodesic_sheet(few)),
        ),
        ReportPicture(
            "curvature",
            "Curvature",
            "The hull coloured by curvature, the mean angle between a surface voxel's normal and its neighbours', as "
            "in the paper's fig. 4: flat is pale, sharply curved is blue.",
            lambda: figure_png(pictures.curvature_sheet(few)),
        ),
        ReportPicture(
            "normals",
            "Surface normals",
            "Normals of every sixth surface voxel by the 3D Sobel filter (eq. 1), as in the paper's fig. 3. Colour is "
            "direction: red, green and blue are the shares along x, y and z.",
            lambda: figure_png(pictures.normals_sheet(few)),
        ),
    ]
    anchored = [sample for sample in samples if sample.anchors]
    if anchored:
        found.append(
            ReportPicture(
                "anchor_points",
                "Anchor points",
                "What the paper's engine went by, as in its figs. 6 and 7: the points found on the hull by curvature "
                "and geodesic distance. The person's own left is blue, the right orange.",
                lambda: figure_png(pictures.anchors_sheet(_spread(anchored, FIELD_SAMPLES))),
            )
        )
    with_images = [sample for sample in samples if sample.images and sample.rig is not None]
    if with_images:
        shown = with_images[len(with_images) // 2]
        found.append(
            ReportPicture(
                "overlay",
                "Stick figure over the images",
                f"Frame {shown.frame_index}: the stick figure projected into each camera's own image, lens distortion "
                "included. Each image is cut to the part around the person.",
                lambda: image_png(_overlay(shown)),
                wide=True,
            )
        )
    return found


def run_pictures(run: RunData) -> list[ReportPicture]:
    found = []
    if run.people:
        found.append(
            ReportPicture(
                "everybody",
                "Everybody",
                "The paths of everybody's pelvis on the floor plan, and when each person was there: thick where the "
                "pose was reliable. All other pictures are of the person who was followed longest at the time; the "
                "folder people/ has a run for each, which can be reported alike.",
                lambda: figure_png(plots_people.everybody(run)),
                wide=True,
            )
        )
    if run.found.any():
        order = "consecutive frames" if run.consecutive else "unrelated frames"
        marks = " Jumps, steps far longer than usual, carry a cross; frames without a person are grey gaps."
        found.append(
            ReportPicture(
                "head_path",
                "Path of the head",
                f"The head's position in {len(run.joints)} {order}, as in the paper's fig. 10."
                + (marks if run.consecutive else ""),
                lambda: figure_png(plots.head_path(run)),
                wide=True,
            )
        )
        found.append(
            ReportPicture(
                "trajectories",
                "Trajectories",
                "The paths of pelvis, wrists and ankles on the floor plan, the beginning as a white dot, and the "
                "heights of head, wrists and toes. The person's own left is blue, the right orange.",
                lambda: figure_png(plots_motion.trajectories(run)),
                wide=True,
            )
        )
        if run.angles:
            if plots_motion.ranges_table(run):
                found.append(
                    ReportPicture(
                        "ranges_of_motion",
                        "Ranges of motion",
                        "Thin lines reach from least to greatest, thick ones hold 90 % of the frames, with "
                        "the median in white; the pale bar behind is what people usually can do.",
                        lambda: figure_png(plots_motion.ranges_of_motion(run)),
                        wide=True,
                    )
                )
            found.append(
                ReportPicture(
                    "joint_angles",
                    "Joint angles",
                    "All joint angles of the figure over time, left blue and right orange (dashed). In brackets the "
                    "usual human range; what lies beyond is shaded where it is near."
                    + (marks if run.consecutive else ""),
                    lambda: figure_png(plots.joint_angles(run)),
                    wide=True,
                )
            )
        found.append(
            ReportPicture(
                "energy",
                "Energy and confidence",
                "Above, the XOR energy of eq. 2. Below, the error that the fit itself expects of the joints"
                + (_and_truth(run)),
                lambda: figure_png(plots.energy_and_confidence(run)),
                wide=True,
            )
        )
        found.append(
            ReportPicture(
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
            ReportPicture(
                "stage_times",
                "Time per stage",
                "Process time of each stage on one core.",
                lambda: figure_png(plots.stage_times(run)),
            )
        )
    return found


def comparison_pictures(run: RunData) -> list[ReportPicture]:
    """Pictures of a run beside the truth or a reference; none without."""
    error = run.error_m
    if run.truth is None or error is None or not np.isfinite(error).any():
        return []
    ours, theirs = limb_angles(run.joints), limb_angles(run.truth)
    shared = {name: value for name, value in ours.items() if np.isfinite(value - theirs[name]).sum() > 1}
    whole = {n: v for n, v in shared.items() if n.replace("_L_", "_R_") in shared and n.replace("_R_", "_L_") in shared}
    what = "the truth" if run.truth_kind == "true" else "the reference"
    about = " ".join(f"{line}." for line in run.truth_about)
    found = [
        ReportPicture(
            "error",
            f"Distance from {what}",
            f"How far the joints of head and limbs lie from {what}, over time and joint by joint. {about}".strip(),
            lambda: figure_png(plots_compare.error_over_time_and_by_joint(run)),
            wide=True,
        )
    ]
    if whole:
        found.append(
            ReportPicture(
                "limb_angles",
                f"Limb angles beside {what}",
                f"Angles that the joints' places alone tell, 0 for a straight limb or a hanging arm; {what} in grey.",
                lambda: figure_png(plots_compare.angles_over_each_other(run, whole, theirs)),
                wide=True,
            )
        )
        found.append(
            ReportPicture(
                "bland_altman",
                "Bland-Altman",
                f"The difference between the run and {what} over the mean of both, frame by frame. Solid: the bias. "
                "Dashed: the 95 % limits of agreement, 1.96 standard deviations on either side.",
                lambda: figure_png(plots_compare.bland_altman(whole, theirs)),
                wide=True,
            )
        )
    return found


def _and_truth(run: RunData) -> str:
    if run.truth is None:
        return "."
    return ", and their true error." if run.truth_kind == "true" else ", and their distance from the reference."


def figure_png(figure: Figure) -> bytes:
    """A matplotlib figure as PNG, the same bytes for the same figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return image_png(np.ascontiguousarray(rgba[..., 2::-1]))


def image_png(bgr: np.ndarray) -> bytes:
    """A uint8 bgr image as PNG."""
    done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 7])
    if not done:
        raise InputError(f"an image of shape {bgr.shape} cannot be encoded as PNG")
    return bytes(data)


def _overlay(sample: Sample) -> np.ndarray:
    if sample.rig is None:
        raise InputError(f"frame {sample.frame_index}: an overlay needs the rig of its images, got none")
    return overlay_montage(sample.images, sample.rig, sample.pose.joints, close_up=True, panel_width_px=300, columns=4)


def _spread(samples: Sequence[Sample], count: int) -> list[Sample]:
    if len(samples) <= count:
        return list(samples)
    return [samples[round(k)] for k in np.linspace(0, len(samples) - 1, count)]
