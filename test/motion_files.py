# SPDX-License-Identifier: Apache-2.0
"""Readers of BVH, C3D, PLY and GLB for tests: written from the formats, not from our writers."""

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation


def read_bvh(text):
    """Names, parents, offsets [N, 3], frame time, world places [F, N, 3] (position channels replace the offset)."""
    words = text.split()
    names, parents, offsets, channels, stack, at = [], [], [], [], [], 1
    while words[at] != "MOTION":
        word = words[at]
        if word in ("ROOT", "JOINT", "End"):
            names.append(f"{names[stack[-1]]} end" if word == "End" else words[at + 1])
            parents.append(stack[-1] if stack else -1)
            offsets.append(None)
            channels.append([])
            at += 2
        elif word == "{":
            stack.append(len(names) - 1)
            at += 1
        elif word == "}":
            stack.pop()
            at += 1
        elif word == "OFFSET":
            offsets[stack[-1]] = [float(v) for v in words[at + 1 : at + 4]]
            at += 4
        else:
            assert word == "CHANNELS", word
            count = int(words[at + 1])
            channels[stack[-1]] = words[at + 2 : at + 2 + count]
            at += 2 + count
    assert words[at + 1] == "Frames:"
    frames, frame_time = int(words[at + 2]), float(words[at + 5])
    values = np.array(words[at + 6 :], dtype=float).reshape(frames, -1)
    places, turned, column = np.zeros((frames, len(names), 3)), [], 0
    for node, parent in enumerate(parents):
        local, turn = np.tile(np.array(offsets[node]), (frames, 1)), Rotation.identity(frames)
        for channel in channels[node]:
            value, column = values[:, column], column + 1
            if channel.endswith("position"):
                local[:, "XYZ".index(channel[0])] = value
            else:
                turn = turn * Rotation.from_euler(channel[0], value[:, None], degrees=True)
        if parent < 0:
            places[:, node] = local
        else:
            places[:, node] = places[:, parent] + turned[parent].apply(local)
            turn = turned[parent] * turn
        turned.append(turn)
    assert column == values.shape[1]
    return names, parents, np.array(offsets), frame_time, places


def read_c3d(data):
    """Points [F, M, 4] (x y z residual, unscaled floats) and the rate, from the header of a little-endian C3D file."""
    assert data[1] == 0x50
    points, first, last = struct.unpack_from("<H", data, 2)[0], *struct.unpack_from("<2H", data, 6)
    (analog,) = struct.unpack_from("<H", data, 4)
    (scale,) = struct.unpack_from("<f", data, 12)
    (block,) = struct.unpack_from("<H", data, 16)
    (rate,) = struct.unpack_from("<f", data, 20)
    assert scale < 0, "expected floats"
    frames = last - first + 1
    rows = np.frombuffer(data, "<f4", frames * (4 * points + analog), 512 * (block - 1))
    return rows.reshape(frames, -1)[:, : 4 * points].reshape(frames, points, 4), rate


def read_ply(data):
    """Vertices with normals [V, 6] and faces [T, 3] of a binary PLY file."""
    head, _, body = data.partition(b"end_header\n")
    counts = {
        words[1]: int(words[2])
        for words in (line.split() for line in head.decode().splitlines())
        if words[0] == "element"
    }
    vertices = np.frombuffer(body, "<f4", 6 * counts["vertex"]).reshape(-1, 6)
    rows = np.frombuffer(body[vertices.nbytes :], [("n", "u1"), ("v", "<i4", 3)])
    assert len(rows) == counts["face"]
    assert (rows["n"] == 3).all()
    return vertices, rows["v"]


class Gltf:
    """A GLB file with one skin and one animation."""

    def __init__(self, data):
        magic, version, total = struct.unpack_from("<4sII", data)
        assert (magic, version, total) == (b"glTF", 2, len(data))
        (size, kind) = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json = json.loads(data[20 : 20 + size])
        self._binary = data[28 + size :]

    def array(self, accessor):
        """[N, K] values of an accessor."""
        entry = self.json["accessors"][accessor]
        view = self.json["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry["type"]]
        kind = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[entry["componentType"]]
        return np.frombuffer(self._binary, kind, entry["count"] * width, view["byteOffset"]).reshape(-1, width)

    def nodes(self, frame):
        """World matrices [N, 4, 4] of all nodes in a frame."""
        nodes = self.json["nodes"]
        local = np.tile(np.eye(4), (len(nodes), 1, 1))
        for matrix, node in zip(local, nodes, strict=True):
            matrix[:3, 3] = node.get("translation", (0, 0, 0))
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            value = self.array(animation["samplers"][channel["sampler"]]["output"])[frame]
            matrix = local[channel["target"]["node"]]
            if channel["target"]["path"] == "rotation":
                matrix[:3, :3] = Rotation.from_quat(value).as_matrix()
            else:
                matrix[:3, 3] = value
        world = local.copy()

        def visit(node):
            for child in nodes[node].get("children", ()):
                world[child] = world[node] @ local[child]
                visit(child)

        for root in self.json["scenes"][0]["nodes"]:
            visit(root)
        return world

    def skin(self, frame):
        """[V, 3] vertices of all primitives, as a player shows them."""
        skin = self.json["skins"][0]
        bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        matrices = self.nodes(frame)[skin["joints"]] @ bind
        found = []
        for primitive in self.json["meshes"][0]["primitives"]:
            at = {name: self.array(number) for name, number in primitive["attributes"].items()}
            points = np.concatenate([at["POSITION"], np.ones((len(at["POSITION"]), 1))], axis=1)
            blended = np.einsum("vk,vkij->vij", at["WEIGHTS_0"], matrices[at["JOINTS_0"]])
            found.append(np.einsum("vij,vj->vi", blended, points)[:, :3])
        return np.concatenate(found)
