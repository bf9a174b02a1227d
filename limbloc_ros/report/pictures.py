# SPDX-License-Identifier: Apache-2.0
"""The report's 3D pictures: figure over the hull, geodesic map, curvature, normals, anchor points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.pose import JOINT, Array
from limbloc_ros.export.stick_drawing import side_of
from limbloc_ros.report.mesh import (
    SIDE_COLOURS,
    Mesh,
    balls,
    capsule,
    flesh_figure_mesh,
    hull_mesh,
    needles,
    stick_mesh,
    with_field,
)
from limbloc_ros.report.renderer import Layer, Picture, look_at, render
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import Sample

PANEL_PX = (400, 540)
FIELD_OF_VIEW_RAD = 0.45
ELEVATION_RAD = 0.22
DPI = 100

#: Flat is pale, sharply curved is blue, as in the paper's fig. 4.
CURVATURE_MAP = ListedColormap(colormaps["YlGnBu"](np.linspace(0.04, 1.0, 256)), name="curvature")
GEODESIC_MAP: Colormap = colormaps["viridis"]
#: A darker line on the geodesic map at every multiple of this.
ISOLINE_M = 0.1
#: Anchor points that are joined by a rod when both were found.
ANCHOR_CHAIN = (("knee", "ankle"), ("ankle", "toe"), ("elbow", "wrist"), ("wrist", "fingertip"))


def heading_rad(joints: Array) -> float:
    """Where the person's front points, about world z; for a lying body, where its left side points."""
    left = joints[JOINT["hip_L"]] - joints[JOINT["hip_R"]]
    up = joints[JOINT["neck_base"]] - joints[JOINT["pelvis_centre"]]
    front = np.cross(left, up)
    if np.hypot(front[0], front[1]) < 0.35 * np.linalg.norm(front):
        front = left
    return float(np.arctan2(front[1], front[0]))


def view_of(sample: Sample, mesh: Mesh, turn_rad: float, distance_m: float, size_px: tuple[int, int]) -> Camera:
    """A view of the person's front, turned by `turn_rad`, with the hull in the middle."""
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    azimuth = heading_rad(sample.pose.joints) + turn_rad
    return look_at(centre, azimuth, ELEVATION_RAD, distance_m, size_px, FIELD_OF_VIEW_RAD)


def fitting_distance(
    sample: Sample, mesh: Mesh, turn_rad: float, size_px: tuple[int, int], fill: float = 0.86
) -> float:
    """From how far away the whole mesh fills `fill` of the picture, m."""
    far = view_of(sample, mesh, turn_rad, 100.0, size_px)
    T = far.T_camera_world
    p = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    half = np.array(size_px) / 2 * fill
    return float(np.max(np.abs(p[:, :2]) * far.K[0, 0] / half + (100.0 - p[:, 2])[:, None]))


def panels(
    samples: Sequence[Sample],
    layers_of: Callable[[Sample, Mesh], list[Layer]],
    turns_rad: Sequence[float] = (0.45,),
    size_px: tuple[int, int] | None = None,
) -> list[Picture]:
    """One picture per turn and sample (all samples of the first turn first), all to the same scale."""
    size_px = size_px or PANEL_PX
    hulls = [hull_mesh(sample.hull) for sample in samples]
    distance = max(fitting_distance(s, m, t, size_px) for s, m in zip(samples, hulls, strict=True) for t in turns_rad)
    layers = [layers_of(sample, mesh) for sample, mesh in zip(samples, hulls, strict=True)]
    return [
        render(drawn, view_of(sample, mesh, turn, distance, size_px), floor=True)
        for turn in turns_rad
        for sample, mesh, drawn in zip(samples, hulls, layers, strict=True)
    ]


def glass(hull: Mesh) -> Layer:
    """The hull when something inside it matters: clear where it faces us, dense at its outline."""
    return Layer(hull, opacity=0.20, edge_opacity=0.80, gloss=0.35)


def caption(run: RunData, sample: Sample) -> str:
    """Frame, time and energy of a sample."""
    time = f"{run.seconds[sample.frame_index]:.2f} s, " if run.consecutive else ""
    return f"frame {sample.frame_index}, {time}energy {sample.pose.energy:.2f}"


def stick_over_hull(run: RunData, samples: Sequence[Sample]) -> Figure:
    """Figs. 8 and 9: the stick figure inside the hull."""
    pictures = panels(samples, lambda s, hull: [glass(hull), Layer(stick_mesh(s.pose.joints))])
    return sheet(pictures, [caption(run, s) for s in samples], columns=3)


def flesh_over_hull(run: RunData, samples: Sequence[Sample]) -> Figure:
    """Fig. 2 (right) fitted: the flesh figure and the stick figure inside the hull."""

    def layers(sample: Sample, hull: Mesh) -> list[Layer]:
        flesh = Layer(flesh_figure_mesh(sample.pose.flesh), 0.62, 0.92)
        return [Layer(hull, 0.08, 0.55, gloss=0.3), flesh, Layer(stick_mesh(sample.pose.joints, 0.018, 0.009))]

    return sheet(panels(samples, layers), [caption(run, s) for s in samples], columns=3)


def geodesic_sheet(samples: Sequence[Sample]) -> Figure:
    """Fig. 1 (right): the hull coloured by geodesic distance from the centre of mass, front and back."""
    fields = [np.where(np.isfinite(s.geodesic), s.geodesic, np.nan) for s in samples]
    top = float(np.ceil(max(np.nanmax(f) for f in fields) * 10) / 10)

    def colours(distance: Array) -> Array:
        near_line = np.abs(distance / ISOLINE_M - np.round(distance / ISOLINE_M)) < 0.035
        return np.asarray(GEODESIC_MAP(distance / top)[:, :3] * np.where(near_line, 0.55, 1.0)[:, None])

    return _field_sheet(
        samples, fields, colours, GEODESIC_MAP, 0.0, top, "geodesic distance from the centre of mass (m)"
    )


def curvature_sheet(samples: Sequence[Sample]) -> Figure:
    """Fig. 4: the hull coloured by curvature, front and back; flat is pale, sharply curved is blue."""
    fields = [np.degrees(s.surface.curvature) for s in samples]
    top = float(np.ceil(np.nanpercentile(np.concatenate(fields), 97) / 5) * 5)

    def colours(curvature: Array) -> Array:
        return np.asarray(CURVATURE_MAP(curvature / top)[:, :3])

    text = "curvature: mean angle between a normal and its neighbours' (degrees)"
    return _field_sheet(samples, fields, colours, CURVATURE_MAP, 0.0, top, text)


def _field_sheet(
    samples: Sequence[Sample],
    fields: Sequence[Array],
    colours: Callable[[Array], Array],
    colour_map: Colormap,
    low: float,
    high: float,
    text: str,
) -> Figure:
    by_frame = {s.frame_index: f for s, f in zip(samples, fields, strict=True)}

    def layers(sample: Sample, hull: Mesh) -> list[Layer]:
        coloured = with_field(hull, sample.surface.points, by_frame[sample.frame_index])
        return [Layer(coloured, colour_map=colours, gloss=0.05)]

    pictures = panels(samples, layers, turns_rad=(0.45, 0.45 + np.pi))
    titles = [f"frame {s.frame_index}, {side}" for side in ("front", "back") for s in samples]
    return sheet(pictures, titles, columns=len(samples), colour_bar=(colour_map, low, high, text))


def normals_sheet(samples: Sequence[Sample]) -> Figure:
    """Fig. 3: the surface normals as needles, on every sixth surface voxel."""

    def layers(sample: Sample, hull: Mesh) -> list[Layer]:
        surface = sample.surface
        return [Layer(hull), Layer(needles(surface.points[::6], surface.normals[::6]), outlined=False)]

    return sheet(panels(samples, layers), [f"frame {s.frame_index}" for s in samples], columns=len(samples))


def anchors_sheet(samples: Sequence[Sample]) -> Figure:
    """Figs. 6 and 7: the points that the paper's engine found on the hull, left blue and right orange."""

    def layers(sample: Sample, hull: Mesh) -> list[Layer]:
        found = sample.anchors
        rods = [
            capsule(found[a], found[b], 0.008, 0.008, SIDE_COLOURS[side_of(a)])
            for a, b in ((f"{a}_{side}", f"{b}_{side}") for a, b in ANCHOR_CHAIN for side in "LR")
            if a in found and b in found
        ]
        points = Mesh.join([*rods, *(balls([at], 0.032, SIDE_COLOURS[side_of(name)]) for name, at in found.items())])
        return [glass(hull), Layer(points)]

    pictures = panels(samples, layers, turns_rad=(0.45, 0.45 + np.pi / 2))
    titles = [f"frame {s.frame_index}, {side}" for side in ("front", "side") for s in samples]
    return sheet(pictures, titles, columns=len(samples))


def sheet(
    pictures: Sequence[Picture],
    titles: Sequence[str],
    columns: int,
    colour_bar: tuple[Colormap, float, float, str] | None = None,
) -> Figure:
    """Pictures of one size in rows, each pixel kept, a caption below each and a colour bar at the foot.

    Args:
        pictures: uint8 rgb, at least one.
        titles: one per picture.
        columns: pictures in a row.
        colour_bar: colour map, lowest and highest value, label.
    """
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    height, width = pictures[0].shape[:2]
    gap, strip, foot = 8, 34, 76 if colour_bar else 0
    full_width, full_height = columns * (width + gap) - gap, rows * (height + strip) + foot
    figure = Figure(figsize=(full_width / DPI, full_height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    for k, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        x, y = (k % columns) * (width + gap), (k // columns) * (height + strip)
        box = (x / full_width, 1 - (y + height) / full_height, width / full_width, height / full_height)
        axes = figure.add_axes(box)
        axes.imshow(picture, interpolation="none", aspect="auto")
        axes.axis("off")
        middle = (x + width / 2) / full_width, 1 - (y + height + strip / 2) / full_height
        figure.text(*middle, title, ha="center", va="center", fontsize=12, color="#303640")
    if colour_bar:
        colour_map, low, high, text = colour_bar
        bar_width = min(0.8, 640 / full_width)
        axes = figure.add_axes((0.5 - bar_width / 2, 50 / full_height, bar_width, 16 / full_height))
        ramp = colour_map(np.linspace(0, 1, 256))[None, :, :3]
        axes.imshow(ramp, extent=(low, high, 0, 1), aspect="auto", interpolation="bilinear")
        axes.set_yticks([])
        axes.tick_params(labelsize=11)
        axes.set_xlabel(text, fontsize=12)
        for spine in axes.spines.values():
            spine.set_visible(False)
    return figure
