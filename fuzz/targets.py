# SPDX-License-Identifier: Apache-2.0
"""Everything that reads what others wrote, one target each: bytes in, a good result or one of our own errors out.

A target may raise `LimblocError`; whatever else it raises is a fault, and so is a result that is not finite or as large
as the input says it is. Seeds are good inputs, from which the fuzzer starts.
"""

from __future__ import annotations

import atexit
import itertools
import math
import os
import random
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.inputs import SPLIT, Draw, mutate_text, split
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig, from_mapping
from limbloc_ros.core.errors import LimblocError

DATA = Path(__file__).parent.parent / "test" / "data"
CORPUS = Path(__file__).parent / "corpus"

Mutator = Callable[[bytes, int, random.Random], bytes]


@dataclass(frozen=True)
class Target:
    """What is fuzzed.

    Attributes:
        run: takes one input; raises only LimblocError.
        seeds: good inputs.
        mutate: how inputs are damaged besides bit by bit.
        most: length of the longest input, bytes.
    """

    run: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]
    mutate: Mutator | None = None
    most: int = 8192


TARGETS: dict[str, Target] = {}


def target(
    name: str, seeds: Callable[[], list[bytes]], mutate: Mutator | None = None, most: int = 8192
) -> Callable[[Callable[[bytes], None]], Callable[[bytes], None]]:
    """Enter a function in TARGETS."""

    def enter(run: Callable[[bytes], None]) -> Callable[[bytes], None]:
        TARGETS[name] = Target(run, seeds, mutate, most)
        return run

    return enter


def check(name: str, data: bytes) -> str:
    """Run one input; returns the message with which it was refused, empty when it was good."""
    try:
        TARGETS[name].run(data)
    except LimblocError as error:
        assert 0 < len(str(error)) < 20_000, f"a message of {len(str(error))} characters helps nobody"
        return str(error)
    return ""


@cache
def folder() -> Path:
    """Where inputs that are files are written: in memory, gone with the process."""
    made = Path(tempfile.mkdtemp(prefix="limbloc_fuzz_", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def file(name: str, data: bytes) -> Path:
    """Write one file of the input."""
    path = folder() / name
    path.write_bytes(data)
    return path


def finite_rig(rig: Rig) -> None:
    """A rig that was accepted holds nothing that later code cannot use."""
    assert np.isfinite(rig.volume_min).all() and np.isfinite(rig.volume_max).all()
    for camera in rig.cameras:
        R = camera.T_world_camera[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-2, camera
        assert camera.width * camera.height <= 64_000_000, "images of this size are refused elsewhere"
        camera.ignored_pixels()
        camera.world_to_image(np.zeros((1, 3)))


def rig_seeds() -> list[bytes]:
    ours = b"""version: 1
units: m
volume: {min: [-1.5, -1.5, 0.0], max: [1.5, 1.5, 2.5]}
cameras:
  - name: cam0
    width: 64
    height: 48
    K: [[51.8, 0, 31.5], [0, 51.8, 23.5], [0, 0, 1]]
    distortion_model: radtan
    distortion: [0.1, -0.05, 0, 0, 0]
    T_world_camera: {translation: [2.0, 0.0, 1.5], quaternion: [0.5, 0.5, -0.5, -0.5]}
    ignore: [[[1, 2], [11, 2], [11, 9], [1, 9]]]
  - name: cam1
    width: 64
    height: 48
    K: [51.8, 0, 31.5, 0, 51.8, 23.5, 0, 0, 1]
    distortion_model: fisheye
    distortion: [0.1, 0, 0, 0]
    T_world_camera: [[0, 0, 1, -2], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
    ignore_mask: none.png
"""
    derived = ours.replace(b"volume: {min: [-1.5, -1.5, 0.0], max: [1.5, 1.5, 2.5]}\n", b"")
    derived = derived.replace(b"    ignore_mask: none.png\n", b"")
    calib = b"""{"cameras": [{"name": "cam0", "width": 64, "height": 48, "K": [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]],
"dist": [0.1, 0, 0, 0, 0], "R": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], "t": [0, 1.5, 2]}]}"""
    return [b"yaml" + ours, b"yaml" + derived, b"json" + calib, b"yaml" + calib]


@target("rig_file", rig_seeds, mutate_text)
def rig_file(data: bytes) -> None:
    """`load_rig`, and what it gave written and read again."""
    from limbloc_ros.rig.rig_file import load_rig, save_rig

    rig = load_rig(file("rig.json" if data[:4] == b"json" else "rig.yaml", data[4:]))
    finite_rig(rig)
    save_rig(rig, folder() / "again.yaml")
    again = load_rig(folder() / "again.yaml")
    assert again.names == rig.names and np.array_equal(again.volume_max, rig.volume_max)


def _format_seeds(*names: str) -> Callable[[], list[bytes]]:
    return lambda: [SPLIT.join((DATA / "rigs" / name).read_bytes() for name in names)]


def _formats() -> dict[str, tuple[tuple[str, ...], Callable[[], list[bytes]]]]:
    """Format -> the names of its files, and seeds."""
    return {
        "qualisys": (("rig.qca.txt",), lambda: [_short_qualisys()]),
        "easymocap": (("intri.yml", "extri.yml"), _format_seeds("easymocap/intri.yml", "easymocap/extri.yml")),
        "kalibr": (("camchain.yaml",), _format_seeds("kalibr_camchain.yaml")),
        "ros": (
            ("ost.yaml", "tf.yaml"),
            lambda: [_format_seeds("ros_ost.yaml", "tf_static.yaml")()[0].replace(b"08144361026320a0", b"front")],
        ),
        "multical": (("calibration.json",), _format_seeds("multical_calibration.json")),
        "benchmark": (("calib.json",), lambda: [rig_seeds()[2][4:]]),
        "anipose": (
            ("Calib.toml",),
            lambda: [_format_seeds(f"{n}.toml")()[0] for n in ("aniposelib_calibration", "pose2sim_Calib_scene")],
        ),
        "caliscope": (("camera_array.toml",), _format_seeds("caliscope_camera_array.toml")),
    }  # fmt: skip


def _short_qualisys() -> bytes:
    """Its first two cameras."""
    head, *cameras = (DATA / "rigs" / "qualisys.qca.txt").read_bytes().split(b"<camera ")
    tail = cameras[-1].partition(b"</camera>")[2]
    return b"<camera ".join([head, *cameras[:2]]).rstrip() + tail


def _import(name: str, names: tuple[str, ...]) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        from limbloc_ros.rig.formats import FORMATS, recognise
        from limbloc_ros.rig.formats.ros import read_transforms, with_poses
        from limbloc_ros.rig.importing import AXES, FITS, UNITS, Wishes, settle

        draw, parts = Draw(data[:12]), split(data[12:], len(names))
        paths = [file(n, part) for n, part in zip(names, parts, strict=True)]
        if draw.below(4) == 0:
            recognise(paths[:1])
        reading = FORMATS[name].read(paths[:1] if name == "ros" else paths)
        if name == "ros":
            reading = with_poses(reading, read_transforms(paths[1]), {}, None, len(data) % 2 == 0)
        up = (None, "cameras", *AXES)[draw.below(8)]
        heights = {reading.cameras[0].name: 10.0} if draw.below(2) else {}
        unit = (None, *UNITS)[draw.below(5)]
        sizes = {"": (640, 480)} if draw.below(2) else {}
        fit = (None, *FITS)[draw.below(4)]
        rig, said = settle(reading, Wishes(unit, None, up, None, heights, sizes, fit))
        finite_rig(rig)
        assert said

    return run


def _with_wishes(run: Callable[[bytes], None], files: list[bytes]) -> list[bytes]:
    """Each file as it is, and with wishes (in twelve bytes ahead) of the person at the terminal that make it a rig."""
    found = []
    for text in files:
        found.append(bytes(12) + text)
        for up, unit, told in itertools.product(range(8), range(5), range(2)):
            data = struct.pack("<6H", 1, up, told, unit, 1, 3) + text
            try:
                run(data)
            except LimblocError:
                continue
            found.append(data)
            break
    return found


for _name, (_files, _seeds) in _formats().items():
    _run = _import(_name, _files)
    TARGETS[f"import_{_name}"] = Target(
        _run,
        lambda run=_run, seeds=_seeds: _with_wishes(run, seeds()),  # type: ignore[misc]
        lambda data, most, rng: data[:12] + mutate_text(data[12:], most - 12, rng),
    )


def _drawn_rig(draw: Draw) -> Rig:
    """Cameras with any name, lens and place."""
    from limbloc_ros.core.camera import DISTORTION_COEFFICIENTS
    from limbloc_ros.rig.geometry import looking_at

    cameras = []
    for _ in range(1 + draw.below(3)):
        model = draw.choice(tuple(DISTORTION_COEFFICIENTS))
        count = draw.choice(DISTORTION_COEFFICIENTS[model])
        K = np.array([[draw.near(500), 0, draw.near(320)], [0, draw.near(500), draw.near(240)], [0, 0, 1.0]])
        place = np.array([draw.near(2), draw.near(1), draw.near(2)])
        T = looking_at(place, np.array([0, 0.1, 1.0])) if draw.below(4) else np.diag([1.0, -1, -1, 1])
        width, height = int(draw.near(640) % 2**31), int(draw.near(480) % 2**31)
        name = f"cam{len(cameras)}" if draw.below(2) else draw.text()
        lens = np.array([draw.near(0.01) for _ in range(count)])
        cameras.append(Camera(name, width, height, K, T, lens, model))
    return Rig(tuple(cameras), np.full(3, draw.near(-1)), np.full(3, draw.near(2)))


@target("export", lambda: [bytes(range(64)) * 4, b"\1\0" * 200, bytes(400)], most=600)
def export(data: bytes) -> None:
    """Any rig into every format, and back."""
    from limbloc_ros.rig.formats import FORMATS

    draw = Draw(data)
    form = draw.choice(tuple(FORMATS.values()))
    with np.errstate(all="ignore"):
        rig = _drawn_rig(draw)
    if form.write is None:
        return
    inside = folder() / "out"
    shutil.rmtree(inside, ignore_errors=True)
    inside.mkdir()
    suffix = {"qualisys": ".qca.txt", "multical": ".json", "benchmark": ".json", "kalibr": ".yaml"}.get(form.name, "")
    suffix = suffix or (".toml" if form.name in ("anipose", "caliscope") else "")
    before = {p for p in folder().rglob("*") if inside not in p.parents}
    form.write(rig, inside / f"rig{suffix}")
    assert before == {p for p in folder().rglob("*") if inside not in p.parents}, "it wrote beside its folder"
    if form.name == "ros":
        reading = form.read(sorted(p for p in (inside / "rig").iterdir() if p.name != "tf_static.yaml"))
    else:
        reading = form.read([inside / f"rig{suffix}"])
    assert len(reading.cameras) == len(rig.cameras)


# --- parameters ---


def _yaml_seeds() -> list[bytes]:
    smart_space = (DATA.parent.parent / "config" / "smart_space.yaml").read_bytes()
    bare = b"\n".join(line for line in smart_space.split(b"\n") if line.strip() and line.lstrip()[:1] != b"#")
    return [bare, b"source: bag\nbag: bag.mcap\nrig: rig.yaml\nsegmentation_of: {cam0: {background: {open_px: 2}}}\n"]


@target("smart_space", _yaml_seeds, mutate_text)
def smart_space(data: bytes) -> None:
    """`smart_space.yaml` for the graph, and for an offline run."""
    from limbloc_ros.nodes import composed, graph_plan
    from limbloc_ros.recordings import config_file

    path = file("smart_space.yaml", data)
    refused = ""
    for read in (config_file.load_config, graph_plan.load_config):
        try:
            read(path)
        except LimblocError as error:
            refused = str(error)
    if refused:
        raise LimblocError(refused)
    config = graph_plan.load_config(path)
    if config.source != "simulated" or config.rig:
        return
    (folder() / "run").mkdir(exist_ok=True)
    for plan in graph_plan.plan_graph(config, folder() / "run"):
        for node in plan.nodes:
            composed.flatten(node["parameters"])


@target("config", lambda: [bytes(range(250)), b"\7\0" * 100, b"\3\0\1\0" * 50], most=500)
def config(data: bytes) -> None:
    """Sections of parameters from any plain values."""
    import dataclasses

    draw = Draw(data)
    kind: Any = draw.choice((BackgroundConfig, HullConfig, SyncConfig, FitConfig))
    names = [f.name for f in dataclasses.fields(kind)]
    values = {draw.choice(names) if draw.below(8) else draw.text(): draw.value() for _ in range(draw.below(6))}
    made = from_mapping(kind, values)
    for field in dataclasses.fields(made):
        value = getattr(made, field.name)
        assert not isinstance(value, float) or math.isfinite(value), field.name
