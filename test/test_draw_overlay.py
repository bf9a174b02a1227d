# SPDX-License-Identifier: Apache-2.0
"""tools/draw_overlay.py finds the nearest kept frame that has a pose, and says when there is none."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.rig.rig_file import save_rig

ROOT = Path(__file__).parents[1]
WALK = ROOT / "test" / "data" / "rgb_walk"


@pytest.fixture(scope="module")
def draw():
    spec = importlib.util.spec_from_file_location("draw_overlay", ROOT / "tools" / "draw_overlay.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return lambda folder, frame: tool.draw(folder, frame, flesh=False, close_up=True, width_px=90)


def test_the_nearest_frame_with_a_pose_is_drawn(draw, tmp_path):
    source, kept = open_source(WALK, None, OfflineConfig()), KeptFrames()
    result = process(source, OfflineConfig(), jobs=1, leave_out=6, kept=kept)
    nobody = FrameResult(result.frames[1].stamp_ns, NoPerson("gone"))
    Run((result.frames[0], nobody), {}).save(tmp_path)
    save_rig(source.rig, tmp_path / "rig.yaml")
    kept.save(tmp_path)
    picture, number = draw(tmp_path, 1)
    assert number == 0
    assert picture.shape == (2 * 120 + 6, 4 * 90 + 3 * 6, 3)
    blue = (picture == np.array([232, 181, 87])).all(axis=2)  # the left side of the stick figure
    assert blue.sum() > 20
    Run((nobody, nobody), {}).save(tmp_path)
    with pytest.raises(InputError, match="none of its 2 kept frames has a pose"):
        draw(tmp_path, 0)
