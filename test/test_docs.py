# SPDX-License-Identifier: Apache-2.0
"""What the documentation says can be done: its commands parse, its links lead somewhere, its site has every page."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from limbloc_ros import cli

ROOT = Path(__file__).parents[1]
PAGES = sorted(ROOT.glob("docs/**/*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PROGRAMS = ("limbloc ", "python -m limbloc_ros ")


def name_of(path):
    return str(path.relative_to(ROOT))


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
                yield re.split(r"\s{3,}|\s#", line.removeprefix(program))[0]


def parse(command):
    """Have the real parser read a command line; it raises SystemExit when it cannot."""
    words = shlex.split(command)
    name = next((word for word in words if not word.startswith("-")), "")
    try:
        return cli._parser(name).parse_args(words)
    except SystemExit as stopped:
        if stopped.code == 0 and "--help" in words:
            return None
        raise AssertionError(f"limbloc {command}: not a valid command line") from None


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_every_command_line_parses(path):
    for command in commands(path.read_text(encoding="utf-8")):
        parse(command)


def test_the_documents_do_have_commands():
    found = [command.split()[0] for path in TEXTS for command in commands(path.read_text(encoding="utf-8"))]
    assert len(found) > 50
    assert set(found) >= set(cli.COMMANDS)
    with pytest.raises(AssertionError, match="not a valid command line"):
        parse("export out/walk --format fbx")


def parameters():
    """All keys of the smart space file as `section.parameter`, from the generated page."""
    page = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    found = set()
    for section in page.split("\n## ")[1:]:
        name, _, rows = section.partition("\n")
        found |= {f"{name}.{row}" for row in re.findall(r"^\| `([\w.]+)` \|", rows, re.MULTILINE)}
    return found


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_parameters_that_are_named_exist(path):
    known = parameters()
    sections = {name.partition(".")[0] for name in known}
    text = path.read_text(encoding="utf-8")
    named = re.findall(r"--set ([\w.]+)=", text) + re.findall(r"`([\w.]+)(?:=[\w.]+|: \w+)?`", text)
    for name in named:
        if name.partition(".")[0] in sections and name.count(".") and not name.endswith((".py", ".md", ".yaml")):
            assert name in known, f"{name_of(path)}: {name}"


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_examples_of_every_help_parse(command, capsys):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    text = capsys.readouterr().out
    examples = list(commands("\n".join(f"    {line}" for line in text.partition("examples:")[2].splitlines())))
    assert examples, "a help has examples"
    for example in examples:
        parse(example)


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_links_and_pictures_lead_somewhere(path):
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://", target):
            continue
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        assert there.exists(), f"{name_of(path)}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {anchor_of(heading) for heading in headings}, f"{name_of(path)}: {target}"


def anchor_of(heading):
    """The anchor of a heading, as Markdown's table of contents makes it."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


def test_the_site_has_every_page_once():
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = []

    def visit(entry):
        if isinstance(entry, str):
            listed.append(entry)
        else:
            for inner in entry.values() if isinstance(entry, dict) else entry:
                visit(inner)

    visit(site["nav"])
    assert sorted(listed) == sorted(str(page.relative_to(ROOT / "docs")) for page in PAGES)


def test_every_picture_is_shown():
    shown = {match for path in TEXTS for match in re.findall(r"images/([\w.-]+)", path.read_text(encoding="utf-8"))}
    assert {picture.name for picture in (ROOT / "docs" / "images").iterdir()} == shown


def test_scripts_and_make_targets_that_are_named_exist():
    targets = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1].split()
    for path in TEXTS:
        text = path.read_text(encoding="utf-8")
        for script in re.findall(r"python ((?:tools|benchmarks|examples|test)/[\w/]+\.py)", text):
            assert (ROOT / script).is_file(), f"{name_of(path)}: {script}"
        for line in [*code_lines(text), *re.findall(r"`(make [a-z]+)", text)]:
            if line.startswith("make "):
                assert line.split()[1] in targets, f"{name_of(path)}: {line}"


def test_helps_and_examples_are_put_into_the_pages(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import docs_hooks

    page = docs_hooks.on_page_markdown("a\n<!-- help: export -->\n\n<!-- example: slow_down_near_hand -->\n")
    assert "usage: limbloc export" in page
    assert "class SlowDown(Node)" in page
    for path in PAGES:
        for words in docs_hooks.HELP.findall(path.read_text(encoding="utf-8")):
            assert docs_hooks.command_help(words).startswith(f"usage: limbloc {words}")
        for name in docs_hooks.EXAMPLE.findall(path.read_text(encoding="utf-8")):
            assert docs_hooks.example(name).startswith("# SPDX")
