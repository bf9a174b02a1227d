# SPDX-License-Identifier: Apache-2.0
"""Every command line of ours in the documentation and the helps is run, page by page, on small recordings.

Two frames stand for a recording, and the pictures of reports and of `view` are put together but not drawn
(test_report.py and test_viewer.py do). A command that was run on another page with the same options and the same kind
of input is not run again. Elsewhere are run: what starts nodes, in test_documented_nodes.py; `rig calibrate`, on
pictures of a board, in test_rig_calibrate.py; `batch --dask`, on a cluster, in test_batch.py.
"""

import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from documented import HELPS, NODES, ROOT, commands_by_page

from limbloc_ros import cli
from limbloc_ros.commands import rig_plan, view
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.results import Run
from limbloc_ros.report import pictures, sections
from limbloc_ros.rig.formats import FORMATS
from limbloc_ros.rig.importing import Wishes, settle
from limbloc_ros.rig.plan import standing_places
from limbloc_ros.rig.rig_file import load_rig, save_rig

DATA = ROOT / "test" / "data"
BALANCE, WALK, RIGS = DATA / "balance", DATA / "rgb_walk", DATA / "rigs"
WAVE = DATA / "benchmark" / "public" / "seq_wave"
BALANCE_SIZES = Wishes(
    sizes={"cam01": (270, 480), "cam02": (270, 480), "cam03": (272, 480), "cam04": (272, 480)}, fit="letterbox"
)
#: Images of WALK with the man that are taken, and what stands for `--leave-out` of all before the last of them.
PERSON, LEAVE_OUT = (8, 10), "15"

PAGES = commands_by_page()
#: Pages about the balance; on all others `rig.yaml`, `videos/` and bags are the walk's.
OF_BALANCE = ("tutorial.md", "own_cameras.md", "limbloc rig --help", "limbloc rig import --help")
#: Options and kind of input of what was run already, in this process.
DONE: set[tuple[str, ...]] = set()


def shape(words):
    """What a command line asks for: subcommand, kind of its input, options."""
    name = " ".join(words[:2]) if words[0] == "rig" else words[0]
    places = [word for word in words if "/" in word and not word.startswith("-")]
    kind = places[0].split("/")[0] if places and name != "report" else ""
    options = {word for word in words if word.startswith("-")} - {"--out"} | {
        words[i + 1] for i, word in enumerate(words) if word in ("--align", "--lengths")
    }
    formats = words[words.index("--format") + 1 :] if "--format" in words else []
    options |= {word for word in formats if word in ("csv", "trc", "c3d", "bvh", "gltf", "ply", "video", *FORMATS)}
    references = [word.rpartition(".")[2] for word in words if word.endswith((".trc", ".npz"))]
    return (name, kind, *sorted(options), *references)


class Lab:
    """A folder in which a page's files are there, under the names that the page gives them."""

    def __init__(self, folder, masters, balance):
        self.folder, self.masters, self.master = folder, masters, masters[balance]

    def provide(self, words):
        """Put there what a command line reads."""
        for before, word in zip(["", *words], words, strict=False):
            name = word.rstrip("/")
            if before != "--out" and re.fullmatch(r"[A-Za-z][\w./*-]*", name) and not (self.folder / name).exists():
                self._provide(name)

    def _provide(self, name):
        folder, master = self.folder, self.master
        first = name.split("/")[0]
        for whole in ("WALK", "BALANCE", "case", "videos", "empty_room", "silhouettes"):
            if first == whole:
                self._link(whole, master / whole)
                return
        if name == "bags/*":
            self._copy(master / "bag", "bags/a")
            self._copy(master / "bag", "bags/b")
        elif first == "bags":
            self._link(name, (self.masters[True] if name == "bags/balance" else master) / "bag")
        elif first == "out":
            self._copy(master / "run", name)
        elif name.startswith("test/data/"):
            self._link(name, master / "case_masks")
        elif name.endswith("room.yaml") or name in ("rig.yaml", "learn8.yaml"):
            self._copy(master / name.replace("room", "rig"), name)
        elif name == "checked.yaml":
            self._copy(master / "rig.yaml", name)
        elif name in ("lab.yaml", "my_room.yaml"):
            self._copy(ROOT / "config" / "smart_space.yaml", name)
        elif name.endswith(".trc"):
            assert cli.main(["export", str(master / "run"), "--format", "trc", "--out", str(folder / name)]) == 0
        elif name.endswith("_system.npz"):
            self._copy(master / "run" / "joints.npz", name)
        elif name == "Calib.qca.txt":
            self._copy(master / name, name)
        elif name in ("Calib.toml", "calibration.toml", "camchain.yaml"):
            there = {"Calib.toml": "pose2sim_Calib_scene.toml", "calibration.toml": "aniposelib_calibration.toml"}
            self._copy(RIGS / there.get(name, "kalibr_camchain.yaml"), name)
        elif name.endswith("ost.yaml") or name == "tf_static.yaml":
            FORMATS["ros"].write(load_rig(WALK / "calib.json"), folder / "ros")
            camera = name.partition("/")[0]
            self._copy(folder / "ros" / (name if name == "tf_static.yaml" else f"{camera}.yaml"), name)

    def _link(self, name, target):
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).symlink_to(target)

    def _copy(self, source, name):
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(source, self.folder / name) if source.is_dir() else shutil.copy(source, self.folder / name)


def make_master(folder, footage_to_bag, *, balance):
    """All that labs are filled from: footage, calibration, a bag of silhouettes, a case, a finished run."""
    whole = BALANCE if balance else WALK
    for name, target in (("WALK", WALK), ("case", WALK)):
        (folder / name).symlink_to(target)
    (folder / "BALANCE").mkdir()
    for part in BALANCE.iterdir():
        (folder / "BALANCE" / part.name).symlink_to(part)
    if balance:
        command = ["rig", "import", str(BALANCE / "calibration/Calib.qca.txt"), "--images", str(BALANCE / "videos")]
        assert cli.main([*command, "--fit", "letterbox", "--out", str(folder / "rig.yaml")]) == 0
        for name, of in (("videos", "videos"), ("empty_room", "background_prepared"),
                         ("silhouettes", "silhouettes_prepared")):  # fmt: skip
            (folder / name).symlink_to(BALANCE / of)
    else:
        save_rig(load_rig(WALK / "calib.json"), folder / "rig.yaml")
        case = load_case(WALK)
        (folder / "empty_room").mkdir()
        for camera in case.rig.names:
            shutil.copy(whole / "rgb" / camera / "0000.jpg", folder / "empty_room" / f"{camera}.jpg")
            for number in range(*PERSON):
                for name in ("videos", "silhouettes"):
                    (folder / name / camera).mkdir(parents=True, exist_ok=True)
                shutil.copy(whole / "rgb" / camera / f"{number:04d}.jpg", folder / "videos" / camera)
                mask = 255 * (case.masks(number - PERSON[0])[camera] > 0).astype(np.uint8)
                footage_to_bag.cv2.imwrite(str(folder / "silhouettes" / camera / f"{number:04d}.png"), mask)
    balanced = settle(FORMATS["qualisys"].read([BALANCE / "calibration/Calib.qca.txt"]), BALANCE_SIZES)[0]
    FORMATS["benchmark"].write(balanced, folder / "BALANCE" / "calib_cam03fix.json")
    (folder / "learn8.yaml").write_text("segmentation: {background: {learning_frames: 8}}\n")
    rig = load_rig(folder / "rig.yaml")
    FORMATS["qualisys"].write(balanced, folder / "Calib.qca.txt")
    # Stamps as a folder's: the run's frames are found in it again.
    footage_to_bag.write_bag(folder / "silhouettes", rig, folder / "bag", masks=True, fps=25.0, start_s=0.0)
    (folder / "case_masks").mkdir()
    for name in ("calib.json", "meta.json"):
        shutil.copy(WAVE / name, folder / "case_masks")
    masks = {name: bits[:2] for name, bits in np.load(WAVE / "masks.npz").items()}
    np.savez_compressed(folder / "case_masks" / "masks.npz", **masks)
    command = ["process", str(folder / "videos"), "--rig", str(folder / "rig.yaml"), "--out", str(folder / "run")]
    assert cli.main([*command, "--background", str(folder / "empty_room"), "--jobs", "1"]) == 0


@pytest.fixture(scope="module")
def masters(tmp_path_factory):
    """The walk's and the balance's."""
    sys.path.insert(0, str(ROOT / "tools"))
    import footage_to_bag

    made = {}
    for balance in (False, True):
        made[balance] = tmp_path_factory.mktemp("balance" if balance else "walk")
        make_master(made[balance], footage_to_bag, balance=balance)
    sys.path.remove(str(ROOT / "tools"))
    return made


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Nothing is drawn, and a plan tries one place: that would take most of the time."""
    monkeypatch.setattr(rig_plan, "standing_places", lambda coverage: standing_places(coverage, 1))
    blank = np.zeros((9, 9, 3), np.uint8)
    monkeypatch.setattr(pictures, "render", lambda *_, **__: blank)
    monkeypatch.setattr(sections, "figure_png", lambda figure: sections.image_png(blank))

    def shown(scene, playback, _):
        assert scene.shapes(playback.number, playback.layers, playback.colour)
        return SimpleNamespace(run=lambda: None)

    for name, stub in (("Window", shown), ("write_picture", shown), ("load_open3d", int), ("require_display", int)):
        monkeypatch.setattr(view, name, stub)


@pytest.mark.parametrize("page", [page for page, lines in PAGES.items() if lines])
def test_the_commands_of_a_page_run(page, masters, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(offline, "usable_cores", lambda: 1)  # here, not in workers that would load everything anew
    lab = Lab(tmp_path, masters, page in OF_BALANCE)
    for command in PAGES[page]:
        words = shlex.split(command)
        if words[0] in NODES or words[:2] == ["rig", "calibrate"] or words[0].startswith("-") or "--dask" in words:
            continue
        if shape(words) in DONE:
            continue
        DONE.add(shape(words))
        lab.provide(words)
        words = [place for word in words for place in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]
        if "--leave-out" in words:
            words[words.index("--leave-out") + 1] = LEAVE_OUT
        if "--last" in words:  # of the two frames of the run
            words[words.index("--first") + 1], words[words.index("--last") + 1] = "0", "1"
        if "--frame" in words:
            words[words.index("--frame") + 1] = "1"
        code = cli.main(words)
        assert code == 0, f"limbloc {command}: {capsys.readouterr().err}"


def test_all_that_runs_without_nodes_was_run():
    """Also a check that the page tests above did not skip what they should not."""
    every = [shlex.split(command) for lines in PAGES.values() for command in lines]
    ran = {shape[0] for shape in DONE}
    assert ran == {words for words in HELPS if words not in (*NODES, "rig", "rig calibrate")}
    assert len(every) > 100
    assert len(DONE) > 35


def test_the_newcomers_five_commands_end_with_a_moving_skeleton(masters, tmp_path, monkeypatch):
    """The tutorial's, on two frames of the real recording: poses near where another system saw the joints."""
    monkeypatch.chdir(tmp_path)
    lab = Lab(tmp_path, masters, True)
    five = [shlex.split(command) for command in PAGES["tutorial.md"] if "balance" in command.lower()][:5]
    assert [words[0] for words in five] == ["rig", "rig", "process", "report", "export"]
    for words in five:
        if words[:2] != ["report", "out/balance"]:
            lab.provide([word for word in words if word.startswith("BALANCE")])
        assert cli.main(words) == 0
    run = Run.load("out/balance")
    assert np.isfinite(run.joints).all()
    bvh = (tmp_path / "out" / "balance" / "export" / "balance.bvh").read_text()
    assert "Frames: 2" in bvh
    assert (tmp_path / "out" / "balance" / "report" / "report.html").is_file()
