# SPDX-License-Identifier: Apache-2.0
"""What goes wrong in a live room, one scenario each: how the fault begins, how long it lasts, how it ends."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from .cameras import Shot, Tamper
from .live import Live
from .stage import PACE, Image, at, lying

Act = Callable[[Live], None]


@dataclass(frozen=True)
class Scenario:
    """A fault.

    Attributes:
        title: for the table.
        begin, end: called when it begins and ends. Without `end` it stays, and being right is awaited from its begin.
        lasts_s: from begin to end.
        patience_s: how long being right again is awaited.
        graph: which graph it needs: `plain`, or `relay`, where masks go through us.
    """

    name: str
    title: str
    begin: Act
    end: Act | None
    lasts_s: float = 8.0
    patience_s: float = 30.0
    graph: str = "plain"


VICTIM = "cam2"
HALF = ("cam0", "cam2", "cam4", "cam6")


def tamper(make: Callable[[], Tamper], *cameras: str) -> Act:
    """Begin: these cameras' images go through a tamper of their own each; no camera: all."""

    def begin(live: Live) -> None:
        for camera in cameras or live.rig.names:
            live.cameras.tampers[camera] = make()

    return begin


def mend(live: Live) -> None:
    """End: the cameras are honest again."""
    live.cameras.tampers.clear()
    live.cameras.shift_s = 0.0
    live.stage.light = None


# --- what a camera does to its images ---


def nothing() -> Tamper:
    """It is dead."""
    return lambda shot: ()


def frozen(same_stamp: bool) -> Callable[[], Tamper]:
    """It sends its last image for ever, with its old stamp or with new ones."""

    def make() -> Tamper:
        kept: list[Shot] = []

        def send(shot: Shot) -> Iterable[Shot]:
            if not kept:
                kept.append(shot)
            stamp = kept[0].stamp_ns if same_stamp else shot.stamp_ns
            return (dataclasses.replace(kept[0], stamp_ns=stamp, due_s=shot.due_s),)

        return send

    return make


def every_second() -> Tamper:
    """Half the rate."""
    count = [0]

    def send(shot: Shot) -> Iterable[Shot]:
        count[0] += 1
        return (shot,) if count[0] % 2 else ()

    return send


def filled(level: int) -> Callable[[], Tamper]:
    """It sees one brightness only: a covered lens, or one that is blinded."""
    return lambda: lambda shot: (dataclasses.replace(shot, pixels=np.full_like(shot.pixels, level)),)


def late(seconds: float) -> Callable[[], Tamper]:
    """Its images take this long."""
    return lambda: lambda shot: (dataclasses.replace(shot, due_s=shot.due_s + seconds),)


def out_of_order() -> Tamper:
    """Every two images change places."""
    kept: list[Shot] = []

    def send(shot: Shot) -> Iterable[Shot]:
        if not kept:
            kept.append(shot)
            return ()
        return shot, dataclasses.replace(kept.pop(), due_s=shot.due_s)

    return send


def twice() -> Tamper:
    """Every image comes twice."""
    return lambda shot: (shot, shot)


def clock_off(seconds: float) -> Callable[[], Tamper]:
    """Its clock is wrong."""
    return lambda: lambda shot: (dataclasses.replace(shot, stamp_ns=shot.stamp_ns + round(seconds * 1e9)),)


def half_size() -> Tamper:
    """It came back with another resolution."""
    return lambda shot: (dataclasses.replace(shot, pixels=np.ascontiguousarray(shot.pixels[::2, ::2])),)


def shifted(px: int) -> Callable[[], Tamper]:
    """Somebody bumped into it: it looks aside by so many pixels."""
    return lambda: lambda shot: (dataclasses.replace(shot, pixels=np.roll(shot.pixels, px, axis=1)),)


def noisy() -> Tamper:
    """Its picture breaks up in stripes now and then, as over a bad cable."""
    rng = np.random.default_rng(5)

    def send(shot: Shot) -> Iterable[Shot]:
        pixels = shot.pixels.copy()
        for row in rng.integers(0, len(pixels) - 30, 4):
            pixels[row : row + 30] = np.roll(pixels[row : row + 30], int(rng.integers(40, 200)), axis=1)
        return (dataclasses.replace(shot, pixels=pixels),)

    return send


def lamp(image: Image) -> Image:
    """A second lamp: brighter, warmer, and more so on one side."""
    width = image.shape[1]
    across = np.linspace(1.25, 1.6, width, dtype=np.float32)[None, :, None]
    colour = np.array([0.92, 1.0, 1.08], dtype=np.float32)
    return np.asarray(np.clip(image * across * colour, 0, 255).astype(np.uint8))


def dusk(image: Image) -> Image:
    """The light goes off: what comes through the window stays."""
    return np.asarray(cv2.convertScaleAbs(image, alpha=0.35))


# --- what people do ---


def swap(live: Live) -> None:
    """Two cameras' plugs are exchanged."""
    a, b = "cam1", "cam4"
    last: dict[str, Shot] = {}

    def give(own: str, other: str) -> Tamper:
        def send(shot: Shot) -> Iterable[Shot]:
            last[own] = shot
            return (dataclasses.replace(last[other], camera=own, stamp_ns=shot.stamp_ns),) if other in last else ()

        return send

    live.cameras.tampers[a], live.cameras.tampers[b] = give(a, b), give(b, a)


def light(how: Callable[[Image], Image] | None) -> Act:
    """The light changes for all cameras."""

    def act(live: Live) -> None:
        live.stage.light = how

    return act


def chair(live: Live) -> None:
    """A chair is put beside the person."""
    live.stage.chair = (0.75, 0.75)


def chair_alone(live: Live) -> None:
    """The person goes, a chair stays."""
    live.stage.clear()
    live.stage.chair = (0.3, 0.2)


def no_chair(live: Live) -> None:
    """The chair is taken away; the person is there."""
    live.stage.chair = None
    live.stage.enter()


def leave(live: Live) -> None:
    """The person goes."""
    live.stage.leave()


def come_in(live: Live) -> None:
    """And comes in again."""
    live.stage.come_in()


def guest(pace: float) -> Act:
    """A second person comes in, or goes (a negative pace)."""

    def act(live: Live) -> None:
        live.stage.guest_pace = pace

    return act


def pose_as(posture: Callable[..., object] | None, box: bool = False) -> Act:
    """The person lies down, or goes somewhere, or takes something."""

    def act(live: Live) -> None:
        live.stage.posture = posture  # type: ignore[assignment]
        live.stage.box = box

    return act


# --- what happens to processes ---


def kill(process: str) -> Act:
    """kill -9."""
    return lambda live: os.kill(live.graph.pids[process], signal.SIGKILL)


def stop(process: str) -> Act:
    """The process gets no CPU at all."""
    return lambda live: os.kill(live.graph.pids[process], signal.SIGSTOP)


def go_on(process: str) -> Act:
    """It gets CPU again."""
    return lambda live: os.kill(live.graph.pids[process], signal.SIGCONT)


_BUSY: list[subprocess.Popen[bytes]] = []


def starve(live: Live) -> None:
    """Other programs take the CPU: three for every core."""
    for _ in range(3 * (os.cpu_count() or 1)):
        _BUSY.append(subprocess.Popen([sys.executable, "-c", "while True: pass"]))


def feed(live: Live) -> None:
    """They end."""
    while _BUSY:
        process = _BUSY.pop()
        process.kill()
        process.wait()


def shift(seconds: float) -> Act:
    """All stamps jump."""

    def act(live: Live) -> None:
        live.cameras.shift_s = seconds

    return act


def lose(share: float) -> Act:
    """So many masks are lost on their way."""

    def act(live: Live) -> None:
        live.mask_loss = share

    return act


def idle(live: Live) -> None:
    """Nothing happens."""


SCENARIOS = (
    Scenario("none", "nothing (what the figures below compare with)", idle, idle, 15.0),
    Scenario("camera_stops", "a camera stops and returns", tamper(nothing, VICTIM), mend),
    Scenario("four_stop", "four of eight cameras stop and return", tamper(nothing, *HALF), mend),
    Scenario("freeze_stamp", "a camera freezes, same stamp", tamper(frozen(True), VICTIM), mend),
    Scenario("freeze_image", "a camera freezes, new stamps", tamper(frozen(False), VICTIM), mend, 10.0),
    Scenario("half_rate", "a camera at half the rate", tamper(every_second, VICTIM), mend),
    Scenario("black", "a camera sends black images", tamper(filled(0), VICTIM), mend),
    Scenario("white", "a camera sends white images", tamper(filled(255), VICTIM), mend),
    Scenario("all_black", "all cameras send black images", tamper(filled(0)), mend),
    Scenario("stripes", "a camera's picture breaks up", tamper(noisy, VICTIM), mend),
    Scenario("late", "a camera is 0.5 s late", tamper(late(0.5), VICTIM), mend),
    Scenario("out_of_order", "a camera's images out of order", tamper(out_of_order, VICTIM), mend),
    Scenario("twice", "every image twice", tamper(twice), mend),
    Scenario("clock_off", "a camera's clock off by 70 ms", tamper(clock_off(0.07), VICTIM), mend),
    Scenario("back_in_time", "time jumps back by 60 s (a looped bag)", shift(-60.0), None, 10.0),
    Scenario("forth_in_time", "time jumps forth by 60 s", shift(60.0), None, 10.0),
    Scenario("wrong_size", "a camera returns with another size", tamper(half_size, VICTIM), mend),
    Scenario("swapped", "two cameras swapped, and back", swap, mend, 15.0, 40.0),
    Scenario("bumped", "a camera bumped aside, and back", tamper(shifted(30), VICTIM), mend, 12.0, 40.0),
    Scenario("lights_on", "a lamp switched on, it stays on", light(lamp), None, 20.0, 60.0),
    Scenario("lights_off", "all lights off, and on again", light(dusk), mend, 12.0, 60.0),
    Scenario("chair", "a chair moved in beside the person", chair, no_chair, 12.0),
    Scenario("chair_alone", "the person goes, a chair stays", chair_alone, no_chair, 12.0),
    Scenario("leaves", "the person leaves, the room is empty, he returns", leave, come_in, 20.0),
    Scenario("guest", "a second person comes in, stays, and goes", guest(PACE), guest(-PACE), 20.0),
    Scenario("half_out", "half out of the carve volume", pose_as(at(1.45, 0.2)), pose_as(None), 8.0),
    Scenario("lies", "lies on the floor, gets up", pose_as(lying), pose_as(None), 8.0),
    Scenario("box", "carries a box, puts it away", pose_as(None, True), pose_as(None), 8.0),
    Scenario("kill_cameras", "kill -9 of a segmentation process (4 cameras)", kill("cameras_1"), idle, 1.5),
    Scenario("kill_carving", "kill -9 of carving", kill("carving"), idle, 1.5),
    Scenario("kill_pose", "kill -9 of pose", kill("pose"), idle, 1.5),
    Scenario("stop_cameras", "a segmentation process stopped for 4 s", stop("cameras_1"), go_on("cameras_1"), 4.0),
    Scenario("stop_carving", "carving stopped for 4 s", stop("carving"), go_on("carving"), 4.0),
    Scenario("stop_pose", "pose stopped for 4 s", stop("pose"), go_on("pose"), 4.0),
    Scenario("starved", "three busy programs for every core", starve, feed, 12.0),
    Scenario("lossy", "30 % of the masks lost", lose(0.3), lose(0.0), 10.0, graph="relay"),
    Scenario("cut", "the link to the masks cut for 5 s", lose(1.0), lose(0.0), 5.0, graph="relay"),
)  # fmt: skip
