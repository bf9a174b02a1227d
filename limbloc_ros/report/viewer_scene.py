# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows of a run, frame by frame, as meshes and lines; no window and no graphics library in here."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.geodesic import geodesic_map
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import Array, Pose
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.recordings.cases import pack_mask, unpack_mask
from limbloc_ros.recordings.results import Run
from limbloc_ros.report.mesh import Mesh, flesh_figure_mesh, hull_mesh, stick_mesh, with_field
from limbloc_ros.report.pictures import CURVATURE_MAP

#: What can be switched on and off, with the words beside the switch.
LAYERS = {
    "hull": "hull",
    "flesh": "flesh figure",
    "sticks": "stick figure",
    "path": "path of the pelvis",
    "cameras": "cameras",
    "floor": "floor",
}
#: How the hull may be coloured.
COLOURS = ("plain", "geodesic distance", "curvature")
#: The pyramid of a camera reaches so far, m.
FRUSTUM_M = 0.35
FLOOR_STEP_M = 0.5
#: Height between two of the lines that stand for the hull where the figure inside it is shown too, m.
CONTOUR_STEP_M = 0.02
_HULL_COLOUR = (0.62, 0.68, 0.75)
_CONTOUR_COLOUR = (0.36, 0.42, 0.50)
_AMBIENT = 0.55
#: Towards the two lights, unit vectors times their strengths: above to one side, and weaker from the other.
_LIGHTS = np.array([0.45 * np.array([0.58, 0.33, 0.74]), 0.15 * np.array([-0.74, -0.58, 0.33])])


@dataclass(frozen=True)
class Lines:
    """Line segments: points [N, 3] m, segments [M, 2] indices, one colour."""

    points: Array
    segments: NDArray[np.int64]
    colour: tuple[float, float, float]


class Masks:
    """Masks of many frames, packed small."""

    def __init__(self) -> None:
        self._packed: dict[int, dict[str, tuple[bytes, tuple[int, int]]]] = {}

    def add(self, number: int, masks: Mapping[str, NDArray[np.uint8]]) -> None:
        """Keep a frame's masks."""
        self._packed[number] = {
            name: (zlib.compress(pack_mask(mask).tobytes(), 1), (mask.shape[0], mask.shape[1]))
            for name, mask in masks.items()
        }

    def __contains__(self, number: int) -> bool:
        return number in self._packed

    def __len__(self) -> int:
        return len(self._packed)

    def get(self, number: int) -> dict[str, NDArray[np.uint8]]:
        """The masks of a frame by camera name; empty when there are none."""
        found = {}
        for name, (data, (height, width)) in self._packed.get(number, {}).items():
            rows = np.frombuffer(zlib.decompress(data), np.uint8).reshape(height, -1)
            found[name] = unpack_mask(rows, width)
        return found


class RunScene:
    """The scene of each frame of a run.

    Args:
        run: the results.
        rig: its cameras.
        masks: of the frames whose hull can be shown.
        config: as the run was made with.
    """

    def __init__(self, run: Run, rig: Rig, masks: Masks, config: HullConfig) -> None:
        self.run, self.rig, self.masks = run, rig, masks
        self._carver = Carver(rig, config)
        self._hulls: dict[tuple[int, str], Mesh | None] = {}

    def shapes(self, number: int, layers: Iterable[str], colour: str = COLOURS[0]) -> dict[str, Mesh | Lines]:
        """What this frame has of the wanted layers `hull`, `flesh` and `sticks`.

        A plain hull around a figure comes as level lines, so that the figure is seen in it; anything else as a mesh
        with its shading in its colours. A hull whose colours mean something hides the figure.
        """
        wanted = set(layers)
        hull = self._hull(number, colour) if "hull" in wanted else None
        if hull is not None and colour != COLOURS[0]:
            return {"hull": shaded(hull)}
        pose = self.run.frames[number].outcome
        found: dict[str, Mesh | Lines] = {}
        if isinstance(pose, Pose):
            if "flesh" in wanted:
                found["flesh"] = shaded(flesh_figure_mesh(pose.flesh))
            if "sticks" in wanted:
                found["sticks"] = shaded(stick_mesh(pose.joints))
        if hull is not None:
            found["hull"] = contour_lines(hull) if found else shaded(hull)
        return found

    def lines(self, layers: Iterable[str]) -> dict[str, Lines]:
        """The lines of the wanted layers, the same in every frame: `path`, `cameras`, `floor`."""
        wanted = set(layers)
        found = {}
        if "cameras" in wanted:
            found["cameras"] = camera_lines(self.rig)
        if "floor" in wanted:
            found["floor"] = floor_lines(self.rig)
        if "path" in wanted:
            found["path"] = path_lines(self.run)
        return found

    def text(self, number: int) -> str:
        """What is to be said about a frame."""
        frame = self.run.frames[number]
        seconds = (frame.stamp_ns - self.run.frames[0].stamp_ns) * 1e-9
        lines = [f"frame {number} of {len(self.run)}, {seconds:.2f} s"]
        if isinstance(frame.outcome, Pose):
            pose = frame.outcome
            sure = "" if pose.reliable else ", not reliable"
            lines.append(f"energy {pose.energy:.3f}, sigma {100 * float(np.median(pose.sigma)):.1f} cm{sure}")
        else:
            lines.append(f"no person: {frame.outcome.reason}")
        if number not in self.masks:
            lines.append("its masks were not kept: no hull\n(--recording reads all of them)")
        return "\n".join(lines)

    def _hull(self, number: int, colour: str) -> Mesh | None:
        """The hull's surface; the last few stay, for going back and forth."""
        key = (number, colour)
        if key not in self._hulls:
            while len(self._hulls) >= 64:
                del self._hulls[next(iter(self._hulls))]
            masks = self.masks.get(number)
            hull = self._carver.carve(masks) if masks else None
            self._hulls[key] = coloured_hull(hull, colour) if isinstance(hull, Hull) else None
        return self._hulls[key]


@dataclass
class Playback:
    """Where the viewer is in the run, and what is switched on.

    Attributes:
        frames: how many there are.
        seconds: [F] time of each, s.
        number: the frame that is shown.
        playing: whether time goes on.
        rate: pace, 1 is as recorded.
        layers: what is switched on.
        colour: of the hull, one of COLOURS.
    """

    frames: int
    seconds: Array
    number: int = 0
    playing: bool = False
    rate: float = 1.0
    layers: set[str] = field(default_factory=lambda: {"hull", "flesh", "sticks", "floor"})
    colour: str = COLOURS[0]
    _clock_s: float = 0.0

    def go(self, number: int) -> None:
        """Show a frame; beyond the ends the first or last."""
        self.number = min(max(number, 0), self.frames - 1)
        self._clock_s = float(self.seconds[self.number])

    def toggle(self) -> None:
        """Play or pause; at the end play begins anew."""
        self.playing = not self.playing
        if self.playing:
            self.go(0 if self.number == self.frames - 1 else self.number)

    def press(self, key: str) -> bool:
        """Do what a key is for; whether it is for anything. Keys: left, right, home, end, space."""
        goals = {"left": self.number - 1, "right": self.number + 1, "home": 0, "end": self.frames - 1}
        if key == "space":
            self.toggle()
        elif key in goals:
            self.go(goals[key])
        else:
            return False
        return True

    def tick(self, elapsed_s: float) -> bool:
        """Let time go on; whether another frame is to be shown. Slow drawing skips frames and keeps the pace."""
        if not self.playing:
            return False
        self._clock_s += self.rate * elapsed_s
        number = int(np.searchsorted(self.seconds, self._clock_s + 1e-9, side="right")) - 1
        self.playing = number < self.frames - 1
        moved = number != self.number
        self.number = max(number, 0)
        return moved

    def switch(self, layer: str, on: bool) -> None:
        """Switch a layer on or off."""
        (self.layers.add if on else self.layers.discard)(layer)


def coloured_hull(hull: Hull, colour: str) -> Mesh:
    """The hull's surface in one colour, or by geodesic distance from the centre of mass or by curvature."""
    mesh = hull_mesh(hull, _HULL_COLOUR)
    if colour == COLOURS[0]:
        return mesh
    surface = extract_surface(hull)
    if colour == "geodesic distance":
        values = geodesic_map(hull, surface)
        values, colours = np.where(np.isfinite(values), values, np.nan), colormaps["viridis"]
        top = float(np.nanmax(values))
    else:
        values, colours = np.degrees(surface.curvature), CURVATURE_MAP
        top = float(np.nanpercentile(values, 97))
    shaded = with_field(mesh, surface.points, values)
    return Mesh.of(mesh.vertices, mesh.faces, mesh.normals, np.asarray(colours(shaded.scalars / top))[:, :3])


def shaded(mesh: Mesh) -> Mesh:
    """The mesh with the light of the room in its colours.

    Open3D's own lit materials are compiled for minutes where a processor draws; colours that hold the light already
    need its simplest one, and look the same everywhere.
    """
    light = _AMBIENT + np.maximum(mesh.normals @ _LIGHTS.T, 0.0).sum(axis=1, keepdims=True)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, np.minimum(mesh.colours * light, 1.0), mesh.scalars)


def contour_lines(mesh: Mesh, step_m: float = CONTOUR_STEP_M) -> Lines:
    """Where horizontal planes `step_m` apart cut a mesh."""
    corners = mesh.vertices[mesh.faces]
    height = corners[..., 2] / step_m
    ends = [np.zeros((0, 3))]
    for level in range(int(np.ceil(height.min(initial=0.0))), int(np.ceil(height.max(initial=0.0)))):
        above = height >= level
        cut = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
        lone = np.where(above[cut].sum(axis=1) == 1, above[cut].argmax(axis=1), above[cut].argmin(axis=1))
        start, z = corners[cut, lone], height[cut, lone]
        sides = []
        for turn in (1, 2):
            other = (lone + turn) % 3
            part = (level - z) / (height[cut, other] - z)
            sides.append(start + part[:, None] * (corners[cut, other] - start))
        ends.append(np.stack(sides, axis=1).reshape(-1, 3))
    points = np.concatenate(ends)
    return Lines(points, np.arange(len(points), dtype=np.int64).reshape(-1, 2), _CONTOUR_COLOUR)


def camera_lines(rig: Rig) -> Lines:
    """A pyramid for each camera: from its centre through the corners of its image, a notch on the upper edge."""
    points: list[Array] = []
    segments: list[tuple[int, int]] = []
    for camera in rig.cameras:
        corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]]) - 0.5
        rays = np.concatenate([corners, np.ones((4, 1))], axis=1) @ np.linalg.inv(camera.K).T
        T = camera.T_world_camera
        tips = (FRUSTUM_M * rays) @ T[:3, :3].T + T[:3, 3]
        up = (tips[0] + tips[1]) / 2 + 0.15 * ((tips[0] + tips[1]) - (tips[2] + tips[3])) / 2
        start = 6 * len(segments) // 10
        points += [T[:3, 3], *tips, up]
        pairs = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)]
        segments += [(start + a, start + b) for a, b in pairs]
    return Lines(np.array(points), np.array(segments, dtype=np.int64), (0.85, 0.55, 0.15))


def floor_lines(rig: Rig) -> Lines:
    """A grid on the floor below the carve volume."""
    low = np.floor(rig.volume_min[:2] / FLOOR_STEP_M) * FLOOR_STEP_M
    high = np.ceil(rig.volume_max[:2] / FLOOR_STEP_M) * FLOOR_STEP_M
    ends = []
    for x in np.arange(low[0], high[0] + 1e-9, FLOOR_STEP_M):
        ends += [(x, low[1], 0.0), (x, high[1], 0.0)]
    for y in np.arange(low[1], high[1] + 1e-9, FLOOR_STEP_M):
        ends += [(low[0], y, 0.0), (high[0], y, 0.0)]
    return Lines(np.array(ends), np.arange(len(ends), dtype=np.int64).reshape(-1, 2), (0.6, 0.62, 0.65))


def path_lines(run: Run) -> Lines:
    """Where the pelvis went; broken where nobody was found."""
    pelvis = run.joints[:, 4]
    seen = np.asarray(np.isfinite(pelvis).all(axis=1))
    pairs = np.flatnonzero(seen[:-1] & seen[1:])
    return Lines(np.nan_to_num(pelvis), np.stack([pairs, pairs + 1], axis=1), (0.1, 0.4, 0.7))
