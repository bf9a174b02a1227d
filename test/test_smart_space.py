# SPDX-License-Identifier: Apache-2.0
"""The smart space's options and its supervisor: real processes, killed and interrupted."""

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Image
from small_bags import write_bag
from std_msgs.msg import Header

from limbloc_ros import cli
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.nodes import composed, process_server, smart_space
from limbloc_ros.nodes.graph_plan import load_config, plan_graph
from limbloc_ros.recordings.bags import BagReader
from limbloc_ros.ros import shared_memory
from limbloc_ros.ros import supervisor as supervising
from limbloc_ros.ros.environment import NetworkConfig, config_file, graph_environment
from limbloc_ros.ros.exit_codes import ENDED, REFUSED
from limbloc_ros.ros.process_starter import ProcessStarter, StartedProcess
from limbloc_ros.ros.supervisor import (
    SETTLED_S,
    End,
    ProcessConfig,
    ProcessPlan,
    RestartDelay,
    Supervisor,
    meaning_of,
)

DOMAIN = 1 + os.getpid() % 100
NETWORK = NetworkConfig(domain_id=DOMAIN)
FAST = ProcessConfig(restart_delay_s=0.2)


def plan(name, *nodes, **kwargs):
    return ProcessPlan(name, "", tuple({"kind": k, "name": n, "parameters": p} for k, n, p in nodes), **kwargs)


def segmentation(camera, **parameters):
    return ("segmentation", f"segmentation_{camera}", {"camera": camera, **parameters})


class Lines(list):
    """Collects what a supervisor says, and waits for some of it."""

    def wait_for(self, supervisor, text, timeout_s=60.0):
        deadline = time.monotonic() + timeout_s
        while not any(text in line for line in self):
            assert supervisor.poll(), "\n".join(self)
            assert time.monotonic() < deadline, "\n".join(self)
            time.sleep(0.05)


def gone(pid):
    """Whether a process has ended (a zombie whose parent is not us has)."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def wait_until(condition, timeout_s=30.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true in time"
        time.sleep(0.05)


# --- the options ---


def test_options_come_on_top_of_the_file(tmp_path):
    parser = argparse.ArgumentParser()
    smart_space.add_arguments(parser)
    arguments = (
        "--source bag --bag run1 --rig lab.yaml --cameras a,b --set pose.fit.engine=paper --set transport=compressed"
    )
    config = smart_space.config_from_arguments(parser.parse_args(arguments.split()))
    assert (config.source, config.bag, config.rig, config.cameras) == ("bag", "run1", "lab.yaml", ("a", "b"))
    assert config.pose["fit"] == {"engine": "paper", "temporal": True}
    assert config.transport == "compressed"
    with pytest.raises(ConfigError, match="expected KEY=VALUE"):
        smart_space.config_from_arguments(parser.parse_args(["--set", "engine"]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--source cameras --rig no.yaml", "no.yaml"),
        ("no.yaml", "no.yaml: expected a smart space file"),
        ("--set engine", "expected KEY=VALUE"),
        ("--set foxglove_bridge=5 --foxglove 9000", "foxglove_bridge.port lies inside of foxglove_bridge, which --set"),
        ("--set foxglove_bridge= --foxglove 9000", "foxglove_bridge.port lies inside of foxglove_bridge, which --set"),
        ("--set pose.fit=3 --set pose.fit.engine=paper", "pose.fit.engine lies inside of fit, which --set made 3"),
        ("--set segmentation_of.cam0=5", "segmentation_of: cam0: expected a section of parameters, got 5"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for program, main in (("limbloc run", lambda a: cli.main(["run", *a])), ("smart_space", smart_space.main)):
        assert main(arguments.split()) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.startswith(f"{program}: ")
        assert error.count("\n") == 1


IMPATIENT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
from limbloc_ros.{module} import main
main({arguments})
"""


@pytest.mark.parametrize(("module", "arguments"), [("nodes.smart_space", []), ("cli", ["run"]), ("cli", ["process"])])
def test_ctrl_c_while_modules_are_imported_ends_quietly(module, arguments):
    script = IMPATIENT.format(module=module, arguments=arguments)
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr) == (-signal.SIGINT, "", "")


# --- composed ---


def test_a_misspelt_parameter_or_kind_is_refused():
    env = {**os.environ, **graph_environment(NETWORK)}
    command = [sys.executable, "-m", "limbloc_ros.nodes.composed"]
    wrong = plan("x", segmentation("cam0", learning_rat=0.5)).description
    result = subprocess.run([*command, wrong], env=env, capture_output=True, text=True, timeout=60)
    assert result.returncode == composed.REFUSED
    assert "segmentation_cam0 has no parameter learning_rat; it has background.close_px" in result.stderr
    with pytest.raises(ConfigError, match=r"kind: expected one of segmentation, .*got 'depth'"):
        composed.build({"nodes": [{"kind": "depth"}]}, [])
    with pytest.raises(ConfigError, match="expected a description with a list of nodes"):
        composed.parse("{node: 1}")


def test_sections_become_dotted_names():
    values = {"camera": "a", "background": {"open_px": 2, "deep": {"x": 1}}, "motions": [], "cameras": ("a",)}
    assert composed.flatten(values) == {
        "camera": "a",
        "background.open_px": 2,
        "background.deep.x": 1,
        "cameras": ["a"],
    }


# --- the supervisor ---


@pytest.fixture
def observer(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = Node("observer", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def shared_memory_of(pid):
    """The segments that a process has made: it holds their locks."""
    files = [file.resolve() for file in Path(f"/proc/{pid}/fd").iterdir()]
    return [Path(str(file).removesuffix("_el")) for file in files if re.fullmatch(r"fastrtps_\w{16}_el", file.name)]


def test_a_killed_process_is_started_again_and_works(observer, monkeypatch):
    monkeypatch.setattr(shared_memory, "YOUNG_S", 0.0)
    lines = Lines()
    plans = [plan("cameras_1", segmentation("cam0"), segmentation("cam1")), plan("cameras_2", segmentation("cam2"))]
    with Supervisor(plans, graph_environment(NETWORK), FAST, lines.append) as supervisor:
        names = {"segmentation_cam0", "segmentation_cam1", "segmentation_cam2"}
        wait_until(lambda: supervisor.poll() and names <= set(observer.get_node_names()))
        before = supervisor.pids
        dead, alive = shared_memory_of(before["cameras_1"]), shared_memory_of(before["cameras_2"])
        assert dead
        assert alive
        os.kill(before["cameras_1"], signal.SIGKILL)
        lines.wait_for(supervisor, "cameras_1 died (SIGKILL); starting it again in 0.2 s")
        wait_until(lambda: supervisor.poll() and supervisor.restarts["cameras_1"] == 1)
        assert not any(segment.exists() for segment in dead)
        assert all(segment.exists() for segment in alive)
        after = supervisor.pids
        assert after["cameras_1"] != before["cameras_1"]
        assert after["cameras_2"] == before["cameras_2"]
        # The new process does its work.
        publisher = observer.create_publisher(Image, "cam0/image_raw", 5)
        wait_until(lambda: supervisor.poll() and publisher.get_subscription_count() >= 1)
    assert supervisor.pids == {}
    assert all(gone(pid) for pid in (*before.values(), *after.values()))


def test_what_the_server_forks_outlives_it_and_a_new_one_is_started(observer):
    lines = Lines()
    plans = [plan("cameras_1", segmentation("cam0")), plan("cameras_2", segmentation("cam1"))]
    with Supervisor(plans, graph_environment(NETWORK), FAST, lines.append) as supervisor:
        wait_until(lambda: supervisor.poll() and len(supervisor.pids) == 2)
        before = supervisor.pids
        me = psutil.Process()
        assert {psutil.Process(pid).ppid() for pid in before.values()} == {me.pid}
        server = psutil.Process(supervisor.server_pid)
        assert {Path(f"/proc/{pid}/comm").read_text().strip() for pid in before.values()} == set(before)
        assert server.num_threads() == 1
        server.kill()
        os.kill(before["cameras_1"], signal.SIGKILL)
        wait_until(lambda: supervisor.poll() and supervisor.restarts["cameras_1"] == 1)
        assert supervisor.pids["cameras_2"] == before["cameras_2"]
        wait_until(lambda: {"segmentation_cam0", "segmentation_cam1"} <= set(observer.get_node_names()))


def test_a_start_that_compiles_says_so(monkeypatch, capsys):
    monkeypatch.setattr(process_server, "PATIENCE_S", 0.05)
    monkeypatch.setattr(process_server, "resolve_name", lambda name: lambda: time.sleep(0.2))
    handler = signal.signal(signal.SIGALRM, process_server.explain)
    try:
        process_server.prepare(plan("pose", ("pose", "pose", {})).description)
    finally:
        signal.signal(signal.SIGALRM, handler)
    assert "compiles" in capsys.readouterr().out


def test_the_delay_grows_while_a_process_keeps_dying():
    lines = Lines()
    # A process that cannot even read its description dies with Python's exit code 1 each time.
    broken = plan("broken", ("segmentation", "a/b c", {"camera": "cam0"}))
    config = ProcessConfig(restart_delay_s=0.1, restart_max_delay_s=0.3)
    with Supervisor([broken], graph_environment(NETWORK), config, lines.append) as supervisor:
        lines.wait_for(supervisor, "starting it again in 0.3 s")
    delays = [line.rsplit(" in ", 1)[1] for line in lines if "starting it again" in line]
    assert delays[:3] == ["0.1 s", "0.2 s", "0.3 s"]
    assert any(line.startswith("[broken] ") for line in lines)


def test_a_recorder_that_dies_goes_on_in_the_next_folder_and_one_without_disk_ends_alone(tmp_path):
    """It used to find its own folder, refuse, and take the whole graph along; so did a full disk."""
    overrides = {"record_to": str(tmp_path / "bag"), "simulated_cameras": {"number_of_cameras": 2}}
    lines, config = Lines(), load_config(config_file("smart_space.yaml"), overrides)
    plans = [plan for plan in plan_graph(config, tmp_path) if plan.name == "record"]
    with Supervisor(plans, graph_environment(NETWORK), FAST, lines.append) as supervisor:
        lines.wait_for(supervisor, f"recording to {tmp_path / 'bag'}")
        os.kill(supervisor.pids["record"], signal.SIGKILL)
        lines.wait_for(supervisor, f"recording to {tmp_path / 'bag_2'}")
    assert supervisor.failure == ""
    for code, end in ((ENDED, End.DONE), (0, End.DONE), (REFUSED, End.REFUSED), (-9, End.DIED), (1, End.DIED)):
        assert meaning_of(plans[0], code) is end
    with pytest.raises(ConfigError, match=r"record_to: .*bag exists already"):
        smart_space.run(config)


def test_a_process_may_keep_dying_for_days():
    delay = RestartDelay(ProcessConfig())
    assert [delay.after(5.0) for _ in range(7)] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert {delay.after(0.0) for _ in range(3000)} == {30.0}
    assert delay.after(SETTLED_S) == 1.0
    never = RestartDelay(ProcessConfig(restart_delay_s=0.0))
    assert {never.after(0.0) for _ in range(3000)} == {0.0}


def test_a_wrong_parameter_ends_the_graph_with_its_message():
    lines = Lines()
    plans = [plan("good", segmentation("cam0")), plan("bad", segmentation("cam1", background={"open_px": 99}))]
    supervisor = Supervisor(plans, graph_environment(NETWORK), FAST, lines.append)
    assert supervisor.run() == 1
    assert "bad cannot run as configured" in supervisor.failure
    assert any("open_px" in line for line in lines)
    assert supervisor.pids == {}


def test_the_end_of_a_replay_ends_the_graph(tmp_path):
    write_bag(tmp_path / "bag", "/{}/mask", "sensor_msgs/msg/Image", Image(header=Header(frame_id="x")))
    lines = Lines()
    replay = ("replay", "replay", {"bag": str(tmp_path / "bag"), "wait_for_subscribers_s": 0})
    plans = [plan("replay", replay, ends_graph=True), plan("cameras_1", segmentation("cam0"))]
    assert Supervisor(plans, graph_environment(NETWORK), FAST, lines.append).run() == 0
    assert any("replayed 3 messages" in line for line in lines)
    assert "replay has ended, and the smart space with it" in lines


STUBBORN = """
import signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
import subprocess
subprocess.Popen(["sleep", "60"])
print("stubborn", flush=True)
time.sleep(60)
"""


class StubbornStarter(ProcessStarter):
    """Starts a process that ignores signals instead of the requested one."""

    def request(self, key, name, description, variables, output):
        actions = [(os.POSIX_SPAWN_DUP2, output, 1)]
        command = [sys.executable, "-c", STUBBORN]
        pid = os.posix_spawn(sys.executable, command, os.environ, file_actions=actions, setpgroup=0)
        self.waiting = [(key, StartedProcess(pid))]

    def started(self):
        found, self.waiting = self.waiting, []
        return found


def test_a_process_that_ignores_signals_is_killed_with_its_children(monkeypatch):
    lines = Lines()
    config = ProcessConfig(interrupt_s=0.3, terminate_s=0.3)
    monkeypatch.setattr(supervising, "ProcessStarter", StubbornStarter)
    supervisor = Supervisor([plan("stubborn", segmentation("cam0"))], {}, config, lines.append)
    supervisor.start()
    lines.wait_for(supervisor, "stubborn")
    pid = supervisor.pids["stubborn"]
    wait_until(lambda: len(psutil.Process(pid).children()) == 1)
    (grandchild,) = psutil.Process(pid).children()
    supervisor.stop()
    assert gone(pid)
    wait_until(lambda: gone(grandchild.pid))
    assert [line for line in lines if "sending SIGTERM" in line] and [
        line for line in lines if "sending SIGKILL" in line
    ]


def start_smart_space(tmp_path):
    """The real program, with the graph of a camera that nobody runs: segmentation only needs no rig."""
    script = f"""
import sys
from limbloc_ros.ros.environment import NetworkConfig, graph_environment
from limbloc_ros.ros.process_starter import ProcessStarter, StartedProcess
from limbloc_ros.ros.supervisor import ProcessPlan, Supervisor
def process(i):
    node = {{"kind": "segmentation", "name": f"segmentation_{{i}}", "parameters": {{"camera": f"cam{{i}}"}}}}
    return ProcessPlan(f"cameras_{{i}}", "", (node,))
sys.exit(Supervisor([process(1), process(2)], graph_environment(NetworkConfig(domain_id={DOMAIN}))).run())
"""
    log = (tmp_path / "log").open("w")
    process = subprocess.Popen([sys.executable, "-c", script], stdout=log, stderr=subprocess.STDOUT)
    log.close()
    return process


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_however_it_ends(tmp_path, observer, how):
    process = start_smart_space(tmp_path)
    try:
        names = {"segmentation_1", "segmentation_2"}
        wait_until(lambda: names <= set(observer.get_node_names()), 60.0)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        process.send_signal(how)
        code = process.wait(timeout=30)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    assert code == (-signal.SIGKILL if how == signal.SIGKILL else 0), (tmp_path / "log").read_text()
    wait_until(lambda: all(gone(child.pid) for child in children))
    log = (tmp_path / "log").read_text()
    assert "Traceback" not in log
    assert "did not end in time" not in log


def test_the_simulated_room_runs_under_the_supervisor_and_can_be_recorded(tmp_path):
    """Simulated cameras -> segmentation -> record: real images through real processes, into a bag that reads well."""
    config = load_config(
        config_file("smart_space.yaml"),
        {
            "record_to": str(tmp_path / "bag"),
            "simulated_cameras": {"number_of_cameras": 2, "width": 160, "height": 120},
            "processes": {"cameras_per_process": 1},
            "network": {"domain_id": DOMAIN},
        },
    )
    plans = [p for p in plan_graph(config, tmp_path) if p.name not in ("carving", "pose")]
    assert [p.name for p in plans] == ["simulated", "cameras_1", "cameras_2", "record"]
    lines = Lines()
    with Supervisor(plans, graph_environment(config.network), FAST, lines.append) as supervisor:
        for topic in ("/true_joints", "/cam0/mask/compressed", "/cam1/mask/compressed"):
            lines.wait_for(supervisor, f"recording {topic}")
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            assert supervisor.poll()
            time.sleep(0.1)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.damage == ""
        counts = {name: topic.count for name, topic in bag.topics.items()}
        for camera in ("cam0", "cam1"):
            assert counts[f"/{camera}/mask/compressed"] >= 5
            assert counts[f"/{camera}/image_raw"] >= 5
        assert counts["/true_joints"] >= 5
    assert any("recorded" in line and "messages" in line for line in lines)
    assert Path(tmp_path / "rig.yaml").exists()
