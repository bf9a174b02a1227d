# SPDX-License-Identifier: Apache-2.0
"""What killed DDS processes leave in shared memory is removed, nothing else. test_smart_space.py kills real ones."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

from limbloc_ros.ros import shared_memory
from limbloc_ros.ros.shared_memory import remove_abandoned


def segment(folder: Path, digit: str, age_s: float = 60.0) -> Path:
    name = folder / f"fastrtps_{16 * digit}"
    name.write_bytes(b"x" * 8192)
    lock = folder / f"{name.name}_el"
    lock.touch()
    os.utime(lock, (time.time() - age_s,) * 2)
    return name


def test_only_segments_whose_process_is_gone_are_removed(tmp_path: Path) -> None:
    dead, alive, young = segment(tmp_path, "a"), segment(tmp_path, "b"), segment(tmp_path, "c", age_s=0.0)
    halves = [tmp_path / f"fastrtps_{16 * 'd'}", tmp_path / f"fastrtps_{16 * 'e'}_el"]  # no lock; no segment
    others = [tmp_path / "fastrtps_port7411", tmp_path / "fastrtps_port7411_el", tmp_path / "sem.mp-aaaa"]
    for file in (*halves, *others):
        file.touch()
        os.utime(file, (1e9, 1e9))
    with (tmp_path / f"{alive.name}_el").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert remove_abandoned(tmp_path) == 8192
    left = {file.name for file in tmp_path.iterdir()}
    expected = [alive, Path(f"{alive}_el"), young, Path(f"{young}_el"), halves[0], *others]
    assert left == {file.name for file in expected}
    assert not dead.exists()
    assert remove_abandoned(tmp_path / "none") == 0


def test_what_others_own_stays_theirs(tmp_path: Path, monkeypatch) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(path)

    theirs = segment(tmp_path, "a")
    monkeypatch.setattr(shared_memory, "_is_locked", refuse)
    assert remove_abandoned(tmp_path) == 0
    assert theirs.exists()
