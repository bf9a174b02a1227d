# SPDX-License-Identifier: Apache-2.0
"""The short part of `make fuzz`: its seeds, inputs that once failed, and any plain values and headers (hypothesis)."""

import dataclasses
import os
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fuzz.message_targets
import fuzz.recording_targets  # noqa: F401  (they enter their targets)
from fuzz.inputs import npy_with_shape, packed_npz
from fuzz.targets import CORPUS, TARGETS, check
from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig, from_mapping
from limbloc_ros.core.errors import ConfigError, InputError, RigError
from limbloc_ros.recordings._bag_salvage import SalvagedSqlite
from limbloc_ros.recordings.npz_file import MOST_BYTES, read_npz
from limbloc_ros.rig.plain_values import json_values, yaml_values
from limbloc_ros.rig.rig_file import rig_from_mapping

#: Seeds from which no good result can come: they hold odd values on purpose.
ODD_SEEDS = {"camera_info", "config", "export", "image", "node_parameters"}

once_failed = sorted(CORPUS.glob("*/*"))


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_read(name):
    refused = [check(name, seed) for seed in TARGETS[name].seeds()]
    assert name in ODD_SEEDS or not all(refused), refused


@pytest.mark.parametrize("path", once_failed, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_once_failed_is_refused_or_read(path):
    check(path.parent.name, path.read_bytes())


def test_the_corpus_is_small():
    assert once_failed
    assert {path.parent.name for path in once_failed} <= set(TARGETS)
    assert sum(path.stat().st_size for path in once_failed) < 1_000_000


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
RIG_KEYS = ("version", "units", "volume", "cameras", "name", "width", "height", "K", "T_world_camera", "ignore")


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.dictionaries(st.sampled_from(RIG_KEYS), plain), plain, st.sampled_from(RIG_KEYS))
def test_any_plain_values_are_a_rig_or_a_rig_error(values, camera, key):
    good = {"name": "a", "width": 64, "height": 48, "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]],
            "T_world_camera": np.eye(4).tolist()}  # fmt: skip
    for data in (values, {"version": 1, "cameras": [{**good, key: camera}]}, {"version": 1, "cameras": [camera]}):
        try:
            rig = rig_from_mapping(data)
        except RigError:
            continue
        assert np.isfinite(rig.volume_max).all()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.sampled_from((BackgroundConfig, HullConfig, SyncConfig, FitConfig)), st.data())
def test_any_plain_values_are_parameters_or_a_config_error(kind, data):
    names = [f.name for f in dataclasses.fields(kind)]
    values = data.draw(st.dictionaries(st.sampled_from(names), plain, max_size=3))
    try:
        made = from_mapping(kind, values)
    except ConfigError:
        return
    for field in dataclasses.fields(kind):
        value = getattr(made, field.name)
        assert not isinstance(value, float) or field.metadata["low"] <= value <= field.metadata["high"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 5000, "sections within each other"),
        ("&a [*a]", "holds itself"),
        ("a: &a [" + "x," * 9 + "]\n" + "".join(
            f"{chr(98 + i)}: &{chr(98 + i)} [" + f"*{chr(97 + i)}," * 9 + "]\n" for i in range(9)), "anchors"),
        ("a: &a {" + ",".join(f"k{i}: 1" for i in range(9)) + "}\n" + "".join(
            f"{chr(98 + i)}: &{chr(98 + i)} {{<<: [" + ",".join([f"*{chr(97 + i)}"] * 9) + "]}\n" for i in range(9)),
         "merged"),
        ("!!python/object/apply:os.system [true]", "could not determine a constructor"),
        ("a: 2001-99-99", "month must be"),
        ("a: " + "1" * 5000, "digits"),
        ("x" * 1_000_001, "at most 1000000 characters"),
    ],
    ids=["deep", "cycle", "anchors", "merged", "object", "date", "digits", "long"],
)  # fmt: skip
def test_dangerous_yaml_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        yaml_values(text)


def test_anchors_of_people_are_read():
    assert yaml_values("a: &x {k: 1}\nb: {<<: *x, m: 2}\nc: [*x, *x]")["b"] == {"k": 1, "m": 2}


@pytest.mark.parametrize("text", ["[" * 100_000, "1" * 5000, "[1,", ""])
def test_dangerous_json_is_refused(text):
    with pytest.raises(ValueError, match="not valid JSON"):
        json_values(text)


def limited(script: str, *arguments: object) -> str:
    """The output of a script that may take 300 MB more than it has after its imports."""
    head = """
        import resource, sys
        from pathlib import Path
        from limbloc_ros.core.errors import LimblocError
        from limbloc_ros.recordings import cases, npz_file
        from limbloc_ros.recordings.bags import BagReader, deserialise
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 300_000_000,) * 2)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(head) + textwrap.dedent(script), *map(str, arguments)],
        capture_output=True, text=True, timeout=60, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


READ_ARCHIVE = """
try:
    npz_file.read_npz(Path(sys.argv[1]))
except LimblocError as error:
    print(error)
"""


def test_an_archive_that_claims_a_billion_numbers_takes_no_memory(tmp_path):
    path = tmp_path / "lie.npz"
    with zipfile.ZipFile(path, "w") as archive:
        np.save(tmp_path / "a.npy", np.zeros(4))
        raw = (tmp_path / "a.npy").read_bytes()
        archive.writestr("a.npy", npy_with_shape(raw, "(1000000000,)"))
    said = limited(READ_ARCHIVE, path)
    assert "its header claims [1000000000] float64, but 32 bytes are there" in said


def test_an_archive_whose_directory_claims_more_than_the_file_takes_no_memory():
    said = limited(READ_ARCHIVE, CORPUS / "background" / "MemoryError_84ef17")
    assert "its directory claims" in said


def test_a_database_that_claims_more_than_sqlite_can_hold_is_refused(tmp_path, monkeypatch):
    def connect(_):
        raise MemoryError  # as sqlite3 does when a damaged list of tables claims to be that large

    monkeypatch.setattr(SalvagedSqlite, "_connect", connect)
    with pytest.raises(InputError, match="its list of topics cannot be read"):
        SalvagedSqlite(tmp_path / "bag.db3")


def test_a_bag_whose_record_claims_a_gigabyte_takes_no_memory():
    said = limited(
        """
        import shutil, tempfile
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag.mcap"
            shutil.copy(sys.argv[1], path)
            with BagReader(path) as bag:
                print(bag.damage)
        """,
        CORPUS / "bag_mcap" / "length_of_1_GB",
    )
    assert "breaks off within the chunk" in said


def test_a_zip_bomb_is_refused_before_it_unpacks(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    path.write_bytes(packed_npz(a=np.zeros(1_000_000)))
    assert path.stat().st_size < 10_000
    assert read_npz(path)["a"].shape == (1_000_000,)
    monkeypatch.setattr("limbloc_ros.recordings.npz_file.MOST_BYTES", 1_000_000)
    with pytest.raises(InputError, match=r"would unpack to 8000128 bytes; expected at most 1000000"):
        read_npz(path)
    assert MOST_BYTES == 4 * 2**30


def test_arrays_come_back_as_numpy_reads_them(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(3, 4)), "b": np.asfortranarray(rng.normal(size=(2, 3, 4))), "c": np.array(["x", "joint"]),
        "d": np.zeros((0, 3)), "e": np.array(3), "f": rng.integers(0, 2, 5).astype(bool), "g": np.array([], dtype=str),
    }  # fmt: skip
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **arrays)
    found = read_npz(path)
    with np.load(path, allow_pickle=False) as expected:
        assert list(found) == expected.files
        for name in expected.files:
            np.testing.assert_array_equal(found[name], expected[name], strict=True)
            assert found[name].flags.writeable


def test_pickled_objects_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="holds object; expected numbers or texts"):
        read_npz(tmp_path / "a.npz")
