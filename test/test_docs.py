# SPDX-License-Identifier: Apache-2.0
"""What the documentation says can be done: its commands parse, its links lead somewhere, its site has every page.

`limbloc` commands are run, too: test_documented_commands.py, test_documented_nodes.py.
"""

import ast
import re
import shlex
from pathlib import Path

import pytest
import yaml
from documented import HELPS, PAGES, ROOT, TEXTS, code_lines, commands, examples, parse

from limbloc_ros import cli
from limbloc_ros.nodes import smart_space


def name_of(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_every_command_line_parses(path):
    for command in commands(path.read_text(encoding="utf-8")):
        parse(command)


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_no_table_is_torn(path):
    """A row below an empty line is text with bars in it, unless it heads a table of its own."""
    lines = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S).splitlines()
    for above, here, below in zip(["", *lines], lines, [*lines[1:], ""], strict=False):
        if here.startswith("|") and not above.startswith("|"):
            assert re.fullmatch(r"\|[-:| ]+\|", below), here


def test_the_documents_do_have_commands():
    found = [command.split()[0] for path in TEXTS for command in commands(path.read_text(encoding="utf-8"))]
    assert len(found) > 50
    assert set(found) >= set(cli.COMMANDS)
    with pytest.raises(AssertionError, match="not a valid command line"):
        parse("export out/walk --format fbx")


def ros2_commands():
    """Command lines of ROS 2's own tools, in code and between backticks."""
    for path in TEXTS:
        text = path.read_text(encoding="utf-8")
        spans = [
            " ".join(span.split()) for span in re.findall(r"`(ros2 [^`]+)`", re.sub(r"```.*?```", "", text, flags=re.S))
        ]
        for line in [*code_lines(text), *spans]:
            if line.startswith(("ros2 ", "rviz2 ")):
                yield name_of(path), line.partition("  #")[0].strip()


#: Programs in the documentation's code. Ours are run or, where that takes minutes or a network, checked here; what
#: installs ROS 2 or sets up a shell is other people's.
PROGRAMS_RUN = {"limbloc", "python", "make", "ros2", "rviz2", ".ci/run"}
PROGRAMS_OF_OTHERS = {"mkdir", "git", "rosdep", "pip", "colcon", "export", "pre-commit"}


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_every_command_is_accounted_for(path):
    text = re.sub(r"```\w+\n.*?```", "", path.read_text(encoding="utf-8"), flags=re.S)  # Python, YAML
    for line in code_lines(text):
        program = re.match(r"(\.?[a-z][\w./-]*) (?! )", line)
        if program and "/" not in program[1].removeprefix(".ci/"):  # not a file, in a list of what there is
            assert program[1] in PROGRAMS_RUN | PROGRAMS_OF_OTHERS, line
    for line in [*code_lines(text), *re.findall(r"`(python [^`]+)`", " ".join(text.split()))]:
        assert not unknown_options(line.partition("  #")[0]), line


@pytest.mark.parametrize("folder", ["benchmarks", "tools"])
def test_what_scripts_say_of_themselves_can_be_given(folder):
    for path in (ROOT / folder).glob("*.py"):
        for line in (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines():
            assert not unknown_options(line.strip().removeprefix("sudo ")), f"{path.name}: {line}"


def unknown_options(line):
    """Options in `python SCRIPT ...` that the script does not have."""
    words = [word.strip("[]") for word in line.split()]
    if words[:1] != ["python"] or "/" not in words[1] or not words[1].endswith(".py"):
        return []
    script = (ROOT / words[1]).read_text(encoding="utf-8")
    if "smart_space import" in script:  # it has the smart space's options, too
        script += Path(smart_space.__file__).read_text(encoding="utf-8")
    return [word for word in words[2:] if word.startswith("--") and f'"{word}"' not in script]


def executables():
    nodes = re.search(r"^NODES = \((.+?)\)", SETUP, re.MULTILINE | re.DOTALL)[1]
    return {"limbloc", "smart_space", *re.findall(r'"(\w+)"', nodes)}


SETUP = (ROOT / "setup.py").read_text(encoding="utf-8")
LAUNCH = ROOT / "launch" / "smart_space.launch.py"
KNOWN_TOPICS = re.compile(r"/(cam0/(mask/compressed|image_raw)|joints|diagnostics|humans/bodies/p\d/joint_angles)$")
SERVICES = {"recapture_background": "std_srvs/srv/Trigger", "freeze_background": "std_srvs/srv/SetBool"}


@pytest.mark.parametrize(("page", "line"), list(ros2_commands()))
def test_what_ros2_is_told_is_there(page, line):
    """ros2, colcon and apt cannot run here: executables, parameters, launch arguments, topics and services exist."""
    words = shlex.split(line)
    if words[0] == "rviz2":
        assert (ROOT / "config" / Path(words[words.index("-d") + 1]).name).is_file()
    elif words[1] == "run":
        assert words[2] == "limbloc_ros"
        assert words[3] in executables()
        for name in re.findall(r"-p ([\w.]+):=", line):
            assert f"{words[3]}.{name}" in parameters(), name
    elif words[1] == "launch":
        assert words[2:4] == ["limbloc_ros", LAUNCH.name]
        for name in re.findall(r"(\w+):=", line):
            assert f'"{name}":' in LAUNCH.read_text(encoding="utf-8"), name
    elif words[1] == "topic":
        assert words[2] in ("hz", "delay", "echo", "list")
        assert words[2] == "list" or KNOWN_TOPICS.match(words[3]), words[3]
    elif words[1] == "service":
        assert SERVICES[words[3].rpartition("/")[2]] == words[4]
        assert re.fullmatch(r"/segmentation_cam\d/\w+", words[3])
        if len(words) > 5 and not words[5].startswith("-"):
            assert set(yaml.safe_load(words[5])) == {"data"}
    elif words[1] == "security":
        assert words[2] in ("create_keystore", "generate_artifacts")
    else:
        assert words[1] in ("param", "bag"), line


def test_optional_parts_that_are_named_exist():
    for path in TEXTS:
        for extra in re.findall(r"limbloc_ros\[(\w+)\]", path.read_text(encoding="utf-8")):
            assert f'"{extra}": [' in SETUP, f"{name_of(path)}: {extra}"


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


@pytest.mark.parametrize("words", HELPS)
def test_the_examples_of_every_help_parse(words):
    found = examples(words)
    assert found, "a help has examples"
    for example in found:
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
