# SPDX-License-Identifier: Apache-2.0
"""rosbag2 in and out: the same bytes back, and what is left of killed, cut and full recordings."""

import os
import resource
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import yaml

from limbloc_ros.core.errors import InputError, OutputError
from limbloc_ros.recordings.bags import TYPESTORE, BagReader, BagWriter, deserialise, is_bag
from limbloc_ros.recordings.image_sets import find_cameras

STORAGES = ["mcap", "sqlite3"]
SUFFIX = {"mcap": ".mcap", "sqlite3": ".db3"}
IMAGE = "sensor_msgs/msg/Image"
TEXT = "std_msgs/msg/String"


def image_cdr(k, side=64):
    """A mono8 Image whose pixels tell which one it is."""
    types = TYPESTORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](k // 30, k % 30 * 33_000_000), "cam0")
    pixels = ((np.arange(side * side) * 7 + k) % 256).astype(np.uint8)
    return bytes(TYPESTORE.serialize_cdr(types[IMAGE](header, side, side, "mono8", 0, side, pixels), IMAGE))


def text_cdr(text):
    return bytes(TYPESTORE.serialize_cdr(TYPESTORE.types[TEXT](text), TEXT))


def write_bag(path, storage, count=40, side=64):
    written = []
    with BagWriter(path, storage) as bag:
        bag.add_topic("/cam0/mask", IMAGE)
        bag.add_topic("/urdf", TEXT, latched=True)
        bag.add_topic("/cam0/image_raw", IMAGE, reliable=False)
        for k in range(count):
            topic = "/urdf" if k == 5 else ("/cam0/mask", "/cam0/image_raw")[k % 2]
            cdr = text_cdr("<robot/>") if k == 5 else image_cdr(k, side)
            bag.write(topic, 1_000 + 10 * k, cdr)
            written.append((topic, 1_000 + 10 * k, cdr))
    return written


def data_file(path):
    (file,) = [f for f in Path(path).iterdir() if f.suffix in SUFFIX.values()]
    return file


@pytest.mark.parametrize("storage", STORAGES)
def test_what_is_written_comes_back_byte_for_byte(tmp_path, storage):
    written = write_bag(tmp_path / "bag", storage)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.damage == ""
        assert list(bag.messages()) == written
        assert {t.name: t.count for t in bag.topics.values()} == {"/cam0/mask": 20, "/urdf": 1, "/cam0/image_raw": 19}
        assert bag.message_count == 40
        assert (bag.start_ns, bag.end_ns) == (1_000, 1_390)
        assert (bag.topics["/urdf"].latched, bag.topics["/cam0/mask"].latched) == (True, False)
        assert (bag.topics["/cam0/mask"].reliable, bag.topics["/cam0/image_raw"].reliable) == (True, False)
        part = list(bag.messages(["/cam0/mask"], start_ns=1_100, stop_ns=1_200))
        assert part == [m for m in written if m[0] == "/cam0/mask" and 1_100 <= m[1] < 1_200]
        assert len(part) == 5
    assert not list((tmp_path / "bag").glob("*-wal"))


@pytest.mark.parametrize("storage", STORAGES)
def test_metadata_is_what_jazzy_expects(tmp_path, storage):
    write_bag(tmp_path / "bag", storage)
    info = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert info["version"] == 9
    assert info["storage_identifier"] == storage
    assert info["relative_file_paths"] == ["bag" + SUFFIX[storage]]
    topics = {t["topic_metadata"]["name"]: t["topic_metadata"] for t in info["topics_with_message_count"]}
    assert topics["/urdf"]["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert topics["/cam0/image_raw"]["offered_qos_profiles"][0]["reliability"] == "best_effort"
    assert topics["/cam0/mask"]["type_description_hash"].startswith("RIHS01_")


@pytest.mark.parametrize("storage", STORAGES)
def test_a_single_file_is_a_bag_too(tmp_path, storage):
    written = write_bag(tmp_path / "bag", storage)
    with BagReader(data_file(tmp_path / "bag")) as bag:
        assert list(bag.messages()) == written


@pytest.mark.parametrize("storage", STORAGES)
def test_missing_metadata_is_reported_and_nothing_lost(tmp_path, storage):
    written = write_bag(tmp_path / "bag", storage)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with BagReader(tmp_path / "bag") as bag:
        assert list(bag.messages()) == written
        assert "metadata.yaml is missing" in bag.damage
        assert bag.topics["/urdf"].latched


@pytest.mark.parametrize("with_metadata", [True, False])
@pytest.mark.parametrize("storage", STORAGES)
def test_a_cut_file_gives_everything_up_to_the_cut(tmp_path, storage, with_metadata):
    written = write_bag(tmp_path / "bag", storage, count=200, side=160)
    if not with_metadata:
        (tmp_path / "bag" / "metadata.yaml").unlink()
    file = data_file(tmp_path / "bag")
    size = file.stat().st_size
    os.truncate(file, size * 6 // 10)
    with BagReader(tmp_path / "bag") as bag:
        found = list(bag.messages())
        assert 110 <= len(found) <= 120
        assert found == written[: len(found)]
        assert file.name in bag.damage
        assert bag.message_count == len(found)
        assert bag.end_ns == found[-1].stamp_ns


def test_a_cut_inside_a_compressed_chunk_loses_only_that_chunk(tmp_path):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    rng = np.random.default_rng(0)
    written = []
    with writer:
        connection = writer.add_connection("/text", TEXT, typestore=TYPESTORE)
        for k in range(60):
            cdr = text_cdr(rng.bytes(50_000).hex())  # 100 KB, barely compressible below 50 KB: chunks of 11
            writer.write(connection, k, cdr)
            written.append(("/text", k, cdr))
    file = data_file(tmp_path / "bag")
    os.truncate(file, file.stat().st_size // 2)
    with BagReader(tmp_path / "bag") as bag:
        found = list(bag.messages())
        assert found == written[: len(found)]
        assert 15 <= len(found) <= 30
        assert "breaks off" in bag.damage


@pytest.mark.parametrize("storage", STORAGES)
def test_kill_9_costs_at_most_what_was_not_flushed(tmp_path, storage):
    script = textwrap.dedent(
        f"""
        import os, signal, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_bags import BagWriter, IMAGE, image_cdr
        bag = BagWriter({str(tmp_path / "bag")!r}, {storage!r}, flush_s=1e9)
        bag.add_topic("/cam0/mask", IMAGE)
        for k in range(50):
            bag.write("/cam0/mask", k, image_cdr(k))
            if k == 29:
                bag.flush()
        os.kill(os.getpid(), signal.SIGKILL)
        """
    )
    child = subprocess.run([sys.executable, "-c", script], check=False)
    assert child.returncode == -signal.SIGKILL
    with BagReader(tmp_path / "bag") as bag:
        found = list(bag.messages())
        assert len(found) >= 30
        assert found == [("/cam0/mask", k, image_cdr(k)) for k in range(len(found))]
        assert "metadata.yaml is missing" in bag.damage


@pytest.mark.parametrize("storage", STORAGES)
def test_too_little_disk_closes_the_bag_well(tmp_path, storage):
    bag = BagWriter(tmp_path / "bag", storage, min_free_bytes=2**62, flush_s=1e9)
    bag.add_topic("/cam0/mask", IMAGE)
    for k in range(10):
        bag.write("/cam0/mask", k, image_cdr(k))
    with pytest.raises(OutputError, match=r"MB of disk are left.*complete up to here \(10 messages\)"):
        bag.flush()
    assert bag.closed
    with BagReader(tmp_path / "bag") as again:
        assert again.damage == ""
        assert len(list(again.messages())) == 10


@pytest.mark.parametrize("storage", STORAGES)
def test_a_failing_disk_is_reported_and_what_came_before_is_kept(tmp_path, storage):
    """A file size limit makes the operating system refuse to write, as a full disk does."""
    script = textwrap.dedent(
        f"""
        import resource, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_bags import BagWriter, IMAGE, OutputError, image_cdr
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, {resource.RLIM_INFINITY}))
        bag = BagWriter({str(tmp_path / "bag")!r}, {storage!r}, flush_s=0.0)
        bag.add_topic("/cam0/mask", IMAGE)
        try:
            for k in range(1000):
                bag.write("/cam0/mask", k, image_cdr(k))
        except OutputError as error:
            print(k, bag.closed, error)
        """
    )
    child = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=True)
    count, closed, message = child.stdout.split(maxsplit=2)
    assert closed == "True"
    assert "can be read" in message
    with BagReader(tmp_path / "bag") as bag:
        found = list(bag.messages())
        # Nothing of the last flush may be missing; the one that failed may be there in part.
        assert int(count) - 1 <= len(found) <= int(count) + 1
        assert found == [("/cam0/mask", k, image_cdr(k)) for k in range(len(found))]
        assert len(found) > 15


def test_a_damaged_chunk_in_the_middle_ends_the_reading_and_is_reported(tmp_path):
    written = write_bag(tmp_path / "bag", "sqlite3", count=200, side=160)
    file = data_file(tmp_path / "bag")
    data = bytearray(file.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200_000] = bytes(200_000)
    file.write_bytes(data)
    with BagReader(tmp_path / "bag") as bag:
        found = list(bag.messages())
    assert set(found) <= set(written)
    assert len(found) >= 90
    assert bag.damage


def test_what_is_no_bag_is_refused_with_advice(tmp_path):
    with pytest.raises(InputError, match="there is nothing"):
        BagReader(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected a rosbag2 folder \(metadata.yaml"):
        BagReader(tmp_path / "empty")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"ROS 1 bag.*rosbags-convert"):
        BagReader(tmp_path / "old.bag")
    (tmp_path / "text.mcap").write_text("not a bag at all" * 10)
    with pytest.raises(InputError, match="does not begin like one"):
        BagReader(tmp_path / "text.mcap")
    (tmp_path / "text.db3").write_text("not a bag at all" * 10)
    with pytest.raises(InputError, match="list of topics cannot be read"):
        BagReader(tmp_path / "text.db3")
    (tmp_path / "none.mcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"none\.mcap"):
        BagReader(tmp_path / "none.mcap")


def test_a_bag_whose_file_is_gone_is_refused(tmp_path):
    write_bag(tmp_path / "bag", "mcap")
    data_file(tmp_path / "bag").unlink()
    with pytest.raises(InputError, match=r"bag"):
        BagReader(tmp_path / "bag")


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_known_as_one_also_without_its_description(tmp_path, storage):
    bag = tmp_path / "bag"
    write_bag(bag, storage)
    (bag / "metadata.yaml").unlink()  # as a killed recorder leaves it
    assert is_bag(bag) and is_bag(data_file(bag)) and not is_bag(tmp_path)
    assert find_cameras(bag) == ["cam0"]


def test_an_unknown_topic_lists_the_known_ones(tmp_path):
    write_bag(tmp_path / "bag", "mcap")
    with BagReader(tmp_path / "bag") as bag, pytest.raises(InputError, match=r"no topic /cam1/mask; it has /cam0"):
        next(bag.messages(["/cam1/mask"]))


def test_nothing_is_overwritten(tmp_path):
    write_bag(tmp_path / "bag", "mcap", count=3)
    with pytest.raises(OutputError, match="exists already"):
        BagWriter(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as bag:
        assert bag.message_count == 3


def test_wrong_use_is_named(tmp_path):
    with pytest.raises(InputError, match=r"mcap, sqlite3.*'csv'"):
        BagWriter(tmp_path / "bag", "csv")
    bag = BagWriter(tmp_path / "bag")
    with pytest.raises(InputError, match="my_msgs/msg/Thing is not known"):
        bag.add_topic("/thing", "my_msgs/msg/Thing")
    bag.close()
    bag.close()
    with pytest.raises(OutputError, match="already closed"):
        bag.flush()


def test_an_empty_bag_is_a_bag(tmp_path):
    BagWriter(tmp_path / "bag").close()
    with BagReader(tmp_path / "bag") as bag:
        assert (bag.message_count, list(bag.messages()), bag.damage) == (0, [], "")


def test_messages_deserialise_without_ros(tmp_path):
    image = deserialise(IMAGE, image_cdr(3, side=8))
    assert (image.height, image.width, image.encoding) == (8, 8, "mono8")
    assert image.data.tolist() == [(i * 7 + 3) % 256 for i in range(64)]
    with pytest.raises(InputError, match="the bytes are no sensor_msgs/msg/Image"):
        deserialise(IMAGE, image_cdr(3)[:50])
