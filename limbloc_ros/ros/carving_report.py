# SPDX-License-Identifier: Apache-2.0
"""What the carving node says about its cameras and its hull on `/diagnostics`."""

from __future__ import annotations

import copy
import statistics
import time
from collections import deque
from collections.abc import Mapping, Sequence

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.confidence import CUT_M2
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.images import Pixels
from limbloc_ros.core.synchroniser import FrameSet, StampSynchroniser, SyncCounters
from limbloc_ros.rig.watch import ConsistencyWatch
from limbloc_ros.ros.backlog import Backlog
from limbloc_ros.ros.health import SILENT_S, WINDOW_S, Meter
from limbloc_ros.ros.messages import ERROR, OK, WARN, make_status
from limbloc_ros.ros.stamp_skew import Array, StampSkew
from limbloc_ros.ros.topics import JOINTS

#: A camera that is missing in a larger share of the last seconds' sets is named, with what is known of the cause.
MISSING_SHARE = 0.2
#: Stamps this much older or younger on arrival than the other cameras' are given as the cause, s.
OFF_S = 0.03


class CarvingReport:
    """Keeps the figures of the last seconds.

    Args:
        node: named in every entry; asked for what topics exist.
        topics: mask topic by camera.

    Attributes:
        answered_once: whether some pose node has ever answered a hull.
    """

    def __init__(self, node: Node, topics: Mapping[str, str]) -> None:
        self._node = node
        self._topics = dict(topics)
        self._masks = {camera: Meter() for camera in topics}
        self._seen: dict[str, Pixels] = {}
        self._sets = Meter()
        self._last: FrameSet[Pixels] | None = None
        self._outcome: Hull | NoPerson | None = None
        self._carve_ms = float("nan")
        self._watch: ConsistencyWatch | None = None
        self._compared: FrameSet[Pixels] | None = None
        self._suspect: tuple[str, str] | None = None
        self._past: deque[tuple[float, SyncCounters]] = deque()
        self._missing: deque[tuple[float, tuple[str, ...]]] = deque()
        self._jumps, self._jumped_s = 0, -WINDOW_S
        self._skew = StampSkew()
        self._asked_s: float | None = None
        self.answered_once = False

    def mask(self, camera: str, mask: Pixels, stamp_ns: int, latency_s: float) -> None:
        """A usable mask came."""
        self._masks[camera].tick(latency_s)
        self._skew.mask(camera, stamp_ns)
        self._seen[camera] = mask

    def carved(self, frames: FrameSet[Pixels], outcome: Hull | NoPerson, carve_ms: float, latency_s: float) -> None:
        """A set was carved and its hull published."""
        self._last, self._outcome, self._carve_ms = frames, outcome, carve_ms
        self._sets.tick(latency_s)
        self._skew.carved(frames.stamp_ns, frames.skew_ns)
        self._missing.append((time.monotonic(), frames.missing))
        self._asked_s = self._asked_s or time.monotonic()

    def answered(self, stamp_ns: int, joints: Array | None) -> None:
        """The pose node answered a hull: with a pose (joints [J, 3] m), or with none."""
        self._asked_s, self.answered_once = None, True
        if joints is None:
            self._skew.nobody()
        else:
            self._skew.joints(stamp_ns, joints)

    def statuses(
        self,
        synchroniser: StampSynchroniser[Pixels] | None,
        backlog: Backlog[FrameSet[Pixels]],
        problems: Mapping[str, str],
        rig: Rig | None = None,
    ) -> Sequence[DiagnosticStatus]:
        """One entry for the hull, and one per camera.

        Args:
            synchroniser: None while there is no rig.
            backlog: finished sets that wait to be carved.
            problems: camera -> why the rig lacks it.
            rig: with it, each call also looks whether the cameras agree about the last set.
        """
        self._compare(rig)
        counters = synchroniser.counters if synchroniser else SyncCounters()
        self._look_back(counters)
        return [
            self._hull(synchroniser, counters, backlog, problems),
            *(self._camera(c, counters, problems, bool(backlog.behind)) for c in self._topics),
        ]

    def watch(self, rig: Rig | None) -> ConsistencyWatch | None:
        """What will look whether these cameras agree. To make it takes a moment: better before masks come."""
        if rig is not None and (self._watch is None or self._watch.rig is not rig):
            self._watch = ConsistencyWatch(rig)
        return None if rig is None else self._watch

    def _look_back(self, counters: SyncCounters) -> None:
        """Keep what was counted some seconds ago."""
        now = time.monotonic()
        self._past.append((now, copy.deepcopy(counters)))
        while now - self._past[0][0] > WINDOW_S:
            self._past.popleft()
        while self._missing and now - self._missing[0][0] > WINDOW_S:
            self._missing.popleft()
        if counters.resets != self._jumps:
            self._jumps, self._jumped_s = counters.resets, now

    def _compare(self, rig: Rig | None) -> None:
        """Find out whether a camera has been bumped; a hull that vanished because of one is looked at too."""
        watch = self.watch(rig)
        if watch is None or self._last is None or self._last is self._compared:
            return
        self._compared = self._last
        watch.look(self._last.items)
        self._suspect = watch.suspect()

    def _hull(
        self,
        synchroniser: StampSynchroniser[Pixels] | None,
        counters: SyncCounters,
        backlog: Backlog[FrameSet[Pixels]],
        problems: Mapping[str, str],
    ) -> DiagnosticStatus:
        level, message, voxels = OK, "carving", 0
        used: Sequence[str] = ()
        if isinstance(self._outcome, NoPerson):
            message = f"no person: {self._outcome.reason}"
        elif self._outcome is not None:
            voxels, used = self._outcome.inside_count, self._outcome.cameras
            if said := self._skew.in_words():
                message = f"carving; {said}"
            if self._outcome.cut_area_m2 > CUT_M2:
                level, message = WARN, "somebody stands half outside of the carve volume (volume in the rig file)"
        if time.monotonic() - self._jumped_s < WINDOW_S:
            level, message = (
                WARN,
                "the stamps jumped back in time: started anew (a looped recording, a clock that was set?)",
            )
        if backlog.behind:
            level, message = WARN, backlog.behind
        waited_s = time.monotonic() - self._asked_s if self._asked_s else 0.0
        if self.answered_once and waited_s > SILENT_S:
            level = WARN
            message = f"no poses come: no hull was answered on {JOINTS} for {waited_s:.0f} s; is the pose node down?"
        if synchroniser is None:
            level, message = ERROR, f"no rig yet: {'; '.join(problems.values()) or 'waiting for CameraInfo and TF'}"
        elif self._sets.silence_s > SILENT_S:
            level, message = (
                ERROR,
                f"no set of at least {synchroniser.min_cameras} masks for {self._sets.silence_s:.0f} s",
            )
        values = {
            "rate_hz": self._sets.rate_hz,
            "latency_ms": self._sets.latency_ms,
            "voxels_inside": voxels,
            "carve_ms": self._carve_ms,
            "cameras_used": " ".join(used),
            "skew_ms": self._skew.skew_ms,
            "fastest_joint_m_s": self._skew.speed_m_s,
            "skew_costs_mm": self._skew.costs_mm,
            "sets_complete": counters.complete,
            "sets_incomplete": counters.incomplete,
            "sets_dropped": counters.dropped,
            "sets_skipped": backlog.skipped + counters.skipped,
            "sets_waiting": (synchroniser.waiting if synchroniser else 0) + len(backlog),
            "jumps_back_in_time": counters.resets,
        }
        return make_status(f"{self._node.get_name()}: hull", level, message, values)

    def _camera(
        self, camera: str, counters: SyncCounters, problems: Mapping[str, str], behind: bool
    ) -> DiagnosticStatus:
        meter, level, message = self._masks[camera], OK, "used"
        rejected = self._outcome.rejected if isinstance(self._outcome, Hull) else {}
        seen = self._seen.get(camera)
        if camera in problems:
            level, message = ERROR, f"not in the rig: {problems[camera]}"
        elif meter.silence_s > SILENT_S:
            level, message = ERROR, self._why_silent(camera, meter.silence_s)
        elif not behind and (lost := self._why_lost(camera, counters)):
            level, message = WARN, lost
        elif camera in rejected:
            level, message = WARN, f"not used: {rejected[camera]}"
        elif self._suspect is not None and self._suspect[0] == camera:
            level, message = WARN, self._suspect[1]
        values = {
            "rate_hz": meter.rate_hz,
            "latency_ms": meter.latency_ms,
            "mask_fill_percent": 100.0 * cv2.countNonZero(seen) / seen.size if seen is not None else float("nan"),
            "stamp_behind_ms": self._skew.behind_ms().get(camera, float("nan")),
            "received": counters.received.get(camera, 0),
            "missing": counters.missing.get(camera, 0),
            "late": counters.late.get(camera, 0),
            "duplicate": counters.duplicate.get(camera, 0),
        }
        return make_status(f"{self._node.get_name()}: camera {camera}", level, message, values, camera)

    def _why_lost(self, camera: str, counters: SyncCounters) -> str:
        """Why the camera's masks, which come, are not in the sets of the last seconds; empty when they are."""
        before, sets = self._past[0][1], len(self._missing)
        missing = sum(camera in lost for _, lost in self._missing)
        if sets < 3 or missing <= MISSING_SHARE * sets:
            return ""
        said = f"missing in {min(100.0 * missing / sets, 100.0):.0f} % of the sets of the last seconds"
        if counters.duplicate[camera] - before.duplicate.get(camera, 0) > MISSING_SHARE * sets:
            return f"{said}: it sends the same stamps again and again"
        came = {c: counters.received[c] - before.received.get(c, 0) for c in self._topics}
        usual = statistics.median(came.values())
        if came[camera] < (1 - MISSING_SHARE) * usual:
            return f"{said}: {came[camera]} masks of it came, {usual:.0f} of the other cameras"
        own, others = self._masks[camera], [m for c, m in self._masks.items() if c != camera and m.count]
        older_s = (own.latency_ms - statistics.median(m.latency_ms for m in others)) / 1e3 if others else 0.0
        if abs(older_s) > OFF_S:
            how = "older" if older_s > 0 else "younger"
            return (
                f"{said}: on arrival its stamps are {1e3 * abs(older_s):.0f} ms {how} than the other cameras': it is "
                f"{'late, or ' if older_s > 0 else ''}its clock is off"
            )
        if counters.late[camera] - before.late.get(camera, 0) > MISSING_SHARE * sets:
            return f"{said}: its masks come out of order, or when their set has left"
        return f"{said}: its stamps are not those of the other cameras"

    def _why_silent(self, camera: str, silence_s: float) -> str:
        topic = self._topics[camera]
        publishers = self._node.count_publishers(topic)
        if publishers:
            why = f"{publishers} publisher(s), but no usable mask came"
        else:
            suffix = topic.removeprefix(camera)
            names = [name for name, _ in self._node.get_topic_names_and_types() if name.endswith(suffix)]
            others = [name for name in names if self._node.count_publishers(name)]
            why = f"nobody publishes it; there are {', '.join(sorted(others)) or f'no topics that end in {suffix}'}"
        return f"no mask on {topic} for {silence_s:.0f} s: {why}"
