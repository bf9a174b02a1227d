# SPDX-License-Identifier: Apache-2.0
"""The smart space on two or three machines: discovery, bandwidth, a link that is cut and comes back.

    sudo python benchmarks/bench_network.py [--seconds 8] [--only WORD]

Each machine is a Linux network namespace with an address of its own and an own /dev/shm, and all hang on one bridge, as
on a switch: nothing passes but packets. Simulated cameras and segmentation run on the camera machines, carving and pose
on another; somebody on that one listens. Bytes are counted at the switch's ports. Needs root and `ip`; the namespaces
are removed at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.ros.environment import NetworkConfig, graph_environment
from limbloc_ros.simulation.room import default_rig

SWITCH = "limbloc_switch"
SUBNET = "10.77.0"
PORT = 11811
START_S = 90.0


@dataclass(frozen=True)
class Setup:
    """One arrangement.

    Attributes:
        hosts: two (cameras; work) or three (cameras; cameras; work).
        discovery: multicast, static peers or a discovery server.
        sent: what crosses the network: masks, compressed (JPEG) or raw images.
        cut: the first camera machine's link is cut for a while.
    """

    title: str
    hosts: int
    discovery: str
    sent: str
    cut: bool = False


SETUPS = (
    Setup("two machines, multicast, link cut", 2, "multicast", "masks", True),
    Setup("three machines, multicast, link cut", 3, "multicast", "masks", True),
    Setup("three machines, static peers, link cut", 3, "static peers", "masks", True),
    Setup("three machines, discovery server, link cut", 3, "discovery server", "masks", True),
    Setup("two machines, JPEG images sent", 2, "multicast", "compressed"),
    Setup("two machines, raw images sent", 2, "multicast", "raw"),
)


def ip(*arguments: str, of: str = "") -> str:
    """Run `ip`, in a namespace if one is given."""
    where = ["-n", of] if of else []
    return subprocess.run(["ip", *where, *arguments], check=True, capture_output=True, text=True).stdout


class Network:
    """A switch and machines on it; a context manager that removes them."""

    def __init__(self, hosts: int, multicast: bool) -> None:
        self.names = [f"limbloc_host{n}" for n in range(1, hosts + 1)]
        self.addresses = [f"{SUBNET}.{n}" for n in range(1, hosts + 1)]
        self._multicast = multicast

    def __enter__(self) -> Network:
        self._remove()
        ip("netns", "add", SWITCH)
        ip("link", "add", "bridge", "type", "bridge", of=SWITCH)
        ip("link", "set", "bridge", "up", of=SWITCH)
        for name, address, port in zip(self.names, self.addresses, self.ports, strict=True):
            ip("netns", "add", name)
            ip("link", "add", "eth0", "netns", name, "type", "veth", "peer", "name", port, "netns", SWITCH)
            ip("link", "set", port, "master", "bridge", "up", of=SWITCH)
            if not self._multicast:
                flood = f"/sys/class/net/bridge/brif/{port}/multicast_flood"
                self.run(SWITCH, ["sh", "-c", f"echo 0 > {flood}"]).wait()
            ip("address", "add", f"{address}/24", "dev", "eth0", of=name)
            for link in ("lo", "eth0"):
                ip("link", "set", link, "up", of=name)
            ip("route", "add", "224.0.0.0/4", "dev", "eth0", of=name)
        return self

    def __exit__(self, *_: object) -> None:
        self._remove()

    @property
    def ports(self) -> list[str]:
        """The switch's side of each machine's cable."""
        return [f"port{n}" for n in range(1, len(self.names) + 1)]

    def _remove(self) -> None:
        there = ip("netns", "list").split()
        for name in (*[f"limbloc_host{n}" for n in (1, 2, 3)], SWITCH):
            if name in there:
                ip("netns", "delete", name)

    def run(self, name: str, command: Sequence[str], **options: Any) -> subprocess.Popen[str]:
        """Start a program on a machine."""
        return subprocess.Popen(["ip", "netns", "exec", name, *command], text=True, **options)

    def received(self, port: str) -> int:
        """Bytes that a machine has sent so far, as its port of the switch counts them."""
        found = json.loads(subprocess.check_output(["ip", "-n", SWITCH, "-s", "-j", "link", "show", port]))
        return int(found[0]["stats64"]["rx"]["bytes"])

    def plug(self, port: str, inserted: bool) -> None:
        """Cut a link, or mend it."""
        ip("link", "set", port, "up" if inserted else "down", of=SWITCH)


class Machines:
    """The processes of a setup, one on each machine, and the listener."""

    def __init__(self, network: Network, setup: Setup, folder: Path, cameras: int, rate_hz: float) -> None:
        self.network, self._folder = network, folder
        self.heard: list[dict[str, Any]] = []
        self._processes: list[subprocess.Popen[str]] = []
        rig = default_rig(cameras)
        save_rig(rig, folder / "rig.yaml")
        self.environment = {**os.environ, **self._discovery(setup)}
        if setup.discovery == "discovery server":
            server = ["fast-discovery-server", "-i", "0", "-l", network.addresses[-1], "-p", str(PORT)]
            self._start(network.names[-1], server)
        sources, work = network.names[:-1], network.names[-1]
        start_s = float(int(time.time()) + 20)
        shares = [rig.names[n :: len(sources)] for n in range(len(sources))]
        segmenters = [_segmentation(name, setup.sent) for name in rig.names]
        for host, share in zip(sources, shares, strict=True):
            film = {
                "rig_file": str(folder / "rig.yaml"), "cameras": list(share), "rate_hz": rate_hz, "start_s": start_s,
                "empty_s": 15.0, "motions": ["t_pose"],
                "transport": "compressed" if setup.sent == "compressed" else "raw",
            }  # fmt: skip
            nodes = [{"kind": "simulated_cameras", "name": f"film_{host}", "parameters": film}]
            if setup.sent == "masks":
                nodes += [s for s in segmenters if s["parameters"]["camera"] in share]
            self._compose(host, nodes)
        nodes = [
            {"kind": "carving", "name": "carving", "parameters": {"rig_file": str(folder / "rig.yaml")}},
            {"kind": "pose", "name": "pose", "parameters": {"fit": {"temporal": True}}},
        ]
        self._compose(work, nodes if setup.sent == "masks" else [*segmenters, *nodes])
        listener = self._start(work, [sys.executable, str(Path(__file__).resolve()), "--listen"])
        self._reader = threading.Thread(target=self._read, args=(listener,), daemon=True)
        self._reader.start()

    def _discovery(self, setup: Setup) -> dict[str, str]:
        """What a user would set, and the package's own DDS profile."""
        wanted = graph_environment(NetworkConfig(discovery="environment", domain_id=7), {})
        if setup.discovery == "static peers":
            peers = ";".join(self.network.addresses)
            return wanted | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": peers}
        wanted["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
        if setup.discovery == "discovery server":
            wanted["ROS_DISCOVERY_SERVER"] = f"{self.network.addresses[-1]}:{PORT}"
        return wanted

    def _compose(self, host: str, nodes: list[dict[str, Any]]) -> None:
        self._start(host, [sys.executable, "-m", "limbloc_ros.nodes.composed", json.dumps({"nodes": nodes})])

    def _start(self, host: str, command: list[str]) -> subprocess.Popen[str]:
        # Programs on one machine share memory, and with no other machine.
        shared = self._folder / host
        shared.mkdir(exist_ok=True)
        private = ["sh", "-c", 'mount --bind "$0" /dev/shm && exec "$@"', str(shared), *command]
        listening = command[-1] == "--listen"
        process = self.network.run(
            host,
            private,
            env=self.environment,
            stdout=subprocess.PIPE if listening else subprocess.DEVNULL,
            stderr=None if os.environ.get("VERBOSE") else subprocess.DEVNULL,
        )
        self._processes.append(process)
        return process

    def _read(self, listener: subprocess.Popen[str]) -> None:
        assert listener.stdout is not None
        for line in listener.stdout:
            self.heard.append(json.loads(line) | {"at_s": time.monotonic()})

    def wait(self, condition: Any, seconds: float) -> float | None:
        """Until the condition holds for what was heard last; how long it took, None when it did not."""
        began = time.monotonic()
        while time.monotonic() - began < seconds:
            if self.heard and self.heard[-1]["at_s"] > began and condition(self.heard[-1]):
                return time.monotonic() - began
            time.sleep(0.05)
        return None

    def stop(self) -> None:
        """End them."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _segmentation(camera: str, sent: str) -> dict[str, Any]:
    transport = "compressed" if sent == "compressed" else "raw"
    parameters = {"camera": camera, "reliability": "reliable", "transport": transport}
    return {"kind": "segmentation", "name": f"segmentation_{camera}", "parameters": parameters}


def listen() -> None:
    """On the machine that works: tell every half second what comes out there."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseArray
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    from limbloc_ros.ros import node_main, topics

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("listener")
    poses: list[PoseArray] = []
    bad: dict[str, str] = {}
    used: dict[str, str] = {}

    def on_diagnostics(msg: DiagnosticArray) -> None:
        for status in msg.status:
            bad.pop(status.name, None)
            if status.level > b"\0":
                bad[status.name] = status.message
            used.update({p.key: p.value for p in status.values if p.key == "cameras_used"})

    node.create_subscription(PoseArray, topics.JOINTS, poses.append, topics.STREAM_QOS)
    node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, on_diagnostics, topics.DIAGNOSTICS_QOS)
    executor = node_main.make_executor()
    executor.add_node(node)
    while rclpy.ok():
        until, before = time.monotonic() + 0.5, len(poses)
        while time.monotonic() < until:
            executor.spin_once(timeout_sec=0.02)
        new = poses[before:]
        cameras = len(used.get("cameras_used", "").split())
        report = {"answers": len(new), "poses": sum(bool(p.poses) for p in new), "cameras": cameras, "bad": bad}
        print(json.dumps(report), flush=True)


def measure(setup: Setup, seconds: float, cameras: int, rate_hz: float) -> str:
    """Run a setup; a row of the table."""
    with tempfile.TemporaryDirectory() as folder, Network(setup.hosts, setup.discovery == "multicast") as network:
        machines = Machines(network, setup, Path(folder), cameras, rate_hz)
        try:
            began = time.monotonic()
            ready = machines.wait(lambda h: h["poses"] and h["cameras"] == cameras, START_S)
            if ready is None:
                last = machines.heard[-1] if machines.heard else None
                return f"| {setup.title} | no poses within {START_S:g} s; last heard: {last} | | | | |"
            before, first, since = [network.received(p) for p in network.ports], len(machines.heard), time.monotonic()
            time.sleep(seconds)
            lasted = time.monotonic() - since
            sent = [(network.received(p) - b) / lasted for p, b in zip(network.ports, before, strict=True)]
            heard = machines.heard[first:]
            rate, poses = (sum(h[key] for h in heard) / lasted for key in ("answers", "poses"))
            cut = _cut(machines, cameras) if setup.cut else ("", "")
            per_camera = sum(sent[:-1]) / cameras / rate_hz
            print(f"{setup}: first pose {ready:.1f} s after {began:.0f}, sent {sent}, answers {rate}", file=sys.stderr)
            return (
                f"| {setup.title} | {rate:.1f} / {poses:.1f} | {8e-6 * sum(sent[:-1]):.2f} | {per_camera / 1e3:.1f} | "
                f"{cut[0]} | {cut[1]} |"
            )
        finally:
            machines.stop()


def _cut(machines: Machines, cameras: int, seconds: float = 6.0) -> tuple[str, str]:
    """Pull the first machine's plug for a while: what is said meanwhile, and how long until all are back."""
    network = machines.network
    network.plug(network.ports[0], False)
    time.sleep(seconds)
    last = machines.heard[-1]
    said = next((f"{name}: {text}" for name, text in last["bad"].items() if "carving" in name), "nothing")
    network.plug(network.ports[0], True)
    back = machines.wait(lambda h: h["poses"] and h["cameras"] == cameras, 60.0)
    return f"{said} ({last['poses']} poses in half a second)", "never" if back is None else f"{back:.1f}"


def main() -> int:
    """Run the setups, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="measured for each setup")
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--rate", type=float, default=5.0, help="images a second of each camera")
    parser.add_argument("--only", default="", metavar="WORD", help="only setups whose title has this")
    parser.add_argument("--listen", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.listen:
        listen()
        return 0
    if os.geteuid() != 0:
        parser.error("network namespaces need root")
    rows = [measure(s, args.seconds, args.cameras, args.rate) for s in SETUPS if args.only in s.title]
    print(f"{args.cameras} cameras of 640x480 px at {args.rate:g} Hz")
    print(
        "| setup | answers / poses a second | Mbit/s from the cameras | KB a camera and image | "
        "during the cut | back after s |"
    )
    print("|---|---|---|---|---|---|")
    print("\n".join(rows))
    return 1 if any("no poses" in row or "never" in row for row in rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())
