# SPDX-License-Identifier: Apache-2.0
"""What is locked is what is asked for: every requirement has a pin within its range, and every pin has hashes."""

import ast
import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


def asked(ros):
    """Requirements of `make setup` with a ROS 2 distribution, the extra dev included; or of `make docs`."""
    (call,) = (n for n in ast.walk(ast.parse((ROOT / "setup.py").read_text())) if getattr(n, "func", None) is not None
               and getattr(n.func, "id", "") == "setup")  # fmt: skip
    values = {k.arg: k.value for k in call.keywords}
    extra = "docs" if ros == "docs" else "dev"
    lines = ast.literal_eval(values["install_requires"]) + ast.literal_eval(values["extras_require"])[extra]
    for name in (f"{ros}.txt", "build.txt") if extra == "dev" else ():
        lines += [line for line in (ROOT / "requirements" / name).read_text().splitlines() if line and line[0] != "#"]
    return [Requirement(line) for line in lines]


def locked(ros):
    """Name -> (version, number of hashes) of every pin; a name may be pinned once for each Python."""
    text = (ROOT / "requirements" / f"{ros}.lock").read_text().replace("\\\n", " ")
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            name, version = re.match(r"([\w.-]+)(?:\[[\w,]+\])?==(\S+)", line).groups()
            yield canonicalize_name(name), version, len(re.findall(r"--hash=sha256:[0-9a-f]{64}\b", line))


@pytest.mark.parametrize(("ros", "least"), [("jazzy", 100), ("kilted", 100), ("docs", 40)])
def test_the_lock_holds_what_is_asked_for(ros, least):
    pins = list(locked(ros))
    assert len(pins) > least
    assert all(hashes for _, _, hashes in pins)
    for requirement in asked(ros):
        versions = [version for name, version, _ in pins if name == canonicalize_name(requirement.name)]
        assert versions, f"{requirement} is not locked: run tools/lock_requirements.sh"
        for version in versions:
            assert requirement.specifier.contains(version), f"{requirement}, but {version} is locked"


def test_setup_installs_by_hash_only():
    script = (ROOT / "tools" / "setup_venv.sh").read_text()
    assert '--require-hashes -r "requirements/$ros.lock"' in script
    assert "--no-deps --no-build-isolation -e ." in script
    assert "--require-hashes -r requirements/docs.lock" in (ROOT / "Makefile").read_text()


def test_what_the_documentation_adds_changes_nothing_that_is_there():
    there = {(name, version) for name, version, _ in locked("jazzy")}
    names = {name for name, _ in there}
    assert {(name, version) for name, version, _ in locked("docs") if name in names} <= there
