# SPDX-License-Identifier: Apache-2.0
"""Several people: errors, exchanged ids, people who are none, and the rate beside that of one person.

    python benchmarks/bench_people.py [--cameras 8] [--seconds 30] [--rate 10] [--live 20] [--alone]

Everybody is a skinned body that the fit did not draw (`limbloc_ros/simulation`); silhouettes are the true ones. Each
row is a scene through the offline run (`temporal`, one process, unless `--alone`):

- error: mean over head and limb joints of the reliable poses, mm, each person's own; a pose belongs to the true person
  whose trunk is nearest. reliable: share of the frames in which somebody is there and has a reliable pose.
- wrong: reliable poses of which a limb's joint is more than 15 cm from the truth.
- exchanged: times that a true person's id changed.
- phantoms: reliable poses that are further than 0.3 m from everybody, or second ones of the same person.
- ms: process time of hull and all fits, also those of who has no number yet, per frame, median and mean; rate: one
  person's mean over it.

`--live S` also runs the graph over DDS for so long with one, two and three people and counts the same in what arrives.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.config import FitConfig
from limbloc_ros.core.pose import JOINT, Pose
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.results import Run
from limbloc_ros.recordings.sources import MaskSet
from limbloc_ros.simulation.company import chair, company
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

Array = NDArray[np.float64]

SCORED = ["head_centre", *(f"{j}_{s}" for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR")]
ROWS = [JOINT[name] for name in SCORED]
#: Of the arms and legs; of a reliable pose none may be further off than this, m.
LIMBS = ROWS[1:]
WRONG_M = 0.15
NEAR_M = 0.3
#: Who is further than this from the middle is not wholly in the carve volume.
INSIDE_M = 1.25
#: A live graph in which nobody is found after so long is scored all the same, s.
LONGEST_WAIT_S = 120.0

#: So many images of each camera show the empty room: the background is learnt from 15.
EMPTY_IMAGES = 20

#: Name, people, what they do, whether a chair is put beside them and moved.
SCENES = (
    ("one person", 1, "apart", False),
    ("one and a chair", 1, "apart", True),
    ("two apart", 2, "apart", False),
    ("two crossing", 2, "crossing", False),
    ("two touching", 2, "touching", False),
    ("two touching, a chair", 2, "touching", True),
    ("three apart", 3, "apart", False),
    ("three crossing", 3, "crossing", False),
    ("three, two of them touching", 3, "touching", False),
    ("four crossing", 4, "crossing", False),
)


@dataclass
class Score:
    """What came of one scene; `see` takes its frames in order."""

    people: int
    errors: list[list[float]] = field(default_factory=list)
    reliable: list[int] = field(default_factory=list)
    present: list[int] = field(default_factory=list)
    wrong: int = 0
    exchanged: int = 0
    phantoms: int = 0
    last: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.errors = [[] for _ in range(self.people)]
        self.reliable, self.present = [0] * self.people, [0] * self.people

    def see(self, truth: Sequence[Array | None], found: dict[int, Array]) -> None:
        """One frame: the true joints of everybody, and the joints found by number (reliable ones)."""
        taken: set[int] = set()
        inside = [
            joints is not None and bool((np.abs(joints[JOINT["torso_centre"], :2]) < INSIDE_M).all())
            for joints in truth
        ]
        for k, there in enumerate(inside):
            self.present[k] += there
        for number, joints in found.items():
            away = [
                np.inf
                if true is None
                else float(np.linalg.norm(joints[JOINT["torso_centre"]] - true[JOINT["torso_centre"]]))
                for true in truth
            ]
            k = int(np.argmin(away))
            true = truth[k]
            if true is None or away[k] > NEAR_M or k in taken:
                self.phantoms += 1
                continue
            taken.add(k)
            self.exchanged += self.last.get(k, number) != number
            self.last[k] = number
            self.reliable[k] += inside[k]
            away_m = np.linalg.norm(joints - true, axis=1)
            self.wrong += bool(away_m[LIMBS].max() > WRONG_M)
            self.errors[k].append(1e3 * float(away_m[ROWS].mean()))

    def text(self) -> str:
        """Its columns: errors, reliable, wrong, exchanged, phantoms."""
        errors = ", ".join(f"{np.mean(e):.0f}" if e else "-" for e in self.errors)
        share = ", ".join(f"{100 * r / max(p, 1):.0f}" for r, p in zip(self.reliable, self.present, strict=True))
        return f"{errors} | {share} | {self.wrong} | {self.exchanged} | {self.phantoms}"


class Silhouettes:
    """The true silhouettes of a simulated room as a source of the offline run."""

    def __init__(self, room: SimulatedRoom, seconds: float, rate: float) -> None:
        self.rig, self.notes, self._room = room.rig, [], room
        self.times = np.arange(room.motion.empty_s, room.motion.empty_s + seconds, 1 / rate)
        self.frames = len(self.times)
        self.identity = self.about = {"input": "simulated silhouettes", "consecutive": True}
        #: Process time of everything that the run did with each frame, ms.
        self.spent_ms: list[float] = []

    def mask_sets(self) -> Iterator[MaskSet]:
        """Frame by frame."""
        for t in self.times:
            masks = {name: self._room.render_with_mask(name, float(t))[1] for name in self.rig.names}
            start = time.process_time()
            yield MaskSet(round(t * 1e9), masks)
            self.spent_ms.append(1e3 * (time.process_time() - start))


def score_scene(people: int, together: str, furnished: bool, args: argparse.Namespace) -> tuple[Score, Array, Run]:
    """Run one scene offline: its score, and each frame's process time in ms."""
    rig = default_rig(args.cameras)
    # pushed to another place while the others go on; in the corner that nobody crosses
    things = [chair([(2.0, 0.1, -1.15, 0.3), (12.0, 0.1, -1.15, 0.3), (14.0, 0.45, -1.05, 1.2)])] if furnished else []
    room = SimulatedRoom(rig, motions=company(people, together), things=things)
    source = Silhouettes(room, args.seconds, args.rate)
    run = process(source, OfflineConfig(fit=FitConfig(temporal=not args.alone)), jobs=1)
    score = Score(people)
    for t, frame in zip(source.times, run.frames, strict=True):
        bodies = [(frame.number, frame.outcome), *((body.number, body.outcome) for body in frame.others)]
        found = {number: pose.joints for number, pose in bodies if isinstance(pose, Pose) and pose.reliable}
        score.see(room.everybodys_joints(float(t)), found)
    return score, np.array(source.spent_ms), run


def score_live(people: int, together: str, args: argparse.Namespace) -> tuple[Score, float, float]:
    """Run the graph over DDS: the score of what arrives, poses of the first person a second, and median latency ms."""
    import rclpy
    from geometry_msgs.msg import PoseArray

    from limbloc_ros.nodes.graph_plan import plan_graph
    from limbloc_ros.nodes.smart_space import config_from_arguments
    from limbloc_ros.ros import topics
    from limbloc_ros.ros.environment import graph_environment
    from limbloc_ros.ros.messages import message_to_joints, stamp_ns
    from limbloc_ros.ros.node_main import make_executor
    from limbloc_ros.ros.supervisor import Supervisor

    options = argparse.Namespace(
        config=None, source="simulated", rig=None, bag=None, cameras=None, record=None, foxglove=None,
        set=[
            f"simulated_cameras.rate_hz={float(args.live_rate)}", f"simulated_cameras.number_of_cameras={args.cameras}",
            f"simulated_cameras.width={args.live_width}", f"simulated_cameras.height={args.live_width * 3 // 4}",
            f"simulated_cameras.people={people}", f"simulated_cameras.together={together}",
            f"simulated_cameras.empty_s={EMPTY_IMAGES / args.live_rate}",
            "pose.fit.temporal=true", f"network.domain_id={1 + os.getpid() % 100}",
        ],
    )  # fmt: skip
    config = config_from_arguments(options)
    truth: dict[int, dict[int, Array | None]] = {}
    found: dict[int, dict[int, Array]] = {}
    first: dict[int, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        plans = plan_graph(config, Path(folder))
        environment = graph_environment(config.network)
        os.environ.update(environment)
        rclpy.init()
        node, executor = rclpy.create_node("bench_people"), make_executor()
        executor.add_node(node)

        def hear_truth(k: int) -> None:
            def take(msg: PoseArray) -> None:
                truth.setdefault(stamp_ns(msg.header), {})[k] = message_to_joints(msg)

            node.create_subscription(PoseArray, topics.true_joints(k + 1), take, topics.WORK_QOS)

        def hear_body(number: int) -> None:
            def take(msg: PoseArray) -> None:
                joints = message_to_joints(msg)
                assert joints is not None
                found.setdefault(stamp_ns(msg.header), {})[number] = joints

            node.create_subscription(PoseArray, topics.body_joints(f"p{number}"), take, topics.WORK_QOS)

        def answered(msg: PoseArray) -> None:
            first[stamp_ns(msg.header)] = (time.time_ns() - stamp_ns(msg.header)) / 1e6

        for k in range(people):
            hear_truth(k)
        for number in range(1, 5):
            hear_body(number)
        node.create_subscription(PoseArray, topics.JOINTS, answered, topics.WORK_QOS)
        with Supervisor(plans, environment, config.processes, lambda line: None) as graph:
            began, end = time.monotonic(), None
            while end is None or time.monotonic() < end:
                graph.poll()
                executor.spin_once(timeout_sec=0.05)
                if end is None and (found or time.monotonic() - began > LONGEST_WAIT_S):
                    end = time.monotonic() + args.live
        node.destroy_node()
        rclpy.try_shutdown()
    score = Score(people)
    begin = min(found or first)
    for stamp in sorted(set(first) & set(truth)):
        if stamp >= begin:
            score.see([truth[stamp].get(k) for k in range(people)], found.get(stamp, {}))
    stamps = sorted(s for s in first if s >= begin)
    rate = (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * 1e-9)
    return score, rate, float(np.median([first[s] for s in stamps]))


def main() -> int:
    """Run, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of each scene")
    parser.add_argument("--rate", type=float, default=10.0, help="frames a second")
    parser.add_argument("--alone", action="store_true", help="fit every frame alone")
    parser.add_argument("--live", type=float, default=0.0, metavar="S", help="also run the graph for so long")
    parser.add_argument("--live-rate", type=float, default=8.0, metavar="HZ", help="images a second of each camera")
    parser.add_argument("--live-width", type=int, default=640, metavar="PX", help="of the images, which are 4:3")
    parser.add_argument("--scene", action="append", help="only scenes with this in their names; may be repeated")
    args = parser.parse_args()
    offline.prepare(print)
    how = "each frame alone" if args.alone else "temporal"
    print(f"{args.cameras} cameras, {args.seconds:g} s at {args.rate:g} Hz, {how}")
    print("| scene | error mm | reliable % | wrong | exchanged | phantoms | ms median | ms mean | rate |")
    print("|---|---|---|---|---|---|---|---|---|")
    single = float("nan")
    for name, people, together, furnished in SCENES:
        if args.scene and not any(part in name for part in args.scene):
            continue
        score, ms, _ = score_scene(people, together, furnished, args)
        single = float(ms.mean()) if name == "one person" else single
        print(
            f"| {name} | {score.text()} | {np.median(ms):.0f} | {ms.mean():.0f} | {single / ms.mean():.2f} |",
            flush=True,
        )
    if args.live:
        print(f"\nlive over DDS, {args.cameras} cameras at {args.live_rate:g} Hz, {args.live:g} s")
        print("| scene | error mm | reliable % | wrong | exchanged | phantoms | answers a second | latency ms |")
        print("|---|---|---|---|---|---|---|---|")
        for people, together in ((1, "apart"), (2, "crossing"), (3, "crossing"), (3, "touching")):
            score, rate, latency = score_live(people, together, args)
            print(f"| {people} {together} | {score.text()} | {rate:.1f} | {latency:.0f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
