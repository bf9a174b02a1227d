# SPDX-License-Identifier: Apache-2.0
"""A room with cameras and people in it: images as a camera driver would deliver them, and the truth beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError, RigError
from limbloc_ros.simulation import _render_kernels as kernels
from limbloc_ros.simulation.company import Thing
from limbloc_ros.simulation.motion import Motion
from limbloc_ros.simulation.person import Person, PosedPerson, load_person
from limbloc_ros.simulation.ring import default_rig as default_rig
from limbloc_ros.simulation.surroundings import HALF_M, HEIGHT_M, Backdrop, backdrop

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]
Box = tuple[int, int, int, int]  # x0, y0, x1, y1, the ends left out

_LIGHT = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
_CELL_M = 0.02
_NEAR_M = 0.15
#: The floor's light below which `darken_floor` changes a pixel.
_DARK = 0.999
# Points on the rim of the unit square, densely, because the image of a straight edge is not straight.
_RIM = np.concatenate([[(a, 0), (a, 1), (0, a), (1, a)] for a in np.linspace(0, 1, 9)])

# bgr of skin, hair, shirt, trousers, shoes. In places they come close to a wall or to the shaded floor, as in life.
_PALETTES = {
    "man": ((128, 160, 205), (34, 40, 52), (150, 112, 70), (78, 58, 48), (46, 44, 44)),
    "woman": ((140, 172, 218), (40, 74, 120), (92, 70, 150), (112, 88, 76), (60, 62, 120)),
    "child": ((132, 168, 214), (52, 92, 140), (70, 150, 196), (150, 110, 60), (196, 196, 200)),
    "heavy": ((96, 124, 166), (58, 58, 60), (128, 150, 96), (96, 62, 46), (40, 48, 60)),
}


@dataclass(frozen=True)
class SimulatedFrame:
    """One instant of the room.

    Attributes:
        t: s since the start.
        images: camera name -> uint8 [height, width, 3] bgr.
        masks: camera name -> uint8 [height, width], 255 where people and things are: the true silhouette.
        joints: [25, 3] the first person's true joints (core.pose.JOINT_NAMES), m; None while the room is empty.
        action: the name of the first person's motion, `empty` while the room is empty.
    """

    t: float
    images: dict[str, Image]
    masks: dict[str, Mask]
    joints: Array | None
    action: str


@dataclass(frozen=True)
class _Lit:
    """A body or a thing in one instant, as `rasterise` takes it."""

    vertices: Array
    faces: NDArray[np.int32]
    shade: Array
    garments: Array
    stripe: Array
    palette: Array


@dataclass(frozen=True)
class _Instant:
    """What all cameras share at one time: what stands there, lit, and the light that is left on the floor around it."""

    t: float
    lit: tuple[_Lit, ...]
    floor_light: NDArray[np.float32]  # [h, w] of cells
    floor_dark: Mask  # [h, w] where the light between a cell and the next ones is less than 1
    floor_cell: tuple[int, int]  # x, y of its first cell


class _View:
    """A camera with its buffers."""

    def __init__(self, camera: Camera, index: int, scenery: Backdrop) -> None:
        self.camera = camera
        self.index = index
        self.empty = scenery.image
        # What was drawn last, without noise, and its silhouette; where they are not those of `empty`.
        self.scene = scenery.image.copy()
        self.mask = np.zeros((camera.height, camera.width), np.uint8)
        self.touched: list[Box] = []
        self.floor = np.nan_to_num((scenery.floor_m + HALF_M) / _CELL_M, nan=-1e6).astype(np.float32)
        self.T_camera_world = camera.T_camera_world
        self.zbuffer = np.zeros((camera.height, camera.width), np.float32)
        # k1 k2 p1 p2 k3 k4 k5 k6, or None: a model that only the camera itself knows.
        self._coefficients: Array | None = None
        if camera.distortion_model != "fisheye" and camera.distortion.size <= 8:
            self._coefficients = np.zeros(8)
            self._coefficients[: camera.distortion.size] = camera.distortion

    def clear(self) -> None:
        """Make the room empty again."""
        for x0, y0, x1, y1 in self.touched:
            self.scene[y0:y1, x0:x1] = self.empty[y0:y1, x0:x1]
            self.mask[y0:y1, x0:x1] = 0
        self.touched.clear()

    def project(self, points: Array) -> tuple[Array, Array]:
        """The same as Camera.world_to_image, several times faster for the usual distortion models."""
        if self._coefficients is None:
            return self.camera.world_to_image(points)
        uv, depth = np.empty((len(points), 2)), np.empty(len(points))
        T = self.T_camera_world
        kernels.project(points, T[:3, :3], T[:3, 3], self.camera.K, self._coefficients, uv, depth)
        return uv, depth


class SimulatedRoom:
    """Cameras that film people in a room; everything is a pure function of (arguments, t).

    Args:
        rig: the cameras, inside the room (walls at x, y = +-3 m, ceiling at 2.9 m); `default_rig()` makes some.
        person: one of `person.PERSON_NAMES`, or a Person.
        seed: of the motions, the textures and the noise.
        empty_s: the room is empty this long, for the background to be learnt.
        playlist: names of motions in order (`motion.motion_names()`), repeated for ever; None is a varied default.
        noise_sigma: standard deviation of the sensor noise, grey levels.
        light_drift: the light changes slowly by up to this fraction.
        motions: of several people (`company.company`), the first first; then `person` and `playlist` mean nothing.
        things: furniture.

    Raises:
        ConfigError: a value out of range. RigError: a camera outside the room.
    """

    def __init__(
        self,
        rig: Rig,
        person: str | Person = "man",
        seed: int = 0,
        empty_s: float = 1.5,
        playlist: Sequence[str] | None = None,
        noise_sigma: float = 2.5,
        light_drift: float = 0.03,
        motions: Sequence[Motion] = (),
        things: Sequence[Thing] = (),
    ) -> None:
        if not 0 <= noise_sigma <= 25:
            raise ConfigError(f"noise_sigma: expected 0 to 25 grey levels, got {noise_sigma}")
        if not 0 <= light_drift <= 0.5:
            raise ConfigError(f"light_drift: expected 0 to 0.5, got {light_drift}")
        for camera in rig.cameras:
            x, y, z = camera.T_world_camera[:3, 3]
            if max(abs(x), abs(y)) >= HALF_M or not 0 < z < HEIGHT_M:
                raise RigError(
                    f"camera {camera.name} stands at ({x:.2f}, {y:.2f}, {z:.2f}) m; expected inside the room: "
                    f"|x|, |y| below {HALF_M} m and z between 0 and {HEIGHT_M} m"
                )
        self.rig = rig
        if motions:
            self.person, self.motion = motions[0].person, motions[0]
        else:
            self.person = load_person(person) if isinstance(person, str) else person
            self.motion = Motion(self.person, seed, empty_s, playlist)
        self.others = tuple(motions[1:])
        self.things = tuple(things)
        self.seed = seed
        self._light_drift = light_drift
        rng = np.random.default_rng([seed, 11])
        self._noise = np.clip(np.rint(rng.normal(0, noise_sigma, 1 << 20)), -127, 127).astype(np.int8)
        self._tone = rng.uniform(0.93, 1.07, len(self.person.vertices))
        self._other_tones = tuple(rng.uniform(0.93, 1.07, len(other.person.vertices)) for other in self.others)
        self._palette = _palette(self.person)
        self._stripe = np.ascontiguousarray(self.person.vertices[:, 2])
        self._views: dict[str, _View] = {}
        self._instant: _Instant | None = None

    def frame(self, t: float) -> SimulatedFrame:
        """What all cameras see at time t s, with the truth."""
        images, masks = {}, {}
        for name in self.rig.names:
            images[name], masks[name] = self.render_with_mask(name, t)
        return SimulatedFrame(t, images, masks, self.joints(t), self.motion.action(t))

    def joints(self, t: float) -> Array | None:
        """The true joints [25, 3] at time t s, m, in the order of JOINT_NAMES; None while the room is empty."""
        posed = self.motion.pose(t)
        return None if posed is None else posed.joints.copy()

    def everybodys_joints(self, t: float) -> list[Array | None]:
        """The true joints of everybody at time t s, as `joints` gives those of the first."""
        found = [motion.pose(t) for motion in (self.motion, *self.others)]
        return [None if posed is None else posed.joints.copy() for posed in found]

    def render(self, camera_name: str, t: float, out: Image | None = None) -> Image:
        """The image uint8 [height, width, 3] bgr of one camera at time t s; the same as in `frame`.

        Args:
            camera_name: one of the rig's.
            t: s since the start.
            out: the image is put there, and nothing is allocated; contiguous.

        Raises:
            RigError: no such camera.
        """
        view = self._view(camera_name)
        view.clear()
        instant = self._instant_at(t)
        if instant is not None:
            self._draw_shadow(view, instant)
            self._draw(view, instant.lit)
        if out is None:
            out = np.empty_like(view.scene)
        place = [self.seed, view.index, round(t * 1e6) & 0xFFFFFFFF]
        key = np.random.SeedSequence(place).generate_state(1, np.uint64)[0]
        rows = view.camera.height, -1
        kernels.expose(view.scene.reshape(rows), self._gain(t, view.index), self._noise, key, out.reshape(rows))
        return out

    def render_with_mask(self, camera_name: str, t: float) -> tuple[Image, Mask]:
        """Image and true silhouette (255 = person) of one camera at time t s.

        Raises:
            RigError: no such camera.
        """
        return self.render(camera_name, t), self._view(camera_name).mask.copy()

    def silhouettes(self, posed: PosedPerson) -> dict[str, Mask]:
        """The true silhouettes (255 = person) of the first person, alone and in any posture, by camera."""
        lit = (_light(posed, self.person, self._tone, self._stripe, self._palette),)
        masks = {}
        for name in self.rig.names:
            view = self._view(name)
            view.clear()
            self._draw(view, lit)
            masks[name] = view.mask.copy()
        return masks

    def warm_up(self) -> None:
        """Compile or load every kernel and look at the empty room, so that the first images are not late."""
        self.frame(self.motion.empty_s + 1.0)

    # ---- one image ----

    def _view(self, name: str) -> _View:
        if name not in self._views:
            camera = self.rig.camera(name)
            self._views[name] = _View(camera, self.rig.names.index(name), backdrop(camera, self.seed))
        return self._views[name]

    def _gain(self, t: float, index: int) -> float:
        """Daylight that drifts (the same for all cameras), and each camera's own exposure."""
        drift = 0.7 * math.sin(2 * math.pi * t / 61.0 + self.seed) + 0.3 * math.sin(2 * math.pi * t / 17.0)
        return 1.0 + self._light_drift * drift + 0.02 * math.sin(3.1 * index + 0.4)

    def _instant_at(self, t: float) -> _Instant | None:
        if self._instant is not None and self._instant.t == t:
            return self._instant
        lit = self._lit(t)
        if not lit:
            return None
        light, cell = self._floor_light(*_joined(lit))
        dark = cv2.dilate((light < 1).view(np.uint8), np.ones((2, 2), np.uint8), anchor=(0, 0))
        self._instant = _Instant(t, lit, light, dark, cell)
        return self._instant

    def _lit(self, t: float) -> tuple[_Lit, ...]:
        """Everybody and everything that is there."""
        found: list[_Lit] = []
        posed = self.motion.pose(t)
        if posed is not None:
            found.append(_light(posed, self.person, self._tone, self._stripe, self._palette))
        for motion, tone in zip(self.others, self._other_tones, strict=True):
            posed = motion.pose(t)
            if posed is not None:
                stripe = np.ascontiguousarray(motion.person.vertices[:, 2])
                found.append(_light(posed, motion.person, tone, stripe, _palette(motion.person)))
        for thing in self.things:
            vertices = thing.at(t)
            if vertices is not None:
                found.append(_light_thing(vertices, thing))
        return tuple(found)

    def _floor_light(self, vertices: Array, faces: NDArray[np.int32]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """The lamp's shadow (soft) and the dark below what touches the floor (softer), as remaining light by cell."""
        heights = np.maximum(vertices[:, 2], 0.0)
        below = (vertices[:, :2] + HALF_M) / _CELL_M
        lamp = below - heights[:, None] * (_LIGHT[:2] / _LIGHT[2]) / _CELL_M
        margin = 14
        low = np.floor(np.minimum(below.min(0), lamp.min(0))).astype(int) - margin
        high = np.ceil(np.maximum(below.max(0), lamp.max(0))).astype(int) + margin
        shape = (high[1] - low[1], high[0] - low[0])
        shadow, contact = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        kernels.cover_floor(lamp, heights, faces, 1e9, low[0], low[1], shadow)
        kernels.cover_floor(below, heights, faces, 0.5, low[0], low[1], contact)
        shadow = cv2.blur(cv2.blur(shadow, (5, 5)), (5, 5))
        contact = cv2.blur(cv2.blur(contact, (9, 9)), (9, 9))
        light = (1 - np.float32(0.28) * shadow) * (1 - np.float32(0.4) * contact)
        # Only where it is darker, and one cell around: all cameras look at every pixel of this piece of floor.
        dark = np.argwhere(light < _DARK)
        if not len(dark):
            return light[:1, :1], (int(low[0]), int(low[1]))
        (y0, x0), (y1, x1) = np.maximum(dark.min(axis=0) - 1, 0), dark.max(axis=0) + 2
        return np.ascontiguousarray(light[y0:y1, x0:x1]), (int(low[0] + x0), int(low[1] + y0))

    def _draw_shadow(self, view: _View, instant: _Instant) -> None:
        h, w = instant.floor_light.shape
        x0, y0 = instant.floor_cell
        ground = np.zeros((len(_RIM), 3))
        ground[:, :2] = (_RIM * [w, h] + [x0, y0]) * _CELL_M - HALF_M
        uv, depth = view.project(ground)
        whole = 0, 0, view.camera.width, view.camera.height
        box = whole if np.isnan(uv).any() else _image_box(uv, depth, -np.inf, view.camera)
        if box is not None:
            view.touched.append(box)
            kernels.darken_floor(view.scene, view.floor, instant.floor_light, instant.floor_dark, x0, y0, *box)

    def _draw(self, view: _View, everything: tuple[_Lit, ...]) -> None:
        seen = []
        for lit in everything:
            uv, depth = view.project(lit.vertices)
            box = _image_box(uv, depth, _NEAR_M, view.camera)
            if box is not None:
                seen.append((lit, uv, depth, box))
        if not seen:
            return
        boxes = np.array([box for *_, box in seen])
        (x0, y0), (x1, y1) = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        view.touched.append((x0, y0, x1, y1))
        view.zbuffer[y0:y1, x0:x1] = 0.0
        for lit, uv, depth, box in seen:
            kernels.rasterise(
                uv, depth, lit.faces, lit.shade, lit.garments, lit.stripe, lit.palette, _NEAR_M,
                view.scene, view.mask, view.zbuffer, *box,
            )  # fmt: skip
        kernels.soften_edges(view.scene, view.scene[y0:y1, x0:x1].copy(), view.mask, x0, y0, x1, y1)


def _palette(person: Person) -> Array:
    return np.array(_PALETTES.get(person.name, _PALETTES["man"]), dtype=np.float64)


def _light(posed: PosedPerson, person: Person, tone: Array, stripe: Array, palette: Array) -> _Lit:
    shade = np.empty(len(posed.vertices))
    kernels.shade_vertices(posed.vertices, person.faces, _LIGHT, tone, shade)
    return _Lit(posed.vertices, person.faces, shade, person.garments, stripe, palette)


def _light_thing(vertices: Array, thing: Thing) -> _Lit:
    shade = np.empty(len(vertices))
    kernels.shade_vertices(vertices, thing.faces, _LIGHT, np.ones(len(vertices)), shade)
    bare = np.full((len(vertices), 4), -1.0)  # no garment anywhere: the palette's first colour
    return _Lit(
        vertices, thing.faces, shade, bare, np.zeros(len(vertices)), np.tile(np.array(thing.bgr, np.float64), (5, 1))
    )


def _joined(lit: Sequence[_Lit]) -> tuple[Array, NDArray[np.int32]]:
    """All of them as one mesh: vertices and faces."""
    before = np.cumsum([0, *(len(each.vertices) for each in lit)])
    faces = [each.faces + np.int32(start) for each, start in zip(lit, before, strict=False)]
    return np.concatenate([each.vertices for each in lit]), np.concatenate(faces)


def _image_box(uv: Array, depth: Array, near: float, camera: Camera) -> Box | None:
    """x0, y0, x1, y1 within the image, with a margin, around the points deeper than `near` m; None for no point."""
    some, u0, v0, u1, v1 = kernels.bounds(uv, depth, near)
    if not some:
        return None
    x0, y0 = int(max(math.floor(u0) - 2, 0)), int(max(math.floor(v0) - 2, 0))
    x1, y1 = int(min(math.ceil(u1) + 3, camera.width)), int(min(math.ceil(v1) + 3, camera.height))
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
