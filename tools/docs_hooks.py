# SPDX-License-Identifier: Apache-2.0
"""What mkdocs does with our pages: puts the help of a command where a page says `<!-- help: process -->`,
and an example where it says `<!-- example: slow_down_near_hand -->`."""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

from limbloc_ros import cli

EXAMPLES = Path(__file__).parents[1] / "examples"
EXAMPLE = re.compile(r"^<!-- example: (\w+) -->$", re.MULTILINE)
HELP = re.compile(r"^<!-- help: (.+) -->$", re.MULTILINE)


def command_help(words: str) -> str:
    """What `limbloc WORDS --help` prints, 100 columns wide."""
    os.environ["COLUMNS"] = "100"
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        cli.main([*words.split(), "--help"])
    return text.getvalue()


def example(name: str) -> str:
    """The source of an example."""
    return (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Called by mkdocs for each page."""
    markdown = EXAMPLE.sub(lambda match: f"```python\n{example(match[1])}```", markdown)
    return HELP.sub(lambda match: f"```text\n{command_help(match[1])}```", markdown)
