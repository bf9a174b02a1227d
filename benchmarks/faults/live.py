# SPDX-License-Identifier: Apache-2.0
"""The real graph, every node in the process it always has, and what it tells while faults are injected."""

from __future__ import annotations

import dataclasses
import os
import random
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from limbloc_ros.core.pose import JOINT
from limbloc_ros.nodes.graph_plan import config_from_mapping, plan_graph
from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.ros import topics
from limbloc_ros.ros.environment import graph_environment
from limbloc_ros.ros.messages import message_to_joints, stamp_ns, status_values
from limbloc_ros.ros.node_main import make_executor
from limbloc_ros.ros.supervisor import Supervisor
from limbloc_ros.simulation.room import default_rig

from .cameras import Cameras
from .stage import Stage

#: The joints whose error decides whether a pose is right: those of arms and legs.
LIMBS = [JOINT[f"{j}_{s}"] for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR"]
#: A pose with a limb joint further from the truth than this is wrong, m.
WRONG_M = 0.150
#: So many right answers running count as being right again.
STEADY = 5
START_S = 120.0


@dataclasses.dataclass(frozen=True)
class Answer:
    """One message on `joints`.

    Attributes:
        at_s: when it came, monotonic.
        stamp_ns: of its images.
        posed: whether it is a pose; the graph only publishes those it calls reliable.
        error_m: mean and largest distance of the limbs' joints from the truth; NaN without pose, infinite where nobody
            was.
        there: whether a person was in the room.
    """

    at_s: float
    stamp_ns: int
    posed: bool
    error_m: tuple[float, float]
    there: bool

    @property
    def right(self) -> bool:
        """A pose close to the truth, or none when nobody is there."""
        return self.posed and self.error_m[1] <= WRONG_M if self.there else not self.posed

    @property
    def wrong(self) -> bool:
        """A pose published as reliable that is not the truth."""
        return self.posed and self.error_m[1] > WRONG_M


@dataclasses.dataclass(frozen=True)
class Said:
    """A change of an entry on `/diagnostics`; level 0 is fine, 1 a warning, 2 an error."""

    at_s: float
    name: str
    level: int
    message: str


class Live:
    """The graph of `smart_space` on misbehaving cameras; a context manager.

    Args:
        cameras, width, height, rate_hz: of the rig and its images.
        motions: what the person does.
        settings: other values of smart_space.yaml.
        relayed: segmentation in a namespace of its own; its masks go through us, and `mask_loss` of them are lost.
        domain: ROS_DOMAIN_ID; None: as the environment says, or from the process id.

    Attributes:
        stage, cameras: what is filmed, and by whom.
        answers, guests, said: everything heard so far; guests: the poses of a second person.
        lines: the processes' output.
    """

    def __init__(
        self,
        cameras: int = 8,
        width: int = 400,
        height: int = 300,
        rate_hz: float = 5.0,
        motions: tuple[str, ...] = ("t_pose",),
        settings: Mapping[str, Any] | None = None,
        relayed: bool = False,
        domain: int | None = None,
    ) -> None:
        self.rig = default_rig(cameras, width, height)
        self.stage = Stage(self.rig, motions)
        self._rate_hz, self._relayed, self.mask_loss = rate_hz, relayed, 0.0
        self.domain = int(os.environ.get("ROS_DOMAIN_ID") or 1 + os.getpid() % 100) if domain is None else domain
        self._settings = dict(settings or {})
        self.answers: list[Answer] = []
        self.guests: list[Answer] = []
        self.said: list[Said] = []
        self.values: dict[str, dict[str, str]] = {}
        self.lines: list[str] = []
        self.levels: dict[str, tuple[int, str]] = {}

    def __enter__(self) -> Live:
        self._folder = tempfile.TemporaryDirectory(prefix="limbloc_faults_")
        folder = Path(self._folder.name)
        save_rig(self.rig, folder / "rig.yaml")
        values: dict[str, Any] = {
            "source": "cameras",
            "rig": str(folder / "rig.yaml"),
            "network": {"domain_id": self.domain},
            "pose": {"fit": {"temporal": True}},
            **self._settings,
        }
        config = config_from_mapping(values)
        plans = plan_graph(config, folder)
        namespace = "/cameras" if self._relayed else ""
        plans = [dataclasses.replace(p, namespace=namespace) if p.name.startswith("cameras_") else p for p in plans]
        environment = graph_environment(config.network)
        os.environ.update(environment)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self.domain)
        self.node = Node("bench_faults", context=self._context)
        self._executor = make_executor(self._context)
        self._executor.add_node(self.node)
        self.node.create_subscription(PoseArray, topics.JOINTS, self._on_joints, topics.STREAM_QOS)
        self.node.create_subscription(PoseArray, topics.body_joints("p2"), self._on_guest, topics.STREAM_QOS)
        self.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.DIAGNOSTICS_QOS)
        self.cameras = Cameras(self.node, self.stage, self._rate_hz, f"{namespace}/" if namespace else "")
        if self._relayed:
            for name in self.rig.names:
                self._relay(f"{namespace}/{topics.mask_compressed(name)}", topics.mask_compressed(name))
        self.graph = Supervisor(plans, environment, config.processes, self.lines.append)
        self.graph.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.stop()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        self._folder.cleanup()

    def _relay(self, source: str, target: str) -> None:
        publisher = self.node.create_publisher(CompressedImage, target, topics.STREAM_QOS)
        chance = random.Random(source)

        def pass_on(msg: CompressedImage) -> None:
            if chance.random() >= self.mask_loss:
                publisher.publish(msg)

        self.node.create_subscription(CompressedImage, source, pass_on, topics.WORK_QOS)

    def start(self) -> bool:
        """Learn the empty room and let the person come in; whether the graph is right then."""
        deadline = time.monotonic() + START_S
        self.cameras.filming = False
        while not self.cameras.watched and time.monotonic() < deadline:
            self.spin(0.1)
        self.cameras.filming = True
        self.stage.clear()
        # The first start of all compiles the kernels.
        if not self.until(lambda: self.answers and not self.answers[-1].posed and self._learned(), START_S):
            return False
        self.spin(0.5)
        self.stage.enter()
        return self.until_right(START_S)

    def _learned(self) -> bool:
        masks = [v for name, v in self.values.items() if name.endswith(": mask")]
        return len(masks) == len(self.rig.names) and all(v.get("learning") == "False" for v in masks)

    def spin(self, seconds: float) -> None:
        """Film, listen and look after the processes for some time."""
        self.until(lambda: False, seconds)

    def until(self, condition: Callable[[], Any], seconds: float) -> bool:
        """The same until the condition holds; whether it does in time."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if condition():
                return True
            if not self.graph.poll():
                raise RuntimeError("the graph has ended:\n" + "\n".join(self.lines[-20:]))
            self.cameras.tick()
            self._executor.spin_once(timeout_sec=0.01)
        return bool(condition())

    def until_right(self, seconds: float) -> bool:
        """Until STEADY answers running are right."""
        first = len(self.answers)
        return self.until(lambda: steady(self.answers[first:]) is not None, seconds)

    def _on_joints(self, msg: PoseArray) -> None:
        self.answers.append(self._answer(msg, self.cameras.truth))

    def _on_guest(self, msg: PoseArray) -> None:
        self.guests.append(self._answer(msg, self.cameras.guests))

    def _answer(self, msg: PoseArray, truths: Mapping[int, NDArray[np.float64] | None]) -> Answer:
        stamp, joints = stamp_ns(msg.header), message_to_joints(msg)
        truth = truths.get(stamp)
        return Answer(time.monotonic(), stamp, joints is not None, error_of(joints, truth), truth is not None)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            now = int.from_bytes(status.level, "little"), status.message
            self.values[status.name] = status_values(status)
            if self.levels.get(status.name) != now:
                self.levels[status.name] = now
                self.said.append(Said(time.monotonic(), status.name, *now))


def steady(answers: list[Answer]) -> float | None:
    """When the first of STEADY right answers running came, monotonic s; None if there are none."""
    run = 0
    for i, answer in enumerate(answers):
        run = run + 1 if answer.right else 0
        if run == STEADY:
            return answers[i - STEADY + 1].at_s
    return None


def error_of(joints: NDArray[np.float64] | None, truth: NDArray[np.float64] | None) -> tuple[float, float]:
    """Mean and largest distance, m, of the limbs' joints from the truth; as in `Answer`."""
    if joints is None:
        return float("nan"), float("nan")
    if truth is None:
        return float("inf"), float("inf")
    apart = np.linalg.norm(joints - truth, axis=1)[LIMBS]
    return float(apart.mean()), float(apart.max())
