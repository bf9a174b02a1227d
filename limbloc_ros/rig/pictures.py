# SPDX-License-Identifier: Apache-2.0
"""Pictures of a rig: the cameras in their room, what they see, and where a calibration board has been."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.rig.plan import STEP_M, Coverage

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]

DPI = 110
#: Lets a name be read on top of lines and colours.
_HALO = [withStroke(linewidth=2.5, foreground="white")]
#: Names stand so far outside of the cameras, m; in 3D pictures so far beside them, points: the nearest that is free.
_LABEL_M = 0.12
_LABEL_POINTS = (6.0, 14.0, 22.0)
#: Room for them around the cameras, m.
_MARGIN_M = 0.65
#: Colours that also colour-blind people tell apart, one after the other for the cameras.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#5d3a9b")


def colour(index: int) -> str:
    """The colour of a camera by its number."""
    return COLOURS[index % len(COLOURS)]


def png(figure: Figure, tight: bool = False) -> bytes:
    """A figure as PNG; `tight` cuts its empty margins off, of which 3D axes have many."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=DPI, bbox_inches="tight" if tight else None)
    return out.getvalue()


def coverage_picture(
    cameras: Sequence[Camera], places: Sequence[Array], errors: Sequence[Array], cells: Sequence[NDArray[np.int64]]
) -> bytes:
    """Where in each camera's image the board's corners were found, coloured by how far off they are.

    Args:
        cameras: C cameras.
        places: C arrays [N, 2] px.
        errors: C arrays [N] px.
        cells: C arrays [6, 8] of counts; empty cells are shaded.
    """
    columns = min(4, len(cameras))
    rows = -(-len(cameras) // columns)
    shape = max(camera.height / camera.width for camera in cameras)
    figure = Figure(figsize=(3.1 * columns + 0.9, (3.1 * shape + 0.6) * rows + 0.2), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    limit = float(np.percentile(np.concatenate(errors), 98)) if any(map(len, errors)) else 1.0
    dots = None
    for i, (axes, (_, camera)) in enumerate(_placed(grid, {camera.name: camera for camera in cameras})):
        extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
        axes.imshow(np.where(cells[i] > 0, np.nan, 1.0), extent=extent, cmap="Reds", vmin=0, vmax=3.5, aspect="equal")
        axes.plot([extent[0], extent[1], extent[1], extent[0], extent[0]],
                  [extent[2], extent[2], extent[3], extent[3], extent[2]], color="#444444", lw=0.8)  # fmt: skip
        dots = axes.scatter(*places[i].T, c=errors[i], s=7, cmap="viridis", vmin=0, vmax=limit, linewidths=0)
        share = 100 * float((cells[i] > 0).mean())
        axes.set_title(f"{camera.name}\n{len(errors[i])} corners, {share:.0f} % of the image", fontsize=9)
    if dots is not None:
        figure.colorbar(dots, ax=grid, label="error px", shrink=0.8, aspect=30)
    return png(figure)


def overlay_picture(overlays: Mapping[str, tuple[Mask, Mask]]) -> bytes:
    """Silhouettes against the hull of all other cameras: white inside, red outside, blue hull only.

    Args:
        overlays: camera -> small silhouette and projected hull, uint8 0 or 1.
    """
    columns = min(4, len(overlays))
    rows = -(-len(overlays) // columns)
    figure = Figure(figsize=(3.0 * columns, 2.6 * rows), layout="constrained")
    for axes, (name, (mask, hull)) in _placed(figure.subplots(rows, columns, squeeze=False), overlays):
        picture = np.full((*mask.shape, 3), 25, np.uint8)
        picture[hull != 0] = (60, 110, 200)
        picture[(mask != 0) & (hull != 0)] = 255
        picture[(mask != 0) & (hull == 0)] = (225, 40, 30)
        axes.imshow(picture)
        axes.set_title(name, fontsize=9)
    return png(figure)


def _placed(grid: Any, items: Mapping[str, Any]) -> Iterator[tuple[Any, tuple[str, Any]]]:
    """Axes and items; axes without an item stay empty."""
    flat = list(grid.ravel())
    for axes in flat:
        axes.set_axis_off()
    yield from zip(flat, items.items(), strict=False)


def pair_picture(table: Array, names: Sequence[str]) -> bytes:
    """A matrix [C, C] of how much each pair of cameras contradicts itself, as shares."""
    size = 2.2 + 0.55 * len(names)
    figure = Figure(figsize=(size + 0.6, size), layout="constrained")
    axes = figure.add_subplot()
    top = max(0.1, float(np.nanmax(table)) if np.isfinite(table).any() else 0.1)
    axes.imshow(100 * table, cmap="Purples", vmin=0, vmax=100 * top)
    for (i, j), value in np.ndenumerate(table):
        if np.isfinite(value):
            axes.text(j, i, f"{100 * value:.0f}", ha="center", va="center", fontsize=8,
                      color="white" if value > 0.6 * top else "black")  # fmt: skip
    axes.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_title("unexplained foreground of pairs, %", fontsize=9)
    return png(figure)


def coverage_map(coverage: Coverage, rig: Rig) -> bytes:
    """A floor plan: how many cameras see each place from ankles to raised hands, and the cameras."""
    figure = Figure(figsize=(7.0, 5.8), layout="constrained")
    axes = figure.add_subplot()
    most = len(rig.cameras)
    half = STEP_M / 2
    extent = (coverage.x[0] - half, coverage.x[-1] + half, coverage.y[0] - half, coverage.y[-1] + half)
    how: dict[str, Any] = {"origin": "lower", "extent": extent, "interpolation": "nearest"}
    steps = colormaps["viridis"].resampled(most + 1)
    image = axes.imshow(coverage.whole.T, cmap=steps, vmin=-0.5, vmax=most + 0.5, **how)
    blind = (coverage.needed > coverage.whole.T).repeat(8, axis=0).repeat(8, axis=1)  # so that its edge is the cells'
    fine = (np.arange(8) - 3.5) / 8 * STEP_M
    filled = axes.contourf(
        (coverage.x[:, None] + fine).ravel(),
        (coverage.y[:, None] + fine).ravel(),
        blind.astype(float),
        levels=[0.5, 1.5],
        colors="none",
        hatches=["////"],
    )
    filled.set(edgecolor="#ff3b30", linewidth=0.0)
    figure.colorbar(image, ax=axes, label="cameras", ticks=range(0, most + 1, max(1, most // 8)), shrink=0.7)
    for i, camera in enumerate(rig.cameras):
        x, y = camera.T_world_camera[:2, 3]
        dx, dy = camera.T_world_camera[:2, 2]
        axes.annotate(
            "", (x + 0.5 * dx, y + 0.5 * dy), (x, y), arrowprops={"arrowstyle": "-|>", "color": colour(i), "lw": 1.6}
        )
        axes.plot(x, y, "o", color=colour(i), mec="white", ms=7)
        _name(axes, camera, rig.volume_min, rig.volume_max)
    stands = np.array([camera.T_world_camera[:2, 3] for camera in rig.cameras])
    low, high = np.minimum(stands.min(axis=0), rig.volume_min[:2]), np.maximum(stands.max(axis=0), rig.volume_max[:2])
    axes.set(
        xlabel="x m",
        ylabel="y m",
        xlim=(low[0] - _MARGIN_M, high[0] + _MARGIN_M),
        ylim=(low[1] - _MARGIN_M, high[1] + _MARGIN_M),
        aspect="equal",
        title=f"seen from ankles to raised hands; hatched: by fewer than {coverage.needed} cameras",
    )
    axes.title.set_fontsize(9)
    return png(figure)


def fatness_plot(counts: Sequence[int], factors: Sequence[Sequence[float]]) -> bytes:
    """Number of cameras -> volume of the hull over that of the body: each place, and their median."""
    figure = Figure(figsize=(6.2, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for count, values in zip(counts, factors, strict=True):
        axes.plot([count] * len(values), values, "o", color="#9fb8d0", ms=4)
    axes.plot(
        counts, [float(np.median(values)) if len(values) else np.nan for values in factors], "o-", color=COLOURS[0]
    )
    axes.set(xlabel="cameras", ylabel="hull / body volume", ylim=(0.9, None), xticks=counts)
    axes.grid(alpha=0.3)
    return png(figure)


def _name(axes: Any, camera: Camera, low: Array, high: Array) -> None:
    """Write a camera's name on a floor plan, beside it, further from the middle of the volume."""
    away = _away(camera, low, high)[:2]
    x, y = camera.T_world_camera[:2, 3] + _LABEL_M * away
    axes.text(x, y, camera.name, fontsize=8, path_effects=_HALO, zorder=100, **_aligned(away))


def _away(camera: Camera, low: Array, high: Array) -> Array:
    """Unit vector [3] from the middle of the volume to a camera, level."""
    away = (camera.T_world_camera[:3, 3] - (low + high) / 2) * (1, 1, 0)
    return np.asarray(away / max(float(np.linalg.norm(away)), 1e-9))


def _aligned(direction: Array) -> dict[str, Any]:
    """How a text is aligned that stands in this direction [2] of what it names."""
    return {
        "ha": ("right", "center", "left")[round(direction[0]) + 1],
        "va": ("top", "center", "bottom")[round(direction[1]) + 1],
    }


def _name_apart(axes: Any, cameras: Sequence[Camera], low: Array, high: Array) -> None:
    """Write the names of all cameras into 3D axes that are laid out already, where they hide no name and no camera.

    Best is further from the middle of the volume, and above.
    """

    def shown(point: Array) -> Array:
        return np.array(proj_transform(*point, axes.get_proj())[:2])

    renderer = axes.figure.canvas.get_renderer()
    dots = [shown(camera.T_world_camera[:3, 3]) for camera in cameras]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in map(axes.transData.transform, dots)]
    turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    for i, camera in enumerate(cameras):
        outside = _LABEL_M * np.add(_away(camera, low, high), (0.0, 0.0, 1.0))
        best = shown(camera.T_world_camera[:3, 3] + outside) - dots[i]
        places = [(points * way, way) for points in _LABEL_POINTS for way in sorted(ways, key=lambda w: -(w @ best))]
        text = axes.annotate(
            camera.name, dots[i], (0, 0), textcoords="offset points", fontsize=8, path_effects=_HALO, zorder=100
        )
        hidden = []
        for offset, way in places:
            text.set(position=offset, **_aligned(way))
            box = text.get_window_extent(renderer)
            shared = (Bbox.intersection(box, other) for j, other in enumerate(taken) if j != i)
            hidden.append(sum(both.width * both.height for both in shared if both is not None))
        offset, way = places[int(np.argmin(hidden))]
        text.set(position=offset, **_aligned(way))
        taken.append(text.get_window_extent(renderer))


def frustum(camera: Camera, depth_m: float) -> Array:
    """The corners of what a camera sees at a depth: [5, 3], its centre first, then around the image."""
    w, h = camera.width - 0.5, camera.height - 0.5
    corners = np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
    rays = (corners - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
    points = np.column_stack([rays * depth_m, np.full(4, depth_m)])
    T = camera.T_world_camera
    return np.vstack([T[:3, 3], points @ T[:3, :3].T + T[:3, 3]])


def rig_picture(cameras: Sequence[Camera], low: Array, high: Array, **options: Any) -> bytes:
    """`rig_figure` as PNG."""
    return png(rig_figure(cameras, low, high, **options), tight=True)


def rig_figure(
    cameras: Sequence[Camera],
    low: Array,
    high: Array,
    *,
    title: str = "",
    extra: Callable[[Any], None] | None = None,
    person_m: float = 1.75,
) -> Figure:
    """The cameras with their views in 3D: from the side, and from above.

    Args:
        cameras: to draw.
        low, high: corners of the carve volume, m.
        title: of the picture.
        extra: draws more into the 3D axes.
        person_m: height of the person drawn in the middle of the volume for scale; 0 for none.
    """
    figure = Figure(figsize=(11.5, 5.4), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=11)
    for column, (elevation, azimuth) in enumerate(((24, -62), (90, -90))):
        axes = figure.add_subplot(1, 2, column + 1, projection="3d")
        depth_m = np.clip(6.0 / len(cameras), 0.5, 0.9) * (1.0 if column == 0 else 1.6)  # many must not hide each other
        for i, camera in enumerate(cameras):
            _draw_camera(axes, camera, colour(i), float(depth_m))
        _draw_room(axes, low, high, person_m)
        if extra is not None:
            extra(axes)
        points = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
        lowest = np.minimum(points.min(axis=0), low)
        highest = np.maximum(points.max(axis=0), high)
        margin = _MARGIN_M
        axes.set(
            xlim=(lowest[0] - margin, highest[0] + margin),
            ylim=(lowest[1] - margin, highest[1] + margin),
            zlim=(min(lowest[2], 0), highest[2] + margin),
            xlabel="x m",
            ylabel="y m",
            zlabel="z m" if column == 0 else "",
        )
        spans = highest - lowest + 2 * margin
        axes.set_box_aspect(spans, zoom=0.92 if column == 0 else 1.0)  # room for the heights' label
        axes.view_init(elevation, azimuth)
        if column == 1:
            axes.set_proj_type("ortho")
            axes.set_zticks([])
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # names stand where the cameras are now
    for axes in figure.axes:
        _name_apart(axes, cameras, low, high)
    return figure


def _draw_camera(axes: Any, camera: Camera, shade: str, depth_m: float) -> None:
    points = frustum(camera, depth_m)
    centre, corners = points[0], points[1:]
    edges = [(centre, corner) for corner in corners]
    edges += [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    axes.add_collection3d(Line3DCollection(edges, colors=shade, linewidths=0.9))
    axes.add_collection3d(Poly3DCollection([corners], facecolors=shade, alpha=0.12))
    axes.scatter(*centre, color=shade, s=18)


def _draw_room(axes: Any, low: Array, high: Array, person_m: float) -> None:
    x, y, z = np.stack([low, high]).T
    corners = np.array([[x[i], y[j], z[k]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    lines = [(corners[a], corners[b]) for a, b in pairs]
    axes.add_collection3d(Line3DCollection(lines, colors="#888888", linewidths=0.7, linestyles="dotted"))
    floor = corners[[0, 2, 6, 4]]
    axes.add_collection3d(Poly3DCollection([floor], facecolors="#888888", alpha=0.10))
    axes.quiver(0, 0, 0, 0.4, 0, 0, color="#c00000", lw=1.2)
    axes.quiver(0, 0, 0, 0, 0.4, 0, color="#00a000", lw=1.2)
    axes.quiver(0, 0, 0, 0, 0, 0.4, color="#0000c0", lw=1.2)
    if person_m:
        middle = (low + high) / 2
        stick = np.array(
            [
                *[[(0, 0), (0, 1.45)], [(-0.2, 0), (0, 0.9)], [(0.2, 0), (0, 0.9)]],
                *[[(-0.45, 1.1), (0, 1.4)], [(0.45, 1.1), (0, 1.4)], [(0, 1.5), (0, 1.75)]],
            ]
        )
        upright = np.stack([stick[..., 0], np.zeros(stick.shape[:2]), stick[..., 1]], axis=-1)
        lines = list(person_m / 1.75 * upright + [middle[0], middle[1], low[2]])
        axes.add_collection3d(Line3DCollection(lines, colors="#333333", linewidths=2.0))
