# SPDX-License-Identifier: Apache-2.0
"""`limbloc batch`: many recordings, here or on a Dask cluster."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from limbloc_ros.commands.process import add_options, config_of
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.recordings.batch import Outcome, Task, do_here, do_on_cluster

DESCRIPTION = """\
Work out the poses of many recordings, each as `limbloc process` would: the results of RECORDING are in OUT/<its name>.
Whatever is finished is not done again, so the same command goes on after Ctrl-C, a crash or a power cut.

With --dask the recordings go to the workers of a Dask cluster that is running already. They need limbloc_ros of this
version, and must see the recordings and OUT under the same paths (a shared disk). One thread per worker is best:
  dask scheduler                                         on one machine
  dask worker tcp://HOST:8786 --nworkers auto --nthreads 1    on each machine
"""

EPILOG = """\
examples:
  limbloc batch bags/* --rig rig.yaml --out out/study
  limbloc batch bags/* --rig rig.yaml --out out/study --dask tcp://head:8786
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("inputs", type=Path, nargs="+", metavar="RECORDING", help="as INPUT of `limbloc process`")
    parser.add_argument("--rig", type=Path, help="rig YAML or calib.json with the calibrated cameras of all recordings")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for all results (default: out)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, e.g. tcp://head:8786")
    add_options(parser)


def run(args: argparse.Namespace) -> int:
    """Do it; the exit code is 1 when a recording failed."""
    tasks = tasks_of(args)
    outcomes: Iterator[Outcome] = do_on_cluster(tasks, args.dask) if args.dask else do_here(tasks, args.jobs)
    failed = 0
    with tqdm(total=len(tasks), unit="recording", disable=None, dynamic_ncols=True) as bar:
        for outcome in outcomes:
            bar.update()
            failed += bool(outcome.error)
            before = " (done before)" if outcome.done_before else ""
            text = outcome.error or f"{outcome.poses} of {outcome.frames} frames have a pose{before}"
            bar.write(f"{outcome.task.recording}: {text}")
    print(f"{len(tasks) - failed} of {len(tasks)} recordings are done; results in {args.out}")
    return 1 if failed else 0


def tasks_of(args: argparse.Namespace) -> list[Task]:
    """One task a recording.

    Raises:
        ConfigError: an option is wrong, or two recordings have the same name.
    """
    config = config_of(args)
    names = [path.resolve().name for path in args.inputs]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ConfigError(
            f"expected recordings of different names, for each gets OUT/<name>; twice: {', '.join(twice)}"
        )
    return [
        Task(path, args.out / name, args.rig, config, args.background, args.masks, args.fps, args.leave_out)
        for path, name in zip(args.inputs, names, strict=True)
    ]
