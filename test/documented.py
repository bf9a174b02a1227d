# SPDX-License-Identifier: Apache-2.0
"""The command lines that the documentation and the helps show."""

import contextlib
import io
import re
import shlex
from pathlib import Path

from limbloc_ros import cli

ROOT = Path(__file__).parents[1]
PAGES = sorted(ROOT.glob("docs/**/*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PROGRAMS = ("limbloc ", "python -m limbloc_ros ")
#: Commands whose help has examples.
HELPS = [*cli.COMMANDS, *(f"rig {action}" for action in ("import", "export", "calibrate", "check", "plan"))]
#: Commands that start nodes.
NODES = ("demo", "run", "record", "replay")


def code_lines(text):
    """Lines of fenced and indented code, those that end in a backslash joined with the next."""
    lines, fenced, joined = [], False, ""
    for line in text.splitlines():
        if line.strip().startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            joined += line.strip().removesuffix("\\")
            if not line.rstrip().endswith("\\"):
                lines.append(joined)
                joined = ""
    return lines


def commands(text):
    """Command lines of ours in code, without comments (after `#`, or after a wide gap as in help texts)."""
    for line in code_lines(text):
        for program in PROGRAMS:
            said = re.match(r"limbloc \w+: ", line)  # what it prints, not what is typed
            if line.startswith(program) and not said and not re.search(r"\b(ACTION|COMMAND)\b", line):
                yield re.split(r"\s{2,}|\s#", line.removeprefix(program))[0]


def help_of(words):
    """What `limbloc WORDS --help` prints."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        cli.main([*words.split(), "--help"])
    return text.getvalue()


def examples(words):
    """The command lines below `examples:` of a help."""
    lines = help_of(words).partition("examples:")[2].splitlines()
    return list(commands("\n".join(f"    {line}" for line in lines)))


def commands_by_page():
    """Page, or help, -> its command lines."""
    pages = {path.name: list(commands(path.read_text(encoding="utf-8"))) for path in TEXTS}
    return pages | {f"limbloc {words} --help": examples(words) for words in HELPS}


def parse(command):
    """Have the real parser read a command line; it raises SystemExit when it cannot."""
    words = shlex.split(command)
    name = next((word for word in words if not word.startswith("-")), "")
    try:
        return cli._parser(name).parse_args(cli._joined(words))
    except SystemExit as stopped:
        if stopped.code == 0 and "--help" in words:
            return None
        raise AssertionError(f"limbloc {command}: not a valid command line") from None
