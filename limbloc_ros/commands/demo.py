# SPDX-License-Identifier: Apache-2.0
"""`limbloc demo`: a simulated person, the whole graph over real DDS, a live table, then bag, CSV and report."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from datetime import datetime
from pathlib import Path

from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.ros.process_starter import SERVER

DESCRIPTION = """\
See it work without cameras. A simulated person moves in a room that 8 simulated cameras see, with texture, noise,
shadow and drifting light; the body is a skinned mesh, not the figure that is fitted. Segmentation, carving and pose run
as ROS 2 nodes and talk over DDS; a table shows how they do, and OUT gets

  bag/              what was published: masks, joints, joint states, true joints, diagnostics
  live.csv          a row per pose as it arrived: latency, error against the true joints
  joint_angles.csv  every joint angle of every recorded frame, worked out from the bag by the same code
  report/           pictures and report.html
"""

EPILOG = """\
examples:
  limbloc demo
  limbloc demo --seconds 10 --cameras 4 --person child
  limbloc demo --people 3 --together crossing
  limbloc demo --domain 42        and beside it: ROS_DOMAIN_ID=42 rviz2 -d config/limbloc.rviz
"""

#: Without a pose after this long something is wrong, s. The first start of all compiles the kernels, and then the
#: background is learned.
START_S = 300.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--seconds", type=float, default=30.0, metavar="S", help="how long, from the first pose (default: 30)"
    )
    parser.add_argument("--cameras", type=int, default=8, metavar="N", help="2 to 16 (default: 8)")
    parser.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="images per second (default: 10)")
    parser.add_argument(
        "--person", choices=("man", "woman", "child", "heavy"), default="man", help="who moves (default: man)"
    )
    parser.add_argument("--people", type=int, default=1, metavar="N", help="how many, 1 to 4 (default: 1)")
    parser.add_argument(
        "--together",
        choices=("apart", "crossing", "touching"),
        default="apart",
        help="what several people do (default: apart)",
    )
    parser.add_argument("--out", type=Path, help="folder for the results (default: out/demo-<date>)")
    parser.add_argument("--domain", type=int, metavar="ID", help="ROS_DOMAIN_ID (default: the shell's, or a free one)")
    parser.add_argument(
        "--foxglove", nargs="?", type=int, const=0, metavar="PORT", help="show it in Foxglove too, as in `limbloc run`"
    )
    parser.add_argument("--no-report", action="store_true", help="leave the report and the angles out, only run live")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="as in `limbloc run`")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    check(args)
    out = args.out or Path("out") / f"demo-{datetime.now():%Y%m%d-%H%M%S}"
    if (out / "bag").exists() or (out / "run.json").exists():
        raise InputError(f"{out} holds a demo or results already; choose another --out or remove it")
    out.mkdir(parents=True, exist_ok=True)
    _run_live(args, out)
    if args.no_report:
        return 0
    print("\nworking out all joint angles from the recorded masks, for CSV and report")
    from limbloc_ros.cli import main

    return main(
        ["process", str(out / "bag"), "--rig", str(out / "rig.yaml"), "--out", str(out), "--temporal", "--report"]
    )


def check(args: argparse.Namespace) -> None:
    """Raise ConfigError for a number that makes no sense, before anything is started."""
    for option, value, low, high in (
        ("--seconds", args.seconds, 1, 86400),
        ("--cameras", args.cameras, 2, 16),
        ("--rate", args.rate, 0.1, 120),
        ("--people", args.people, 1, 4),
        ("--domain", 0 if args.domain is None else args.domain, 0, 232),
    ):
        if not low <= value <= high:
            raise ConfigError(f"{option}: expected {low:g} to {high:g}, got {value:g}")


def _run_live(args: argparse.Namespace, out: Path) -> None:
    """Start the graph, watch it, stop it."""
    from limbloc_ros.nodes.graph_plan import plan_graph
    from limbloc_ros.nodes.smart_space import config_from_arguments
    from limbloc_ros.rig.rig_file import save_rig
    from limbloc_ros.ros.environment import graph_environment
    from limbloc_ros.ros.supervisor import Supervisor
    from limbloc_ros.simulation.ring import default_rig

    save_rig(default_rig(args.cameras), out / "rig.yaml")
    settings = [
        f"simulated_cameras.rate_hz={float(args.rate)}",
        f"simulated_cameras.person={args.person}",
        f"simulated_cameras.people={args.people}",
        f"simulated_cameras.together={args.together}",
        "record.images=none",  # eight raw cameras fill 70 MB a second; the masks are what the poses come from
        "pose.fit.temporal=true",  # a figure fitted from scratch takes longer than the time between two images
        f"network.domain_id={_domain(args.domain)}",
        *args.set,
    ]
    options = argparse.Namespace(
        config=None,
        source="simulated",
        rig=str((out / "rig.yaml").resolve()),
        bag=None,
        cameras=None,
        record=str((out / "bag").resolve()),
        foxglove=args.foxglove,
        set=settings,
    )
    config = config_from_arguments(options)
    run_folder = tempfile.TemporaryDirectory(prefix="limbloc_")
    plans = plan_graph(config, Path(run_folder.name))
    environment = graph_environment(config.network)
    # This process takes part in the same DDS domain; the variables are read when the first node is made.
    os.environ.update(environment)

    domain = os.environ["ROS_DOMAIN_ID"]
    print(f"{args.cameras} cameras at {args.rate:g} Hz, {len(plans)} processes, ROS_DOMAIN_ID {domain}")
    print("the room is empty at first, while the background is learned; Ctrl-C ends the demo early\n", flush=True)
    log = (out / "graph.log").open("w", encoding="utf-8")

    def say(line: str) -> None:
        print(line, file=log, flush=True)
        # The first start of all takes long, and says why; a node that cannot run says why, too.
        if line.startswith(f"[{SERVER}]") or "[FATAL]" in line:
            print(line)

    # The supervisor ends all children on the way out, whatever happens.
    with log, run_folder, Supervisor(plans, environment, config.processes, say) as graph:
        started = time.monotonic()
        from limbloc_ros.commands._live_table import LiveTable  # ROS is loaded while the graph starts

        with LiveTable() as table:
            try:
                while table.seconds < args.seconds:
                    if not graph.poll():
                        raise InputError(f"the graph ended early: {graph.failure}; see {out / 'graph.log'}")
                    if table.seconds == 0 and time.monotonic() - started > START_S:
                        raise InputError(f"no pose within {START_S:.0f} s; see {out / 'graph.log'} for the reason")
                    table.spin()
            except KeyboardInterrupt:
                print("ending early")
        restarts = {name: count for name, count in graph.restarts.items() if count}
        print(f"\n{table.summary()}" + (f"\nrestarted: {restarts}" if restarts else ""))
        table.save(out / "live.csv")
    print(f"recorded in {out / 'bag'}")


def _domain(wanted: int | None) -> int:
    """The domain asked for, the shell's, or one of our own, so that two demos on a machine do not mix."""
    if wanted is not None:
        return wanted
    return int(os.environ["ROS_DOMAIN_ID"]) if os.environ.get("ROS_DOMAIN_ID", "").isdigit() else 1 + os.getpid() % 100
