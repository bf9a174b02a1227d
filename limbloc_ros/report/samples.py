# SPDX-License-Identifier: Apache-2.0
"""The few frames of a run that the report shows in 3D, with hull, surface and pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.engine_paper import fit_state
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.geodesic import geodesic_map
from limbloc_ros.core.hull import Hull, carve
from limbloc_ros.core.pose import Array, Pose
from limbloc_ros.core.surface import Surface, extract_surface
from limbloc_ros.recordings.results import Run

Images = Mapping[str, NDArray[np.uint8]]


@dataclass(frozen=True)
class Sample:
    """One frame of the run with everything that its pictures need.

    Attributes:
        frame_index: which frame.
        hull: its visual hull.
        surface: the hull's surface.
        geodesic: [N] geodesic distance of each surface point from the centre of mass, m (inf where out of reach).
        pose: the fitted pose.
        anchors: points that the paper's engine went by, [3] m by name (`knee_L`, ...; see `paper_anchors`), for figs. 6
            and 7.
        images: camera name -> uint8 bgr [H, W, 3] image or [H, W] mask, for overlays; empty for none.
        rig: the cameras of the images.
    """

    frame_index: int
    hull: Hull
    surface: Surface
    geodesic: Array
    pose: Pose
    anchors: Mapping[str, Array] = field(default_factory=dict)
    images: Images = field(default_factory=dict)
    rig: Rig | None = None

    @staticmethod
    def of(
        frame_index: int,
        hull: Hull,
        pose: Pose,
        *,
        anchors: Mapping[str, Array] | None = None,
        images: Images | None = None,
        rig: Rig | None = None,
    ) -> Sample:
        """A sample whose surface and geodesic map are worked out from the hull."""
        surface = extract_surface(hull)
        return Sample(frame_index, hull, surface, geodesic_map(hull, surface), pose, anchors or {}, images or {}, rig)


def choose_frames(found: Sequence[bool] | NDArray[np.bool_], count: int = 6) -> list[int]:
    """Up to `count` frames with a person, spread evenly over the run, in order.

    Args:
        found: [F] which frames have a person.
        count: how many to choose, at least 1.
    """
    frames = np.flatnonzero(found)
    if len(frames) <= count:
        return [int(f) for f in frames]
    return [int(frames[round(k)]) for k in np.linspace(0, len(frames) - 1, 2 * count + 1)[1::2]]


def carve_samples(
    run: Run,
    frames: Sequence[int],
    masks_of: Callable[[int], Images],
    rig: Rig,
    config: HullConfig | None = None,
    images_of: Callable[[int], Images] | None = None,
    anchors_of: Callable[[Hull], Mapping[str, Array]] | None = None,
) -> list[Sample]:
    """Samples of a recorded run: its poses, with the hulls carved anew.

    Args:
        run: the recorded results.
        frames: which frames, e.g. `choose_frames(data.found)`; those without a pose or hull are left out.
        masks_of: frame -> masks by camera name.
        rig: the cameras.
        config: as the run was made with.
        images_of: frame -> images by camera name, for the overlays; by default the masks are shown.
        anchors_of: hull -> anchor points, e.g. `paper_anchors` for a run of the paper's engine.
    """
    samples = []
    for frame in frames:
        pose, masks = run.frames[frame].outcome, masks_of(frame)
        hull = carve(masks, rig, config or HullConfig())
        if isinstance(pose, Pose) and isinstance(hull, Hull):
            images = masks if images_of is None else images_of(frame)
            anchors = None if anchors_of is None else anchors_of(hull)
            samples.append(Sample.of(frame, hull, pose, anchors=anchors, images=images, rig=rig))
    return samples


def paper_anchors(hull: Hull) -> dict[str, Array]:
    """The points that the paper's engine goes by in this hull, found anew: as slow as a fit by that engine.

    Returns:
        [3] m by name: `head`, `centre_of_mass`, and of each limb found `knee_L`, `ankle_L`, `toe_L`, ... or `elbow_L`,
        `wrist_L`, `fingertip_L`, ...
    """
    found = fit_state(hull)
    if isinstance(found, NoPerson):
        return {}
    branch, seen = found
    points = {"head": branch.head.centre, "centre_of_mass": seen.centre_of_mass}
    for name, limb in branch.limbs.items():
        kind, side = name.split("_")
        joints = ("knee", "ankle", "toe") if kind == "leg" else ("elbow", "wrist", "fingertip")
        points |= {f"{joint}_{side}": point for joint, point in zip(joints, limb.points, strict=True)}
    return points
