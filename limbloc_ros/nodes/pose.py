# SPDX-License-Identifier: Apache-2.0
"""Hull -> posture of everybody: joints, joint angles, URDF, TF and pictures (paper section 2)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from limbloc_ros.core import parts
from limbloc_ros.core.config import FitConfig, setting
from limbloc_ros.core.errors import ConfigError, NoPerson
from limbloc_ros.core.geodesic import geodesic_map
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.people import Body, People
from limbloc_ros.core.pipeline import PoseEstimator
from limbloc_ros.core.pose import Pose
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.synchroniser import JUMP_S
from limbloc_ros.ros import messages, node_main, topics
from limbloc_ros.ros.backlog import Backlog
from limbloc_ros.ros.body_output import BodiesOutput
from limbloc_ros.ros.cdr import joints_cdr
from limbloc_ros.ros.cloud_messages import cloud_to_hull, surface_to_cloud, warm_up
from limbloc_ros.ros.health import SILENT_S, Health, Meter
from limbloc_ros.ros.messages import NANOSECONDS, OK, WARN, make_status, stamp_ns
from limbloc_ros.ros.parameters import NodeParameters


@dataclass(frozen=True)
class PoseSettings:
    """What only this node needs to know."""

    body_id: str = setting(
        "p1",
        "id of the first person in topics, joints and frames: letters and digits, a letter first; the others count on "
        "from it (p2, p3, ...)",
    )
    world_frame: str = setting("room", "TF frame of the world")
    publish_unreliable: bool = setting(
        False, "publish angles and joints also when the fit should not be acted on", live=True
    )
    publish_tf: str = setting(
        "all", "transforms: of all links, only of the body's root, or none", choices=("all", "root", "none")
    )
    urdf_tolerance_m: float = setting(
        0.03, "a fitted length that changes by more gives a new URDF", unit="m", low=0.0, high=1.0, live=True
    )
    urdf_period_s: float = setting(
        5.0, "but not more often than this, so that viewers need not reload", unit="s", low=0.0, high=3600.0, live=True
    )
    catch_up_s: float = setting(
        2.0,
        "hulls may wait this long, by their stamps, while a figure is searched; then only the newest is fitted",
        unit="s",
        low=0.0,
        high=10.0,
        live=True,
    )
    catch_up_again_s: float = setting(
        0.25,
        "for 10 s after that only so long; then every second is skipped: fewer poses, not later ones",
        unit="s",
        low=0.0,
        high=10.0,
        live=True,
    )


class PoseNode(Node):
    """Fits figures to each hull. Every hull gives one message on `joints`, empty when there is no posture.

    `joints` and `joint_angles` are of the person who has been followed longest (the only one, mostly); everybody has
    topics of their own below `humans/bodies/<id>`.
    """

    def __init__(self, node_name: str = "pose", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        parameters = NodeParameters(self)
        self.settings = parameters.declare(PoseSettings, on_change=self._on_settings)
        self.people = People(parameters.declare(FitConfig, "fit", self._on_fit_config))
        if not re.fullmatch("[A-Za-z][A-Za-z0-9]*", self.settings.body_id):
            raise ConfigError(
                f"parameter body_id: expected letters and digits, a letter first, got {self.settings.body_id!r}"
            )
        self.seen: tuple[Body, ...] = (Body(1, NoPerson("no hull yet")),)
        self.shown: set[int] = set()
        self.last_stamp_ns: int | None = None
        self.meter = Meter()
        # Before there is anything on the graph: who sees `joints` (a stepped replay) takes the node for ready.
        self.get_logger().info("loading the kernels; the first start compiles them, which may take a minute")
        PoseEstimator.warm_up()
        parts.warm_up()
        warm_up()
        self.joints = self.create_publisher(PoseArray, topics.JOINTS, topics.STREAM_QOS)
        self.angles = self.create_publisher(JointState, topics.JOINT_ANGLES, topics.STREAM_QOS)
        self.markers = self.create_publisher(MarkerArray, topics.MARKERS, topics.STREAM_QOS)
        self.surface = self.create_publisher(PointCloud2, topics.SURFACE, topics.STREAM_QOS)
        self.bodies = BodiesOutput(self, self.settings.body_id, self.settings.publish_tf)
        self.health = Health(self, self.describe)
        self.backlog: Backlog[PointCloud2] = Backlog(
            self, self.fit, self.settings.catch_up_s, again_s=self.settings.catch_up_again_s
        )
        self.create_subscription(PointCloud2, topics.HULL, self.on_hull, topics.WORK_QOS)
        self.get_logger().info("ready")

    def on_hull(self, msg: PointCloud2) -> None:
        """One hull: into the backlog."""
        self.backlog.add(stamp_ns(msg.header), msg)

    @property
    def estimator(self) -> PoseEstimator:
        """What fits the first person."""
        return self.people.estimator

    def fit(self, msg: PointCloud2) -> None:
        """Fit figures to one hull, publish everything with the hull's stamp."""
        with self.health.guard("hull"):
            stamp = stamp_ns(msg.header)
            if self.last_stamp_ns is not None and stamp < self.last_stamp_ns - JUMP_S * NANOSECONDS:
                self.people.reset()
                self.bodies.reset()
            self.last_stamp_ns = stamp
            header = messages.make_header(stamp, self.settings.world_frame)
            hull = cloud_to_hull(msg)
            sight = NoPerson("the hull is empty") if hull is None else self.people.look(hull)
            self.seen = self.people.follow(sight, stamp)
            self.publish_poses(header)
            if hull is not None and self.surface.get_subscription_count():
                self.publish_surface(hull, header)
            self.meter.tick(self.health.latency_s(stamp))

    def publish_poses(self, header: Header) -> None:
        """The figures to look at always, numbers to act on only when they are reliable."""
        found = {body.number: body.outcome for body in self.seen if isinstance(body.outcome, Pose)}
        trusted = {n: pose for n, pose in found.items() if pose.reliable or self.settings.publish_unreliable}
        first = trusted.get(self.seen[0].number)
        self.joints.publish(joints_cdr(None if first is None else first.joints, stamp_ns(header), header.frame_id))
        if first is not None:
            self.angles.publish(messages.angles_to_message(first.angles, header))
        self.bodies.publish(trusted, header, self.settings.urdf_tolerance_m, self.settings.urdf_period_s)
        if not found:
            self.markers.publish(messages.no_markers(header))
        elif self.markers.get_subscription_count():
            array = MarkerArray()
            for number in self.shown - set(found):
                array.markers += messages.no_figure(header, self.marker_prefix(number)).markers
            for number, pose in found.items():
                array.markers += messages.figure_to_markers(pose, header, self.marker_prefix(number)).markers
            self.markers.publish(array)
        self.shown = set(found)

    def marker_prefix(self, number: int) -> str:
        """What stands before a person's namespaces in `markers`: nothing for the first."""
        return "" if number == 1 else f"{self.bodies.id_of(number)}/"

    def publish_surface(self, hull: Hull, header: Header) -> None:
        """The pictures of figs. 1 and 4; only computed when somebody looks."""
        surface = extract_surface(hull)
        self.surface.publish(surface_to_cloud(surface, geodesic_map(hull, surface), header))

    def describe(self) -> Sequence[DiagnosticStatus]:
        """Rate, latency, XOR energy and the time of each stage."""
        values: dict[str, Any] = {
            "rate_hz": self.meter.rate_hz,
            "latency_ms": self.meter.latency_ms,
            "hulls": self.meter.count,
            "hulls_skipped": self.backlog.skipped,
            "hulls_waiting": len(self.backlog),
        }
        poses = [body.number for body in self.seen if isinstance(body.outcome, Pose)]
        values["people"] = " ".join(self.bodies.id_of(number) for number in poses)
        level, message = self.judge(self.seen[0].outcome, values)
        if level == OK and self.backlog.behind:
            level, message = WARN, self.backlog.behind
        if self.meter.silence_s > SILENT_S:
            level, message = WARN, f"no hull for {self.meter.silence_s:.0f} s"
        values["tf"] = self.bodies.tf_state
        name = f"{self.get_name()}: posture"
        statuses = [make_status(name, level, message, values, self.bodies.id_of(self.seen[0].number))]
        for body in self.seen[1:]:
            values, body_id = {}, self.bodies.id_of(body.number)
            level, message = self.judge(body.outcome, values)
            statuses.append(make_status(f"{name} of {body_id}", level, message, values, body_id))
        return statuses

    def judge(self, outcome: Pose | NoPerson, values: dict[str, Any]) -> tuple[bytes, str]:
        """Level and message of one person, and the figures behind them into `values`."""
        if isinstance(outcome, NoPerson):
            return OK, f"no person: {outcome.reason}"
        values["xor_energy"] = float(outcome.energy)
        values["reliable"] = outcome.reliable
        values["risk"] = float(outcome.risk)
        values |= {f"{stage}_ms": float(ms) for stage, ms in outcome.stage_ms.items()}
        if outcome.reliable:
            return OK, "tracking"
        told = "" if self.settings.publish_unreliable else ": no joint states are published"
        return WARN, f"the fit is not reliable ({outcome.doubt}){told}"

    def _on_settings(self, settings: PoseSettings) -> None:
        self.settings = settings
        self.backlog.longest_s, self.backlog.again_s = settings.catch_up_s, settings.catch_up_again_s

    def _on_fit_config(self, config: FitConfig) -> None:
        self.people = People(config)


def main() -> int:
    """Run the pose node."""
    return node_main.main(PoseNode)


if __name__ == "__main__":
    raise SystemExit(main())
