# SPDX-License-Identifier: Apache-2.0
"""Least privilege on a real graph, nothing beyond this machine by default, and no code out of data."""

import ast
import os
import socket
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ET
from fnmatch import fnmatchcase
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
from rclpy.parameter import Parameter

from limbloc_ros import cli
from limbloc_ros.nodes.composed import KINDS, flatten
from limbloc_ros.nodes.foxglove_bridge import FoxgloveBridge
from limbloc_ros.nodes.graph_plan import config_from_mapping, load_config, plan_graph
from limbloc_ros.ros import transforms
from limbloc_ros.ros.body_output import hri_message
from limbloc_ros.ros.environment import NetworkConfig, graph_environment
from limbloc_ros.ros.security import BACKGROUND_SET, OPERATOR, PARAMETERS_SET, policy
from limbloc_ros.ros.supervisor import ENCLAVES

ROOT = Path(__file__).parents[1]
FOLDERS = ("limbloc_ros", "launch", "tools", "examples", "fuzz")

#: Allowed, but not on the graph of the simulated room: message packages that are not installed here, and people who
#: are not there.
SELDOM = {
    *({"/lab/humans/bodies/tracked", "/lab/humans/bodies/*/posture"} if hri_message("IdsList") is None else ()),
    "/lab/true_joints_*",
    *({"/tf", "/tf_static"} if transforms.import_tf_message() is None else ()),
}


@cache
def sources():
    """Every module of ours, parsed."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in paths}


def allowed(text):
    """(node, what) -> expressions, of all profiles of a policy; and enclave -> its nodes."""
    found, enclaves = {}, {}
    for enclave in ET.fromstring(text).iter("enclave"):
        for profile in enclave.iter("profile"):
            enclaves.setdefault(enclave.get("path"), []).append(profile.get("node"))
            for group in profile:
                ((rule, qualifier),) = group.attrib.items()
                assert qualifier == "ALLOW"
                found[profile.get("node"), rule] = {item.text for item in group}
    return found, enclaves


def test_the_policy_is_what_the_running_graph_needs_and_no_more(graph, tmp_path):
    """Every topic and service of every node of a real graph is allowed, and everything allowed is there."""
    config = config_from_mapping(
        {
            "namespace": "/lab",
            "simulated_cameras": {"number_of_cameras": 2, "width": 64, "height": 64, "wait_for_viewers_s": 0.0},
            "record_to": str(tmp_path / "bag"),
            "foxglove": True,
            "foxglove_bridge": {"port": 0},
        }
    )
    plans = plan_graph(config, tmp_path)
    rules, enclaves = allowed(policy(plans))
    assert enclaves == {
        **{f"{ENCLAVES}/{plan.name}": [node["name"] for node in plan.nodes] for plan in plans},
        f"{ENCLAVES}/{OPERATOR}": [OPERATOR],
    }
    nodes = [node for plan in plans for node in plan.nodes]
    assert {node["kind"] for node in nodes} == set(KINDS) - {"replay"}
    for node in nodes:
        make = getattr(import_module(f"limbloc_ros.nodes.{node['kind']}"), KINDS[node["kind"]])
        overrides = [Parameter(key, value=value) for key, value in flatten(node["parameters"]).items()]

        def build(make=make, node=node, overrides=overrides, **options):
            options |= {"namespace": "/lab", "parameter_overrides": overrides}
            return make(node["name"], **options)

        graph.add(build)
    graph.until(lambda: graph.tester.count_publishers("/lab/joints") > 0)
    graph.spin(1.5)  # the recorder and the bridge look for topics now and then
    asked = {
        "publish": graph.tester.get_publisher_names_and_types_by_node,
        "subscribe": graph.tester.get_subscriber_names_and_types_by_node,
        "reply": graph.tester.get_service_names_and_types_by_node,
        "request": graph.tester.get_client_names_and_types_by_node,
    }
    for node in nodes:
        listens = node["kind"] in ("record", "foxglove_bridge")
        for what, ask in asked.items():
            real = {name for name, _ in ask(node["name"], "/lab")}
            rule = rules.get((node["name"], what), set())
            denied = {name for name in real if not any(fnmatchcase(name, pattern) for pattern in rule)}
            assert not denied, f"{node['name']} may not {what} {denied}"
            spare = {pattern for pattern in rule if not any(fnmatchcase(name, pattern) for name in real)} - SELDOM
            # Who records subscribes to what there is, and the bridge only while somebody looks.
            assert not spare or (listens and what == "subscribe"), f"{node['name']} need not {what} {spare}"


def test_only_the_operator_may_change_running_nodes(tmp_path):
    rules, _ = allowed(policy(plan_graph(config_from_mapping({}), tmp_path)))
    changing = (*PARAMETERS_SET, *BACKGROUND_SET)
    for node, what in rules:
        if what == "request":
            assert node == OPERATOR
    asked = rules[OPERATOR, "request"]
    assert {"/segmentation_cam0/freeze_background", "/pose/set_parameters"} <= asked
    offered = set().union(*(names for (_, what), names in rules.items() if what == "reply"))
    assert offered == asked
    assert {name.rpartition("/")[2] for name in offered} >= set(changing)


def test_the_policy_in_the_repository_is_that_of_the_default_graph(tmp_path, capsys):
    assert cli.main(["security", str(ROOT / "config" / "smart_space.yaml"), "--out", str(tmp_path / "p.xml")]) == 0
    assert "5 enclaves below /limbloc" in capsys.readouterr().out
    assert (tmp_path / "p.xml").read_text() == (ROOT / "config" / "sros2" / "policies.xml").read_text()


def test_defaults_stay_on_this_machine(tmp_path):
    """Whatever the shell says, unless the file asks for more."""
    for base in ({}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}):
        assert graph_environment(NetworkConfig(), base)["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    installed = load_config(ROOT / "config" / "smart_space.yaml")
    assert installed.network == NetworkConfig()
    assert installed.foxglove_bridge["host"] == "127.0.0.1"


def udp_sockets(environment):
    """Addresses and ports of the UDP sockets of a process with one ROS node."""
    script = """
        import os, re
        from pathlib import Path
        import rclpy
        from rclpy.node import Node
        rclpy.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        node = Node("lonely")
        fds = [Path("/proc/self/fd", fd) for fd in os.listdir("/proc/self/fd")]
        links = [os.readlink(fd) for fd in fds if fd.is_symlink()]
        own = set(re.findall(r"socket:.(\\d+)", " ".join(links)))
        for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
            if line.split()[9] in own:
                print(line.split()[1])
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], env={**os.environ, **environment},
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    return [
        (socket.inet_ntoa(bytes.fromhex(a)[::-1]), int(p, 16)) for a, p in (x.split(":") for x in done.stdout.split())
    ]


def test_a_process_of_the_smart_space_hears_this_machine_only():
    """Its sockets on DDS's own ports, 7400 to 7400 + 250 * 233, are bound to the loopback interface."""
    environment = {**graph_environment(NetworkConfig(), {}), "ROS_DOMAIN_ID": "101"}
    known = [address for address, port in udp_sockets(environment) if 7000 <= port < 32768]
    assert len(known) >= 2
    assert set(known) == {"127.0.0.1"}
    open_to_all = udp_sockets({**environment, **graph_environment(NetworkConfig(discovery="subnet"), {})})
    assert "0.0.0.0" in {address for address, port in open_to_all if 7000 <= port < 32768}


def listening_addresses(port):
    """Local addresses on which this machine listens on a TCP port, from the kernel's own tables."""
    found = set()
    for table, size in (("/proc/net/tcp", 8), ("/proc/net/tcp6", 32)):
        for line in Path(table).read_text().splitlines()[1:]:
            local, _, state = line.split()[1:4]
            address, _, number = local.partition(":")
            if state == "0A" and int(number, 16) == port:
                raw = bytes.fromhex(address)
                family = socket.AF_INET if size == 8 else socket.AF_INET6
                words = b"".join(raw[i : i + 4][::-1] for i in range(0, len(raw), 4))
                found.add(socket.inet_ntop(family, words))
    return found


def test_the_bridge_listens_on_this_machine_only(graph):
    bridge = graph.add(FoxgloveBridge, port=0)
    assert listening_addresses(bridge.port) == {"127.0.0.1"}


#: Each turns data into code, or text into a command of the shell.
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "commands"}
FORBIDDEN_ATTRIBUTES = {
    ("os", "system"), ("os", "popen"), ("subprocess", "getoutput"), ("subprocess", "getstatusoutput"),
    ("yaml", "unsafe_load"), ("yaml", "full_load"), ("yaml", "UnsafeLoader"), ("yaml", "FullLoader"),
    ("yaml", "safe_load"), ("yaml", "safe_load_all"),
}  # fmt: skip


def code_out_of_data(tree):
    """What in a module turns data into code; our own YAML reader is the only one that may call PyYAML's."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            module = node.module if isinstance(node, ast.ImportFrom) else None
            for name in [module or "", *(alias.name for alias in node.names)]:
                if name.split(".")[0] in FORBIDDEN_MODULES and not (isinstance(node, ast.ImportFrom) and node.level):
                    yield node.lineno, name
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in FORBIDDEN_ATTRIBUTES:
                yield node.lineno, f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id in FORBIDDEN_CALLS:
                yield node.lineno, node.func.id
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            for keyword in node.keywords:
                constant = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
                if keyword.arg == "shell" and constant is not False:
                    yield node.lineno, "shell"
                if keyword.arg == "allow_pickle" and constant is not False:
                    yield node.lineno, "allow_pickle"
            of_numpy = isinstance(node.func, ast.Attribute) and getattr(node.func.value, "id", "") == "np"
            if of_numpy and name == "load" and "allow_pickle" not in [keyword.arg for keyword in node.keywords]:
                yield node.lineno, "np.load"


def test_nothing_makes_code_out_of_data():
    found = [f"{path}:{line}: {what}" for path, tree in sources().items() for line, what in code_out_of_data(tree)]
    assert not found
    assert len(sources()) > 150


@pytest.mark.parametrize(
    "text",
    ["eval('1')", "import pickle", "from pickle import loads", "os.system('ls')", "run('ls', shell=True)",
     "np.load(f)", "np.load(f, allow_pickle=True)", "yaml.unsafe_load(f)", "exec(x)"],
)  # fmt: skip
def test_the_search_finds_what_it_is_for(text):
    assert list(code_out_of_data(ast.parse(text)))


def test_yaml_is_read_in_one_place():
    users = {
        path
        for path, tree in sources().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and (node.value.id, node.attr) in {("yaml", "load"), ("yaml", "load_all"), ("yaml", "parse")}
    }
    assert users == {"limbloc_ros/rig/plain_values.py"}
