# SPDX-License-Identifier: Apache-2.0
"""rosbag2 recordings, MCAP and sqlite3, read and written as raw CDR through `rosbags`: no ROS installation needed.

What goes wrong with recordings is expected here: a recorder killed in the middle, a copy that broke off, a missing
`metadata.yaml`, a full disk. The reader gives what is there up to the damage and says so in `damage`; the writer
flushes about once a second, so that even kill -9 costs no more than that.
"""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore

from limbloc_ros.core.errors import InputError, OutputError
from limbloc_ros.recordings._bag_salvage import SalvagedMcap, SalvagedSqlite

#: Message definitions of a Jazzy installation.
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
SUFFIXES = {".mcap": "mcap", ".db3": "sqlite3"}

#: The writer stops while this much disk is left, so that it can still close the bag.
MIN_FREE_BYTES = 64 * 2**20
FLUSH_S = 1.0

_FOREVER = 2**63 - 1


@dataclass(frozen=True)
class BagTopic:
    """A recorded topic.

    Attributes:
        name: absolute topic name.
        type: message type, e.g. `sensor_msgs/msg/Image`.
        count: messages in the bag (in its readable part).
        reliable, latched: whether the publishers offered reliable delivery and transient-local durability.
    """

    name: str
    type: str
    count: int = 0
    reliable: bool = True
    latched: bool = False


class BagMessage(NamedTuple):
    """One message as it was on the wire: `stamp_ns` is the time of recording, `cdr` the serialised message."""

    topic: str
    stamp_ns: int
    cdr: bytes


class BagReader:
    """A rosbag2 folder, or a single .mcap or .db3 file.

    Attributes:
        path: what was opened.
        topics: by name.
        start_ns, end_ns: recording times of the first and last message, ns (both 0 in an empty bag).
        damage: empty, or what is wrong with the bag and what that means; more may be found while reading.

    Raises:
        InputError: no bag there, or nothing in it can be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = ""
        self.topics: dict[str, BagTopic] = {}
        self.start_ns = self.end_ns = 0
        self._sources: list[_Healthy | SalvagedMcap | SalvagedSqlite] = []
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        for source in self._sources:
            if not isinstance(source, SalvagedMcap):
                source.close()
        self._sources.clear()

    @property
    def message_count(self) -> int:
        """Messages in the (readable part of the) bag."""
        return sum(topic.count for topic in self.topics.values())

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int = 0, stop_ns: int = _FOREVER
    ) -> Iterator[BagMessage]:
        """Raw messages in the order of recording, start <= stamp < stop. Damage ends the iteration; see `damage`.

        Args:
            topics: names; all if None.
            start_ns, stop_ns: recording times, ns.

        Raises:
            InputError: a topic that the bag does not have.
        """
        names = set(self.topics if topics is None else topics)
        if unknown := sorted(names - set(self.topics)):
            raise InputError(
                f"{self.path} has no topic {', '.join(unknown)}; it has {', '.join(sorted(self.topics)) or 'none'}"
            )
        for source in self._sources:
            try:
                for name, stamp_ns, cdr in source.messages(names, start_ns, stop_ns):
                    yield BagMessage(name, stamp_ns, cdr)
            # A damaged file can make the libraries below fail in any way; what was read until here is good.
            except Exception as error:
                self._note(f"reading ended early: {type(error).__name__}: {error}")

    def deserialise(self, topic: str, cdr: bytes) -> Any:
        """The message as a `rosbags` dataclass; arrays are numpy arrays.

        Raises:
            InputError: the type is unknown or the bytes are no such message.
        """
        return deserialise(self.topics[topic].type, cdr, topic)

    def _open(self) -> None:
        if not self.path.exists():
            raise InputError(f"{self.path}: expected a rosbag2 folder or an .mcap or .db3 file, but there is nothing")
        if self.path.suffix == ".bag":
            raise InputError(f"{self.path} is a ROS 1 bag; convert it with `rosbags-convert --src A.bag --dst B`")
        files = [self.path]
        if self.path.is_dir():
            files = sorted(f for f in self.path.iterdir() if f.suffix in SUFFIXES)
            if not files and not list(self.path.glob("*.zst*")):
                raise InputError(
                    f"{self.path}: expected a rosbag2 folder (metadata.yaml and .mcap or .db3 files), found neither"
                )
        elif self.path.suffix not in SUFFIXES:
            raise InputError(f"{self.path}: expected a rosbag2 folder or an .mcap or .db3 file")
        try:
            self._sources = [_Healthy(self.path)]
        except Exception as error:
            if not files:
                raise InputError(f"{self.path}: cannot be read ({error}), and holds no .mcap or .db3 file") from error
            self._salvage(files, error)
        self._collect()

    def _salvage(self, files: list[Path], error: Exception) -> None:
        """Open the files one by one, each with the reader that can."""
        if isinstance(error, FileNotFoundError):
            self._note("metadata.yaml is missing (the recorder was killed?); reading the files themselves")
        elif self.path.is_dir():
            self._note(f"the bag is damaged ({error})")
        failures = []
        for file in files:
            # A log beside a database holds messages that rosbags does not see.
            has_log = file.with_name(file.name + "-wal").exists()
            try:
                if not has_log:
                    self._sources.append(_Healthy(file))
                    continue
            except Exception as file_error:
                self._note(f"{file.name} is damaged ({file_error})")
            try:
                source = SalvagedMcap(file) if file.suffix == ".mcap" else SalvagedSqlite(file)
                self._sources.append(source)
                if source.damage:
                    self._note(source.damage)
            except InputError as file_error:
                failures.append(str(file_error))
                self._note(str(file_error))
        if not self._sources:
            raise InputError(f"{self.path}: nothing can be read. " + "; ".join(failures))

    def _collect(self) -> None:
        starts, ends = [], []
        for source in self._sources:
            for found in source.topics:
                topic = (
                    found if isinstance(found, BagTopic) else _salvaged_topic(found.name, found.type, found.qos_yaml)
                )
                count = source.counts.get(topic.name, 0)
                if topic.name in self.topics:
                    count += self.topics[topic.name].count
                self.topics[topic.name] = BagTopic(topic.name, topic.type, count, topic.reliable, topic.latched)
            if any(source.counts.values()):
                starts.append(source.span_ns[0])
                ends.append(source.span_ns[1])
        if starts:
            self.start_ns, self.end_ns = min(starts), max(ends)

    def _note(self, text: str) -> None:
        self.damage = f"{self.damage}; {text}" if self.damage else text


class BagWriter:
    """Writes a new rosbag2 folder (metadata version 9).

    Args:
        path: the folder to make; it must not exist.
        storage: `mcap` or `sqlite3`.
        min_free_bytes: writing ends with an error while this much disk is left, early enough to close the bag well.
        flush_s: what is older than this is on disk, s.

    Raises:
        OutputError: the folder exists or cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        storage: str = "mcap",
        min_free_bytes: int = MIN_FREE_BYTES,
        flush_s: float = FLUSH_S,
    ) -> None:
        if storage not in STORAGES:
            raise InputError(f"storage: expected one of {', '.join(STORAGES)}, got {storage!r}")
        self.path = Path(path)
        self.storage = storage
        self.counts: dict[str, int] = {}
        self.bytes_written = 0
        self._min_free_bytes = min_free_bytes
        self._flush_s = flush_s
        self._flushed_s = time.monotonic()
        self._connections: dict[str, Connection] = {}
        self._writer: Writer | None = None
        try:
            writer = Writer(self.path, version=9, storage_plugin=STORAGES[storage])
            writer.open()
        except (WriterError, OSError, sqlite3.Error) as error:
            reason = str(error).rstrip(".")
            raise OutputError(f"cannot record to {self.path}: {reason}. Choose another folder or remove it") from error
        self._writer = writer
        self._storage: Any = writer.storage
        if storage == "sqlite3":
            # With the write-ahead log, what has been committed survives kill -9 (and readers never see half a page).
            self._storage.conn.commit()
            self._storage.conn.execute("PRAGMA journal_mode=WAL")

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Whether the bag is finished."""
        return self._writer is None

    def add_topic(self, name: str, kind: str, *, reliable: bool = True, latched: bool = False) -> None:
        """Announce a topic; once more is harmless.

        Raises:
            InputError: a message type that Jazzy's common interfaces do not have.
        """
        if name in self._connections:
            return
        if kind not in TYPESTORE.fielddefs:
            raise InputError(f"cannot record {name}: the definition of {kind} is not known")
        self._connections[name] = self._open_writer().add_connection(
            name, kind, typestore=TYPESTORE, offered_qos_profiles=[_qos(reliable, latched)]
        )
        self.counts[name] = 0

    def write(self, topic: str, stamp_ns: int, cdr: bytes | memoryview) -> None:
        """Append one serialised message.

        Raises:
            OutputError: the disk is full or fails. The bag has been closed and holds everything up to here.
        """
        writer = self._open_writer()
        try:
            writer.write(self._connections[topic], stamp_ns, cdr)
        except (OSError, sqlite3.Error) as error:
            self._fail(error)
        self.counts[topic] += 1
        self.bytes_written += len(cdr)
        if time.monotonic() - self._flushed_s >= self._flush_s:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system, and check that there is room for more.

        Raises:
            OutputError: the disk is full or fails. The bag has been closed and holds everything up to here.
        """
        self._open_writer()
        self._flushed_s = time.monotonic()
        try:
            if self.storage == "sqlite3":
                self._storage.conn.commit()
            else:
                if self._storage.chunk.bio.tell():
                    self._storage.close_chunk()
                self._storage.bio.flush()
            free = shutil.disk_usage(self.path).free
        except (OSError, sqlite3.Error) as error:
            self._fail(error)
        if free < self._min_free_bytes:
            self.close()
            raise OutputError(
                f"recording to {self.path} ended: {free / 2**20:.0f} MB of disk are left, "
                f"{self._min_free_bytes / 2**20:.0f} MB are needed. The bag is complete up to here "
                f"({sum(self.counts.values())} messages)"
            )

    def close(self) -> None:
        """Write the index and `metadata.yaml`. Closing twice is harmless.

        Raises:
            OutputError: the index could not be written; the messages up to the last flush can still be read.
        """
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            if self.storage == "sqlite3":
                # Fold the log back in, so that the .db3 alone is the whole bag, for every reader.
                self._storage.conn.commit()
                self._storage.conn.execute("PRAGMA journal_mode=DELETE")
            writer.close()
        except (OSError, sqlite3.Error, WriterError) as error:
            self._abandon(writer)
            raise OutputError(
                f"{self.path} could not be finished ({error}). What was flushed can still be read; "
                "`ros2 bag reindex` makes it a regular bag again"
            ) from error

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise OutputError(f"{self.path} is already closed")
        return self._writer

    def _fail(self, error: Exception) -> None:
        """A write failed: keep what is on disk, and say so."""
        writer, self._writer = self._writer, None
        if writer is not None:
            self._abandon(writer)
        raise OutputError(
            f"recording to {self.path} failed ({error}). The bag has no index now, but what came before can be read"
        ) from error

    def _abandon(self, writer: Writer) -> None:
        """Close the files without index; a second failure here adds nothing to the first."""
        try:
            writer.abort()
        except (OSError, sqlite3.Error):
            # The buffered rest cannot be written either; drop the file object with it.
            return


def is_bag(path: Path) -> bool:
    """Whether a file or folder looks like a bag; one of ROS 1 too, so that `BagReader` says what to do with it."""
    if path.is_file():
        return path.suffix in (*SUFFIXES, ".bag")
    return path.is_dir() and (
        (path / "metadata.yaml").is_file() or any(child.suffix in SUFFIXES for child in path.iterdir())
    )


def deserialise(kind: str, cdr: bytes, where: str = "message") -> Any:
    """A CDR message of type `kind` (e.g. `sensor_msgs/msg/Image`) as a `rosbags` dataclass; arrays are numpy arrays.

    Raises:
        InputError: the type is unknown or the bytes are no such message.
    """
    if kind not in TYPESTORE.fielddefs:
        raise InputError(f"{where}: the definition of {kind} is not known")
    try:
        return TYPESTORE.deserialize_cdr(cdr, kind)
    except Exception as error:
        raise InputError(f"{where}: the bytes are no {kind} ({type(error).__name__}: {error})") from error


class _Healthy:
    """A whole bag or file, through `rosbags`."""

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        self._reader.open()
        connections = self._reader.connections
        self.counts: dict[str, int] = {}
        for c in connections:
            self.counts[c.topic] = self.counts.get(c.topic, 0) + c.msgcount
        self.topics = [BagTopic(c.topic, c.msgtype, 0, *_offered(c.ext.offered_qos_profiles)) for c in connections]
        self.span_ns = (self._reader.start_time, self._reader.end_time - 1)

    def messages(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Messages in time order."""
        wanted = [c for c in self._reader.connections if c.topic in names]
        if wanted:
            for connection, stamp_ns, cdr in self._reader.messages(wanted, start=start_ns, stop=stop_ns):
                # sqlite may hold anything in the place of a message
                lost = cdr is None or isinstance(cdr, (str, int, float))
                yield connection.topic, stamp_ns, b"" if lost else cdr

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


def _salvaged_topic(name: str, kind: str, qos_yaml: str) -> BagTopic:
    try:
        profiles = parse_qos(qos_yaml)
    except (ReaderError, KeyError, TypeError, AttributeError):
        profiles = []  # a damaged bag may have lost them; the defaults suit every topic
    return BagTopic(name, kind, 0, *_offered(profiles))


def _offered(profiles: list[Qos]) -> tuple[bool, bool]:
    """Whether all publishers were reliable, and whether any was latched."""
    reliable = all(p.reliability != QosReliability.BEST_EFFORT for p in profiles)
    return reliable, any(p.durability == QosDurability.TRANSIENT_LOCAL for p in profiles)


def _qos(reliable: bool, latched: bool) -> Qos:
    # rosbag2 writes an infinite duration like this
    endless = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        10,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        endless,
        endless,
        QosLiveliness.AUTOMATIC,
        endless,
        False,
    )
