# SPDX-License-Identifier: Apache-2.0
"""A clip -> glTF 2.0: the flesh figure as a skinned mesh on the figure's bones, with its movement.

Every part of the flesh is the hull of one to three spheres, and every vertex of its mesh lies on one of them: it moves
with the bone that carries that sphere, so that spheres are carried exactly, and the skin between spheres of two bones
is stretched. There, whole spheres lie beneath the skin, which would be pinched where a joint bends far.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from limbloc_ros import __version__
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.figure import N_SPHERES, PART_NAMES, PART_SPHERES, place, proportions
from limbloc_ros.core.flesh_mesh import icosphere, support_points
from limbloc_ros.export.skeleton import Y_UP, Skeleton, rest_state
from limbloc_ros.export.stick_drawing import side_of

Array = NDArray[np.float64]

SUBDIVISIONS, SPHERE_SUBDIVISIONS = 2, 1
#: Linear colours of the skin.
_SKINS = {"": ("middle", (0.50, 0.54, 0.60)), "L": ("left", (0.06, 0.24, 0.55)), "R": ("right", (0.72, 0.22, 0.04))}
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963


def write_gltf(skeleton: Skeleton, path: Path) -> None:
    """Write the skinned, moving figure.

    Args:
        skeleton: from `skeleton_of`.
        path: .glb is one binary file; any other suffix gives one JSON file with the data inside. The caller renames
            it when it is complete.
    """
    data = _Buffer()
    bones = len(skeleton.names)
    rest_world = np.zeros((bones, 3))
    for node, parent in enumerate(skeleton.parents):
        if parent >= 0:
            rest_world[node] = rest_world[parent] + skeleton.rest[node]
    inverse = np.tile(np.eye(4), (bones, 1, 1))
    inverse[:, :3, 3] = -rest_world
    nodes: list[dict[str, Any]] = []
    for node, name in enumerate(skeleton.names):
        children = [child for child, parent in enumerate(skeleton.parents) if parent == node]
        entry: dict[str, Any] = {"name": name, "translation": [float(v) for v in skeleton.rest[node]]}
        nodes.append(entry | ({"children": children} if children else {}))
    nodes.append({"name": "flesh", "mesh": 0, "skin": 0})
    document = {
        "asset": {"version": "2.0", "generator": f"limbloc_ros {__version__}"},
        "scene": 0,
        "scenes": [{"name": "person", "nodes": [0, bones]}],
        "nodes": nodes,
        "skins": [
            {
                "name": "figure",
                "skeleton": 0,
                "joints": list(range(bones)),
                # glTF's matrices stand column by column
                "inverseBindMatrices": data.add(inverse.transpose(0, 2, 1).reshape(-1, 16), _FLOAT, "MAT4"),
            }
        ],
        "meshes": [{"name": "flesh", "primitives": _skin(skeleton, data)}],
        "materials": [
            {
                "name": name,
                "pbrMetallicRoughness": {"baseColorFactor": [*rgb, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7},
            }
            for name, rgb in _SKINS.values()
        ],
        "animations": [_animation(skeleton, data)],
    }
    path.write_bytes(_glb(document, data) if path.suffix.lower() == ".glb" else _embedded(document, data))


def flesh_vertices(shape: Array) -> list[tuple[str, Array, Array, NDArray[np.int64], NDArray[np.int64]]]:
    """The skin at rest: part name, vertices [V, 3] m and normals [V, 3] in world axes, bones [V], faces [T, 3]."""
    figure = place(rest_state(shape))
    bone_of = proportions().point_bones[:N_SPHERES]
    found = []
    within: set[int] = set()
    directions, faces = icosphere(SUBDIVISIONS)
    for name, part in zip(PART_NAMES, PART_SPHERES, strict=True):
        spheres = np.unique(part)
        centres, radii = figure.spheres[spheres], figure.radii[spheres]
        outermost = spheres[np.argmax(directions @ centres.T + radii, axis=1)]
        found.append((name, support_points(centres, radii, directions), directions, bone_of[outermost], faces))
        if len(set(bone_of[spheres])) > 1:
            within |= {int(sphere) for sphere in spheres}
    directions, faces = icosphere(SPHERE_SUBDIVISIONS)
    for sphere in sorted(within):
        part = int(np.flatnonzero(np.isin(PART_SPHERES, sphere).any(axis=1))[0])
        vertices = figure.spheres[sphere] + figure.radii[sphere] * directions
        found.append((PART_NAMES[part], vertices, directions, np.full(len(vertices), bone_of[sphere]), faces))
    return found


def _skin(skeleton: Skeleton, data: _Buffer) -> list[dict[str, Any]]:
    """One primitive for each colour."""
    parts = flesh_vertices(skeleton.shape)
    primitives = []
    for material, side in enumerate(_SKINS):
        chosen = [part for part in parts if side_of(part[0]) == side]
        starts = np.cumsum([0, *(len(part[1]) for part in chosen)])
        joints = np.zeros((starts[-1], 4), dtype=np.uint16)
        joints[:, 0] = np.concatenate([part[3] for part in chosen])
        weights = np.zeros((starts[-1], 4))
        weights[:, 0] = 1.0
        indices = np.concatenate([part[4] + start for part, start in zip(chosen, starts[:-1], strict=True)])
        vertices = np.concatenate([part[1] for part in chosen]) @ Y_UP.T
        primitives.append(
            {
                "attributes": {
                    "POSITION": data.add(vertices, _FLOAT, "VEC3", _ARRAY_BUFFER, bounds=True),
                    "NORMAL": data.add(np.concatenate([p[2] for p in chosen]) @ Y_UP.T, _FLOAT, "VEC3", _ARRAY_BUFFER),
                    "JOINTS_0": data.add(joints, _USHORT, "VEC4", _ARRAY_BUFFER),
                    "WEIGHTS_0": data.add(weights, _FLOAT, "VEC4", _ARRAY_BUFFER),
                },
                "indices": data.add(indices.reshape(-1, 1), _UINT, "SCALAR", _ELEMENT_BUFFER),
                "material": material,
            }
        )
    return primitives


def _animation(skeleton: Skeleton, data: _Buffer) -> dict[str, Any]:
    times = np.arange(len(skeleton.places))[:, None] / skeleton.rate_hz
    clock = data.add(times, _FLOAT, "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def channel(node: int, what: str, values: Array, kind: str) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": what}})
        samplers.append({"input": clock, "interpolation": "LINEAR", "output": data.add(values, _FLOAT, kind)})

    bones = [node for node in range(len(skeleton.names)) if (skeleton.parents == node).any() or node in _ends(skeleton)]
    for node in bones:
        channel(node, "rotation", _quaternions(skeleton.rotations[:, node]), "VEC4")
    for node in range(len(skeleton.names)) if skeleton.stretches else [0]:
        channel(node, "translation", skeleton.places[:, node], "VEC3")
    return {"name": "recording", "samplers": samplers, "channels": channels}


def _ends(skeleton: Skeleton) -> set[int]:
    """Nodes without children that turn all the same."""
    still = np.abs(skeleton.rotations - np.eye(3)).max(axis=(0, 2, 3)) < 1e-9
    return {int(node) for node in np.flatnonzero(~still)}


def _quaternions(rotations: Array) -> Array:
    """[F, 4] x y z w; neighbours on the same half of the sphere, so that players interpolate the short way."""
    try:
        found = Rotation.from_matrix(np.array(rotations)).as_quat()
    except ValueError as error:
        raise InputError(f"a bone's rotation is none ({error}): the file is damaged; run `process` again") from None
    flips = np.where(np.sum(found[1:] * found[:-1], axis=1) < 0, -1.0, 1.0)
    found[1:] *= np.cumprod(flips)[:, None]
    return np.asarray(found)


class _Buffer:
    """The binary data, with the views and accessors into it."""

    def __init__(self) -> None:
        self.bytes = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray[Any], component: int, kind: str, target: int = 0, bounds: bool = False) -> int:
        """Append an array [N, K]; returns its accessor's number."""
        types: dict[int, Any] = {_FLOAT: np.dtype("<f4"), _USHORT: np.dtype("<u2"), _UINT: np.dtype("<u4")}
        rows = np.ascontiguousarray(values, dtype=types[component])
        self.bytes += b"\0" * (-len(self.bytes) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": rows.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.bytes += rows.tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": component,
            "count": len(rows),
            "type": kind,
        }
        if bounds:
            accessor |= {"min": [float(v) for v in rows.min(axis=0)], "max": [float(v) for v in rows.max(axis=0)]}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _complete(document: dict[str, Any], data: _Buffer, uri: str = "") -> bytes:
    buffer: dict[str, Any] = {"byteLength": len(data.bytes)}
    document |= {
        "accessors": data.accessors,
        "bufferViews": data.views,
        "buffers": [buffer | ({"uri": uri} if uri else {})],
    }
    return json.dumps(document, separators=(",", ":")).encode()


def _glb(document: dict[str, Any], data: _Buffer) -> bytes:
    data.bytes += b"\0" * (-len(data.bytes) % 4)
    text = _complete(document, data)
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data.bytes))
    text_head, data_head = struct.pack("<I4s", len(text), b"JSON"), struct.pack("<I4s", len(data.bytes), b"BIN\0")
    return b"".join([head, text_head, text, data_head, data.bytes])


def _embedded(document: dict[str, Any], data: _Buffer) -> bytes:
    packed = base64.b64encode(bytes(data.bytes)).decode()
    return _complete(document, data, f"data:application/octet-stream;base64,{packed}")
