# SPDX-License-Identifier: Apache-2.0
"""`limbloc security`: the SROS2 policy of a smart space."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from limbloc_ros.files import write_text
from limbloc_ros.nodes import smart_space
from limbloc_ros.nodes.graph_plan import plan_graph
from limbloc_ros.ros.security import OPERATOR, policy
from limbloc_ros.ros.supervisor import ENCLAVES

DESCRIPTION = """\
Write the SROS2 policy of a smart space: what each of its nodes may publish, subscribe, offer and call, and nothing
else. It takes the options of `limbloc run`, so that the policy is that of the graph which they start.
"""

EPILOG = """\
examples:
  limbloc security --out policies.xml                        the simulated room
  limbloc security lab.yaml --out policies.xml               your own smart space
  ros2 security create_keystore keys                         then keys and permissions, see docs/how_to/security.md
  ros2 security generate_artifacts -k keys -p policies.xml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    smart_space.add_arguments(parser)
    parser.add_argument("--out", type=Path, default=Path("policies.xml"), help="file to write (default: policies.xml)")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    with tempfile.TemporaryDirectory(prefix="limbloc_") as folder:
        plans = plan_graph(smart_space.config_from_arguments(args), Path(folder))
    write_text(args.out, policy(plans))
    print(f"{args.out}: {len(plans)} enclaves below {ENCLAVES}, and {ENCLAVES}/{OPERATOR} for people")
    return 0
