# SPDX-License-Identifier: Apache-2.0
"""docs/parameters.md is what the settings classes say, and the settings classes name everything that is needed."""

import dataclasses
import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[1]


def load_tool():
    spec = importlib.util.spec_from_file_location("make_parameter_docs", ROOT / "tools" / "make_parameter_docs.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def test_the_page_is_up_to_date():
    tool = load_tool()
    assert tool.PAGE.read_text(encoding="utf-8") == tool.page(), "run python tools/make_parameter_docs.py"


def test_every_parameter_is_described_and_its_default_within_bounds():
    for section, prefix, kind in load_tool().SECTIONS:
        for field in dataclasses.fields(kind):
            if dataclasses.is_dataclass(getattr(kind(), field.name)):
                continue
            name, info = f"{section}.{prefix}{field.name}", field.metadata
            assert info.get("description"), name
            if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
                assert info["low"] <= field.default <= info["high"], name
            if info["choices"]:
                assert field.default in info["choices"], name
