# SPDX-License-Identifier: Apache-2.0
"""Starts the processes of a smart space, restarts the ones that die, and leaves none behind.

It is no ROS node itself, so nothing in ROS can take it down. The processes are forked by a server that has imported
what they need (`process_starter`). Every child leads a process group of its own: Ctrl-C in a terminal reaches only us,
and we stop the children in order: interrupt, terminate, kill. A child also ends by itself when we are killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import FrameType
from typing import IO, Any

from limbloc_ros.core.config import setting
from limbloc_ros.ros.exit_codes import ENDED, REFUSED
from limbloc_ros.ros.process_starter import SERVER, ProcessStarter, StartedProcess
from limbloc_ros.ros.shared_memory import remove_abandoned

POLL_S = 0.1
#: A process that has run this long starts with the short delay again when it dies.
SETTLED_S = 30.0
#: Abandoned shared memory that is worth a word at the start.
ABANDONED_MB = 64
#: SROS2 enclaves of the processes lie below this path; see docs/how_to/security.md.
ENCLAVES = "/limbloc"


@dataclass(frozen=True)
class ProcessConfig:
    """How nodes share processes, and how processes are watched."""

    cameras_per_process: int = setting(4, "segmentation nodes in one process", low=1, high=64)
    carving_with_pose: bool = setting(
        False, "carve and fit in one process: cheaper, but masks wait while a figure is fitted"
    )
    restart_delay_s: float = setting(1.0, "before a dead process is started again", unit="s", low=0.0, high=3600.0)
    restart_max_delay_s: float = setting(
        30.0, "the delay doubles up to this while it keeps dying", unit="s", low=0.0, high=3600.0
    )
    interrupt_s: float = setting(8.0, "for a clean end after the interrupt signal", unit="s", low=0.0, high=600.0)
    terminate_s: float = setting(3.0, "after the terminate signal, before it is killed", unit="s", low=0.0, high=600.0)


@dataclass(frozen=True)
class ProcessPlan:
    """One process: a name for people, the nodes in it, and whether its end is the end of the graph."""

    name: str
    namespace: str
    nodes: tuple[Mapping[str, Any], ...]
    ends_graph: bool = False

    @property
    def description(self) -> str:
        """What `limbloc_ros.nodes.composed` takes as its argument."""
        return json.dumps({"namespace": self.namespace, "nodes": list(self.nodes)})


class End(Enum):
    """What the end of a process means."""

    REFUSED = "it cannot run as configured, and neither can the graph"
    OVER = "it has done its work, and the graph with it"
    DONE = "it has done its work; the others go on"
    DIED = "it is to be started again"


def meaning_of(plan: ProcessPlan, code: int) -> End:
    """What it means that a process of this plan has ended with this exit code (or minus the signal)."""
    if code == REFUSED:
        return End.REFUSED
    if code == 0 and plan.ends_graph:
        return End.OVER
    if code == ENDED:
        return End.DONE
    if code == 0 and all(node["kind"] in ("replay", "record") for node in plan.nodes):
        return End.DONE
    return End.DIED


class RestartDelay:
    """How long to wait before one process is started again: twice as long each time, while it keeps dying."""

    def __init__(self, config: ProcessConfig) -> None:
        self._config = config
        self._next_s = config.restart_delay_s

    def after(self, lived_s: float) -> float:
        """The delay, s, when it has died after so long, s."""
        if lived_s >= SETTLED_S:
            self._next_s = self._config.restart_delay_s
        delay = min(self._next_s, self._config.restart_max_delay_s)
        self._next_s = 2.0 * delay
        return delay


class _Child:
    """One process and what we know of its past."""

    def __init__(self, plan: ProcessPlan, config: ProcessConfig) -> None:
        self.plan = plan
        self.delay = RestartDelay(config)
        self.process: StartedProcess | None = None
        self.requested = False
        self.reader: threading.Thread | None = None
        self.started_s = 0.0
        self.restart_at_s: float | None = None
        self.finished = False


class Supervisor:
    """Runs a plan's processes; use it as a context manager, or call `run`.

    Args:
        plans: the processes.
        environment: variables added to this process's environment.
        config: delays and patience.
        say: gets every line of output, the children's with `[name] ` in front.

    Attributes:
        restarts: how often each process has been started again, by name.
        failure: why the graph had to end; empty otherwise.
    """

    def __init__(
        self,
        plans: Sequence[ProcessPlan],
        environment: Mapping[str, str],
        config: ProcessConfig | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.config = config or ProcessConfig()
        self.restarts = {plan.name: 0 for plan in plans}
        self.failure = ""
        self._environment = {**os.environ, **environment}
        self._starter = ProcessStarter(self._environment)
        self._server: subprocess.Popen[str] | None = None
        self._say = say or _print
        self._children = [_Child(plan, self.config) for plan in plans]
        self._stop = threading.Event()
        self._hurry = threading.Event()

    def __enter__(self) -> Supervisor:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of what runs now, by name."""
        self._meet_started(time.monotonic())
        return {c.plan.name: c.process.pid for c in self._children if c.process and c.process.poll() is None}

    @property
    def server_pid(self) -> int | None:
        """Process id of what forks the others; None before the start and after the end."""
        return None if self._starter.server is None else self._starter.server.pid

    def start(self) -> None:
        """Have all processes started, in their order; `poll` sees when they run."""
        if (freed := remove_abandoned()) > ABANDONED_MB << 20:
            self._say(f"removed {freed >> 20} MB of shared memory that killed DDS processes had left")
        try:
            for child in self._children:
                self._request(child)
        except BaseException:
            self.stop()
            raise

    def poll(self) -> bool:
        """Look after the children once: restart what died. False when the graph is over or cannot go on."""
        now = time.monotonic()
        self._meet_started(now)
        for child in self._children:
            if child.restart_at_s is not None and now >= child.restart_at_s:
                child.restart_at_s = None
                self._request(child)
            if child.process is None or child.finished or child.requested or child.restart_at_s is not None:
                continue
            code = child.process.poll()
            if code is not None and not self._died(child, code, now):
                return False
        return True

    def run(self) -> int:
        """Start, watch until Ctrl-C, SIGTERM or the end of the graph, and stop everything.

        A second signal stops without patience.

        Returns:
            exit code: 0, or 1 when a process could not run.
        """
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            self.start()
            while not self._stop.is_set() and self.poll():
                self._stop.wait(POLL_S)
        finally:
            self.stop()
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if self.failure:
            self._say(self.failure)
        return 1 if self.failure else 0

    def stop(self) -> None:
        """End all processes: interrupt, then terminate, then kill. Returns when none is left."""
        for key, process in self._starter.close():
            self._children[key].process = process
        patience = ((signal.SIGINT, self.config.interrupt_s), (signal.SIGTERM, self.config.terminate_s))
        for number, seconds in (*patience, (signal.SIGKILL, 10.0)):
            alive = [(c.plan.name, c.process) for c in self._children if c.process and c.process.group_alive()]
            if not alive:
                break
            if number != signal.SIGINT:
                names = ", ".join(name for name, _ in alive)
                self._say(f"{names} did not end in time; sending {number.name}")
            for _, process in alive:
                process.signal_group(number)
            deadline = time.monotonic() + seconds
            while any(process.group_alive() for _, process in alive) and time.monotonic() < deadline:
                if self._hurry.is_set() and number == signal.SIGINT:
                    break
                time.sleep(0.05)
        for child in self._children:
            if child.process is not None:
                child.process.wait()
            if child.reader is not None:
                child.reader.join()
            child.restart_at_s, child.requested = None, False
        remove_abandoned()  # of what refused its parameters in the middle of its start, or had to be killed

    def _request(self, child: _Child) -> None:
        name = child.plan.name
        ours, theirs = os.pipe()
        child.reader = self._forward(os.fdopen(ours, encoding="utf-8", errors="replace"), name)
        own = enclave_of(name, self._environment)
        try:
            self._starter.request(self._children.index(child), name, child.plan.description, own, theirs)
            child.requested = True
        except OSError as error:
            self._restart_later(child, str(error), time.monotonic())
        finally:
            os.close(theirs)
        if self._starter.server is not None and self._starter.server is not self._server:
            self._server = self._starter.server
            assert self._server.stdout is not None
            self._forward(self._server.stdout, SERVER)

    def _meet_started(self, now: float) -> None:
        """Take over what the server has started since the last time."""
        try:
            for key, process in self._starter.started():
                child = self._children[key]
                if child.process is not None:
                    self.restarts[child.plan.name] += 1
                child.process, child.started_s, child.requested = process, now, False
        except OSError as error:
            for child in self._children:
                if child.requested:
                    child.requested = False
                    self._restart_later(child, str(error), now)

    def _forward(self, lines: IO[str], name: str) -> threading.Thread:
        """Say each line with the name in front, in a thread of its own."""

        def read() -> None:
            with lines:
                for line in lines:
                    self._say(f"[{name}] {line.rstrip()}")

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        return reader

    def _died(self, child: _Child, code: int, now: float) -> bool:
        """A child has ended: plan its restart. False when that ends the graph."""
        name = child.plan.name
        end = meaning_of(child.plan, code)
        if end is End.REFUSED:
            self.failure = f"{name} cannot run as configured; see its message above"
            return False
        if end is End.OVER:
            self._say(f"{name} has ended, and the smart space with it")
            return False
        if end is End.DONE:
            self._say(f"{name} has ended")
            child.finished = True
            return True
        assert child.process is not None
        child.process.signal_group(signal.SIGKILL)  # whatever the dead process may have started
        remove_abandoned()
        self._restart_later(child, _cause(code), now, now - child.started_s)
        return True

    def _restart_later(self, child: _Child, cause: str, now: float, lived_s: float = 0.0) -> None:
        delay = child.delay.after(lived_s)
        child.restart_at_s = now + delay
        self._say(f"{child.plan.name} died ({cause}); starting it again in {delay:g} s")

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if self._stop.is_set():
            self._hurry.set()
        self._stop.set()


def enclave_of(name: str, environment: Mapping[str, str]) -> dict[str, str]:
    """The variable that names a process's keys, for graphs with ROS_SECURITY_ENABLE; who has chosen some keeps them."""
    variable = "ROS_SECURITY_ENCLAVE_OVERRIDE"
    return {} if variable in environment else {variable: f"{ENCLAVES}/{name}"}


def _cause(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _print(line: str) -> None:
    print(line, flush=True)
