# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at the worst of times: while LLVM asks Python for a cached kernel."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from limbloc_ros.core import interrupts

# Every look-up of a cached kernel is met by a signal; llvmlite looks them up in a callback that LLVM calls.
LOADING = """
import signal, time
from llvmlite.binding.executionengine import ExecutionEngine
from limbloc_ros.core import interrupts
from limbloc_ros.core.background import warm_up

look_up, met = ExecutionEngine._find_module_ptr, []

def interrupted_look_up(self, address):
    if not met:
        met.append(address)
        signal.raise_signal(signal.{name})
    return look_up(self, address)

ExecutionEngine._find_module_ptr = interrupted_look_up
interrupts.install((signal.{name},))
try:
    warm_up()
    time.sleep(30.0)  # at the latest here
    print("never interrupted")
except KeyboardInterrupt:
    print("interrupted", len(met))
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_while_a_kernel_is_loaded_waits_for_its_end(name):
    done = subprocess.run(
        [sys.executable, "-c", LOADING.format(name=name)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "interrupted 1\n"
    assert done.stderr == ""


def test_elsewhere_a_signal_interrupts_at_once():
    before = signal.getsignal(signal.SIGUSR1)
    try:
        interrupts.install((signal.SIGUSR1,))
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGUSR1)
    finally:
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize("module", ["llvmlite.binding.any", "numba.core.any"])
def test_whatever_a_compiler_calls_back_comes_to_its_end(module):
    back = "def called_back():\n    signal.raise_signal(signal.SIGUSR1)\n    ended.append(True)\n"
    ended = []
    names = {"__name__": module, "signal": signal, "ended": ended}
    exec(compile(back, module, "exec"), names)
    before = signal.getsignal(signal.SIGUSR1)
    try:
        interrupts.install((signal.SIGUSR1,))
        with pytest.raises(KeyboardInterrupt):
            names["called_back"]()
            while True:
                signal.pause()
        assert ended == [True]
    finally:
        signal.signal(signal.SIGUSR1, before)


# What is called back in the middle of loading can lose an exception.
LOSING = """
import signal, sys
from limbloc_ros import cli
from limbloc_ros.recordings import offline

def prepare(say=None):
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        pass

offline.prepare = prepare
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("command", ["process", "batch"])
def test_ctrl_c_while_the_command_line_loads_kernels_is_never_lost(command, tmp_path):
    case = Path(__file__).parent / "data" / "benchmark" / "public" / "seq_wave"
    words = [command, str(case), "--jobs", "1", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", LOSING, *words], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == interrupts.EXIT_CODE
    assert f"\nlimbloc {command}: interrupted before the first frame" in done.stderr
    assert not (tmp_path / "out").exists()
