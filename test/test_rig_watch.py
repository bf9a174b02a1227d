# SPDX-License-Identifier: Apache-2.0
"""The live watch: a bumped camera is named on /diagnostics, and ragged masks alone are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from scipy.spatial.transform import Rotation

from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.synchroniser import FrameSet
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.rig.watch import FEWEST, ConsistencyWatch
from limbloc_ros.ros.carving_report import CarvingReport

DATA = Path(__file__).parent / "data" / "benchmark"
NOISY = DATA / "public_noisy" / "noisy_p_man_avg"


def bumped(rig, name, degrees):
    T = rig.camera(name).T_world_camera.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    return replace(rig, cameras=tuple(replace(c, T_world_camera=T) if c.name == name else c for c in rig.cameras))


@pytest.mark.parametrize("folder", ["public/poses_p_man_avg", "public_noisy/noisy_p_man_avg"])
def test_a_bumped_camera_is_suspected_and_a_good_rig_is_not(folder):
    case = load_case(DATA / folder)
    good, bad = ConsistencyWatch(case.rig), ConsistencyWatch(bumped(case.rig, "cam2", 2.5))
    for i in range(6):
        assert bad.suspect() is None or i >= FEWEST
        for watch in (good, bad):
            watch.look(case.masks(i))
    assert good.suspect() is None
    name, text = bad.suspect()
    assert name == "cam2"
    assert "was it bumped?" in text


def test_an_empty_room_says_nothing():
    case = load_case(NOISY)
    watch = ConsistencyWatch(case.rig)
    for _ in range(8):
        watch.look({name: np.zeros_like(mask) for name, mask in case.masks(0).items()})
    assert watch.scores is None
    assert watch.suspect() is None


class Node:
    """What the report asks of its node."""

    def get_name(self):
        return "carving"

    def count_publishers(self, topic):
        return 1


class NothingWaits:
    """A backlog without work."""

    behind, skipped = "", 0

    def __len__(self):
        return 0


def test_diagnostics_name_the_camera():
    case = load_case(NOISY)
    rig = bumped(case.rig, "cam2", 3.0)
    report = CarvingReport(Node(), {name: f"/{name}/mask" for name in rig.names})
    for i in range(FEWEST + 1):
        masks = case.masks(i)
        for name, mask in masks.items():
            report.mask(name, mask, i, 0.0)
        report.carved(FrameSet(i, masks, (), 0), NoPerson("too small"), 1.0, 0.0)
        statuses = report.statuses(None, NothingWaits(), {}, rig)
    levels = {status.name: status.level for status in statuses if ": camera " in status.name}
    warned = [name for name, level in levels.items() if level == DiagnosticStatus.WARN]
    assert warned == ["carving: camera cam2"]
