# SPDX-License-Identifier: Apache-2.0
"""`limbloc export`: a finished run as files that other programs open."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.export import bvh, c3d_file, trc
from limbloc_ros.export.clip import Clip, clip_of
from limbloc_ros.export.gltf import write_gltf
from limbloc_ros.export.hulls import kept_masks, recorded_masks, write_hulls
from limbloc_ros.export.markers import MARKER_SETS
from limbloc_ros.export.recording import config_of, open_recording, rig_of
from limbloc_ros.export.skeleton import LENGTHS, Skeleton, skeleton_of
from limbloc_ros.export.tables import csv_text
from limbloc_ros.export.video import CODECS, write_video
from limbloc_ros.files import replaced, write_text
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import Run

DESCRIPTION = """\
Write a run that `limbloc process` or `limbloc demo` left in RUN for other programs:

  csv    a row per frame: every joint (m, z up), its sigma, every angle (rad)
  trc    markers for OpenSim and Pose2Sim (y up, m)
  c3d    markers for motion laboratories (z up, mm); needs the extra `export` (ezc3d)
  bvh    skeleton for Blender, MotionBuilder, game engines (y up, z forward, m)
  gltf   the flesh figure as a skinned, moving mesh (.glb; .gltf for JSON)
  ply    the visual hull as meshes, a file per frame (z up, m), of the frames that the run kept; with --recording of all
  video  the stick figure over every camera's images; reads the recording again
"""

EPILOG = """\
examples:
  limbloc export out/walk --format bvh
  limbloc export out/walk --format csv trc c3d --out files/
  limbloc export out/walk --format bvh --lengths person --unit cm --out walk.bvh
  limbloc export out/walk --format gltf --out walk.glb
  limbloc export out/walk --format video --out walk.mp4 --recording bags/walk
"""

SUFFIXES = {"csv": ".csv", "trc": ".trc", "c3d": ".c3d", "bvh": ".bvh", "gltf": ".glb", "ply": "", "video": ".mp4"}
#: Suffixes that --out may have, where it is not the usual one alone.
_OTHERS = {"gltf": (".glb", ".gltf"), "video": tuple(CODECS)}
_UNITS = {"trc": tuple(trc.UNITS), "c3d": tuple(c3d_file.UNITS), "bvh": tuple(bvh.UNITS)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder with the results of `limbloc process`")
    parser.add_argument("--format", nargs="+", required=True, choices=tuple(SUFFIXES), help="one or more of them")
    parser.add_argument("--out", type=Path, help="file, or folder for several formats (default: RUN/export)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="first frame of the run (default: 0)")
    parser.add_argument("--last", type=int, metavar="N", help="last frame of the run (default: the last there is)")
    parser.add_argument("--only-reliable", action="store_true", help="leave out poses that should not be acted on")
    parser.add_argument(
        "--lengths",
        choices=LENGTHS,
        default="auto",
        help="bvh, gltf: bones as long as fitted to each `frame`, so that joints lie where they were found, or always "
        "as long as the `person`'s median, which some programs want (default: auto, by frame unless they are constant)",
    )
    parser.add_argument("--unit", choices=("m", "cm", "mm"), help="trc, c3d: m or mm; bvh: m, cm or mm")
    parser.add_argument("--names", choices=tuple(MARKER_SETS), help="markers' names (trc: pose2sim, c3d: limbloc)")
    parser.add_argument("--recording", type=Path, help="video, ply: the bag, folder or case, if it has been moved")
    parser.add_argument(
        "--background", metavar="DIR", help="ply of a recording: pictures of the empty room, if they have been moved"
    )
    parser.add_argument("--width", type=int, default=480, metavar="PX", help="video: of a panel (default: 480)")
    parser.add_argument("--columns", type=int, default=0, metavar="N", help="video: panels in a row (default: fits)")


@dataclass(frozen=True)
class _Job:
    """What one format is made from."""

    args: argparse.Namespace
    run: Run
    out: Path
    unit: str | None


def run(args: argparse.Namespace) -> int:
    """Do it."""
    last = "the end" if args.last is None else args.last
    if args.first < 0 or (args.last is not None and args.last < args.first):
        raise ConfigError(f"--first and --last: expected 0 or more, first before last, got {args.first} and {last}")
    if not 32 <= args.width <= 4096:
        raise ConfigError(f"--width: expected 32 to 4096 px, got {args.width}")
    if args.columns < 0:
        raise ConfigError(f"--columns: expected 0 (as fits) or more, got {args.columns}")
    formats = list(dict.fromkeys(args.format))
    targets = {name: _target(name, args, len(formats) > 1) for name in formats}
    if args.unit:
        for name in set(formats) & set(_UNITS):
            if args.unit not in _UNITS[name]:
                raise ConfigError(f"--unit: {name} takes {' or '.join(_UNITS[name])}, got {args.unit}")
    result = Run.load(args.run)
    for name, out in targets.items():
        print(f"{name}: {_WRITERS[name](_Job(args, result, out, args.unit))}", flush=True)
    return 0


def _target(name: str, args: argparse.Namespace, several: bool) -> Path:
    """The file (for ply the folder) of one format."""
    stem = args.run.resolve().name or "run"
    own = f"{stem}_hulls" if name == "ply" else stem + SUFFIXES[name]
    if args.out is None:
        return Path(args.run) / "export" / own
    suffixes = _OTHERS.get(name, (SUFFIXES[name],))
    if not several and (name == "ply" or args.out.suffix.lower() in suffixes):
        if args.out.is_dir() and name != "ply":
            raise InputError(f"--out {args.out} is a folder; choose another name")
        return Path(args.out)
    if args.out.suffix and not args.out.is_dir():
        wanted = "a folder for several formats" if several else f"a folder or a name ending in {' or '.join(suffixes)}"
        raise InputError(f"--out {args.out}: expected {wanted}")
    if args.out.is_file():
        raise InputError(f"--out {args.out} is a file; choose another name")
    return Path(args.out) / own


def _clip(job: _Job) -> Clip:
    args = job.args
    clip = clip_of(job.run, only_reliable=args.only_reliable, first=args.first, last=args.last)
    if clip.doubled:
        tqdm.write(f"note: {clip.doubled} frames were left out, because their stamps are closer than the usual step")
    return clip


def _csv(job: _Job) -> str:
    args = job.args
    write_text(job.out, csv_text(job.run, first=args.first, last=args.last, only_reliable=args.only_reliable))
    return str(job.out)


def _trc(job: _Job) -> str:
    clip = _clip(job)
    write_text(job.out, trc.trc_text(clip, job.out.name, job.unit or "m", job.args.names or "pose2sim"))
    return f"{job.out}, {_rows(clip)}"


def _c3d(job: _Job) -> str:
    clip = _clip(job)
    with replaced(job.out) as path:
        c3d_file.write_c3d(clip, path, job.unit or "mm", job.args.names or "limbloc")
    return f"{job.out}, {_rows(clip)}"


def _bvh(job: _Job) -> str:
    clip = _clip(job)
    skeleton = skeleton_of(clip, job.args.lengths)
    with _bar("bvh", len(clip)) as bar:
        write_text(job.out, bvh.bvh_text(skeleton, job.unit or "m", partial(bar.update, 1)))
    return f"{job.out}, {_rows(clip, 'repeat the pose before them')}; {_lengths(clip, skeleton)}"


def _gltf(job: _Job) -> str:
    clip = _clip(job)
    skeleton = skeleton_of(clip, job.args.lengths)
    with replaced(job.out) as path:
        write_gltf(skeleton, path)
    return f"{job.out}, {_rows(clip, 'repeat the pose before them')}; {_lengths(clip, skeleton)}"


def _ply(job: _Job) -> str:
    args = job.args
    rig = rig_of(args.run)
    last = len(job.run) - 1 if args.last is None else args.last
    if args.recording is None and args.background is None:
        kept = KeptFrames.load(args.run)
        if not kept.numbers:
            raise InputError(f"{args.run} kept no masks; give the recording with --recording")
        frames, count = kept_masks(kept), len(kept.numbers)
    else:
        source = open_recording(job.run, args.run, args.recording, args.background)
        frames, count = recorded_masks(source, job.run), last - args.first + 1
    chosen = ((number, masks) for number, masks in frames if args.first <= number <= last)
    with _bar("ply", count) as bar:
        written = write_hulls(chosen, rig, config_of(job.run).hull, job.out, partial(bar.update, 1))
    if not written:
        raise InputError(f"no frame from {args.first} to {last} has a hull; there is nothing to export")
    return f"{job.out}, {written} hulls"


def _video(job: _Job) -> str:
    args, clip = job.args, _clip(job)
    source = open_recording(job.run, args.run, args.recording)
    with _bar("video", len(clip)) as bar, replaced(job.out) as path:
        frames = write_video(
            clip, source, path, panel_width_px=args.width, columns=args.columns, progress=partial(bar.update, 1)
        )
    return f"{job.out}, {frames} frames at {clip.rate_hz:g} Hz"


_WRITERS: dict[str, Callable[[_Job], str]] = {
    "csv": _csv, "trc": _trc, "c3d": _c3d, "bvh": _bvh, "gltf": _gltf, "ply": _ply, "video": _video,
}  # fmt: skip


def _rows(clip: Clip, empty: str = "are empty") -> str:
    text = f"{len(clip)} frames at {clip.rate_hz:g} Hz"
    return f"{text}, {clip.empty} without a pose {empty}" if clip.empty else text


def _lengths(clip: Clip, skeleton: Skeleton) -> str:
    apart = 1000 * skeleton.deviation_m(clip)
    kind = "lengths of each frame" if skeleton.stretches else "constant lengths"
    return f"{kind}, joints within {np.nanmax(apart):.1f} mm of the run's (median {np.nanmedian(apart):.1f} mm)"


def _bar(name: str, total: int) -> tqdm:
    return tqdm(desc=name, total=total, unit="frame", disable=None, dynamic_ncols=True)
