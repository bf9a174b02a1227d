# SPDX-License-Identifier: Apache-2.0
"""Reads what is left of a damaged bag file: a cut MCAP without its index, a cut or unfinished sqlite3 database.

`rosbags` reads healthy files and refuses these. Both readers here find everything up to the damage and say in
`damage` what they met; `bags.BagReader` chooses. MCAP records are `opcode uint8, length uint64, content`
(https://mcap.dev/spec); a chunk holds further records.
"""

from __future__ import annotations

import contextlib
import io
import sqlite3
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.rosbag2.storage_mcap import decompress

from limbloc_ros.core.errors import InputError

MCAP_MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F

#: Row numbers without a readable row after which a damaged database counts as read to the end.
SQLITE_GIVE_UP = 20_000


@dataclass(frozen=True)
class SalvagedTopic:
    """A topic found in a damaged file; `qos_yaml` is what the recorder noted as offered QoS, possibly empty."""

    name: str
    type: str
    qos_yaml: str


@dataclass
class _Block:
    """A chunk (or the run of messages outside chunks) of an MCAP file: where it is and what times it spans."""

    offset: int
    size: int
    compression: str
    unpacked_size: int
    crc: int
    start_ns: int = 0
    end_ns: int = 0

    def unpack(self, data: bytes) -> bytes:
        """The records in the block; raises whatever the decompressor finds wrong."""
        return bytes(decompress(data, self.compression, self.unpacked_size, self.crc))


@dataclass
class _Contents:
    topics: dict[int, SalvagedTopic] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    start_ns: int = 2**63 - 1
    end_ns: int = 0

    def count(self, channel: int, stamp_ns: int) -> None:
        """Note one readable message; messages of unknown channels are not readable."""
        if channel in self.topics:
            name = self.topics[channel].name
            self.counts[name] = self.counts.get(name, 0) + 1
            self.start_ns, self.end_ns = min(self.start_ns, stamp_ns), max(self.end_ns, stamp_ns)


class SalvagedMcap:
    """An MCAP file read from the front, chunk by chunk, without index and footer.

    Raises:
        InputError: no MCAP file at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        self._contents = _Contents()
        self._schemas: dict[int, str] = {}
        self._blocks: list[_Block] = []
        with path.open("rb") as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise InputError(f"{path}: expected an MCAP file, but it does not begin like one")
            self._scan(file)

    @property
    def topics(self) -> list[SalvagedTopic]:
        """Every topic in the readable part."""
        return list(self._contents.topics.values())

    @property
    def counts(self) -> dict[str, int]:
        """Readable messages by topic."""
        return self._contents.counts

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first and last readable message, ns."""
        return self._contents.start_ns, self._contents.end_ns

    def messages(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Readable messages with start <= stamp < stop, in time order within chunks, chunks in order of their start."""
        wanted = {channel: topic.name for channel, topic in self._contents.topics.items() if topic.name in names}
        with self.path.open("rb") as file:
            for block in sorted(self._blocks, key=lambda b: b.start_ns):
                if block.end_ns < start_ns or block.start_ns >= stop_ns:
                    continue
                file.seek(block.offset)
                data = block.unpack(file.read(block.size))
                found = [m for m in _chunk_messages(data) if m[0] in wanted and start_ns <= m[1] < stop_ns]
                for channel, stamp_ns, cdr in sorted(found, key=lambda m: m[1]):
                    yield wanted[channel], stamp_ns, cdr

    def _scan(self, file: io.BufferedReader) -> None:
        """Walk the top-level records until the data ends or the file breaks off."""
        self._size = self.path.stat().st_size
        while True:
            head_at = file.tell()
            head = file.read(9)
            if len(head) < 9:
                self.damage = f"{self.path.name} breaks off at byte {head_at} without its index"
                return
            opcode, size = struct.unpack("<BQ", head)
            if opcode == DATA_END:
                self.damage = f"{self.path.name} has no valid index or footer"
                return
            if opcode == CHUNK:
                if not self._scan_chunk(file, head_at, size):
                    return
                continue
            # What a damaged length claims would be allocated before it is read.
            body = file.read(size) if size <= self._size else b""
            if len(body) != size:
                self.damage = f"{self.path.name} breaks off within the record at byte {head_at}"
                return
            if opcode == MESSAGE:
                block = _Block(head_at, 9 + size, "", 9 + size, 0)
                self._note(block, head + body)
            else:
                self._declare(opcode, body)

    def _scan_chunk(self, file: io.BufferedReader, head_at: int, size: int) -> bool:
        """Note one chunk; False where the file breaks off. An uncompressed chunk is used as far as it goes."""
        header = file.read(min(size, 32))
        if len(header) < 32:
            self.damage = f"{self.path.name} breaks off within the chunk at byte {head_at}"
            return False
        unpacked_size, crc, name_size = struct.unpack_from("<QII", header, 16)
        rest = file.read(name_size + 8) if name_size < 64 else b""
        if len(rest) != name_size + 8:
            self.damage = f"{self.path.name} breaks off within the chunk at byte {head_at}"
            return False
        compression = rest[:name_size].decode(errors="replace")
        (data_size,) = struct.unpack_from("<Q", rest, name_size)
        offset = file.tell()
        data = file.read(min(data_size, size, self._size))
        whole = len(data) == data_size
        if whole or compression == "":
            block = _Block(offset, len(data), compression, unpacked_size if whole else len(data), crc if whole else 0)
            try:
                self._note(block, block.unpack(data))
            except Exception as error:  # each decompressor has its own
                self.damage = f"{self.path.name}: the chunk at byte {head_at} cannot be unpacked ({error})"
                return False
        if not whole:
            self.damage = f"{self.path.name} breaks off within the chunk at byte {head_at}"
        return bool(whole)

    def _note(self, block: _Block, data: bytes) -> None:
        start_ns, end_ns = 2**63 - 1, -1
        for opcode, body in _records(data):
            if opcode == MESSAGE and len(body) >= 22:
                channel, _, stamp_ns = struct.unpack_from("<HIQ", body)
                self._contents.count(channel, stamp_ns)
                start_ns, end_ns = min(start_ns, stamp_ns), max(end_ns, stamp_ns)
            else:
                self._declare(opcode, body)
        if end_ns >= 0:
            block.start_ns, block.end_ns = start_ns, end_ns
            self._blocks.append(block)

    def _declare(self, opcode: int, body: bytes) -> None:
        """Take note of a schema or channel record; a damaged one is passed over, and with it its messages."""
        with contextlib.suppress(struct.error):
            self._read_declaration(opcode, body)

    def _read_declaration(self, opcode: int, body: bytes) -> None:
        if opcode == SCHEMA:
            (key,) = struct.unpack_from("<H", body)
            self._schemas[key] = _string(body, 2)[0]
        elif opcode == CHANNEL:
            key, schema = struct.unpack_from("<HH", body)
            topic, at = _string(body, 4)
            _, at = _string(body, at)
            metadata, end = {}, at + 4 + struct.unpack_from("<I", body, at)[0]
            at += 4
            while at < end:
                label, at = _string(body, at)
                metadata[label], at = _string(body, at)
            if schema in self._schemas:
                qos = metadata.get("offered_qos_profiles", "")
                self._contents.topics[key] = SalvagedTopic(topic, self._schemas[schema], qos)


class SalvagedSqlite:
    """A rosbag2 sqlite3 file whose writer was killed or whose tail is missing, read row by row.

    Raises:
        InputError: no rosbag2 database, or so damaged that its list of topics is gone.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        self._contents = _Contents()
        self._rows: list[tuple[int, int]] = []  # stamp, row number
        try:
            self._connection = self._connect()
            columns = {row[1] for row in self._connection.execute("PRAGMA table_info(topics)")}
            qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
            for key, name, kind, profiles in self._connection.execute(f"SELECT id, name, type, {qos} FROM topics"):
                if isinstance(name, str) and isinstance(kind, str):  # a column of a damaged database may hold anything
                    self._contents.topics[key] = SalvagedTopic(
                        name, kind, profiles if isinstance(profiles, str) else ""
                    )
        except (sqlite3.Error, UnicodeDecodeError, MemoryError) as error:
            raise InputError(
                f"{path}: expected a rosbag2 sqlite3 database, but its list of topics cannot be read ({error}). "
                "Record with storage mcap: it survives being cut"
            ) from error
        self._scan()

    @property
    def topics(self) -> list[SalvagedTopic]:
        """Every topic in the readable part."""
        return list(self._contents.topics.values())

    @property
    def counts(self) -> dict[str, int]:
        """Readable messages by topic."""
        return self._contents.counts

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first and last readable message, ns."""
        return self._contents.start_ns, self._contents.end_ns

    def messages(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Readable messages with start <= stamp < stop, in time order."""
        for stamp_ns, row in self._rows:
            if start_ns <= stamp_ns < stop_ns:
                found = self._row("topic_id, data", row)
                if found is not None and found[0] in self._contents.topics and isinstance(found[1], bytes):
                    name = self._contents.topics[found[0]].name
                    if name in names:
                        yield name, stamp_ns, found[1]

    def close(self) -> None:
        """Close the database."""
        self._connection.close()

    def _connect(self) -> sqlite3.Connection:
        # A write-ahead log beside the file holds the last messages of a killed recorder: open it with the log.
        # Without one, `immutable` also reads from write-protected media.
        has_log = self.path.with_name(self.path.name + "-wal").exists()
        options = "mode=ro" if has_log else "mode=ro&immutable=1"
        connection = sqlite3.connect(f"{self.path.resolve().as_uri()}?{options}", uri=True)
        # Or sqlite refuses every query on a file that is shorter than its header says.
        connection.execute("PRAGMA writable_schema=ON")
        return connection

    def _is_cut(self) -> bool:
        """Whether the file is shorter than its header says."""
        with self.path.open("rb") as file:
            header = file.read(100)
        if len(header) < 100:
            return True
        page_bytes, pages = struct.unpack(">H", header[16:18])[0], struct.unpack(">I", header[28:32])[0]
        return bool(self.path.stat().st_size < pages * (65536 if page_bytes == 1 else page_bytes))

    def _row(self, columns: str, row: int) -> Any:
        try:
            return self._connection.execute(f"SELECT {columns} FROM messages WHERE id = ?", (row,)).fetchone()
        except (sqlite3.Error, MemoryError) as error:  # a damaged row may claim to be larger than sqlite can hold
            self.damage = f"{self.path.name}: {error}"
            return None

    def _scan(self) -> None:
        """List the readable rows: at once where the database is sound, else one by one."""
        try:
            rows = self._connection.execute("SELECT id, topic_id, timestamp, length(data) FROM messages").fetchall()
        except (sqlite3.Error, MemoryError) as error:
            self.damage = f"{self.path.name}: {error}"
            rows, row, misses = [], 0, 0
            # A row takes some bytes: no file has more rows than that.
            while misses < min(SQLITE_GIVE_UP, self.path.stat().st_size // 16):
                row += 1
                # Joining the data with nothing reads all its pages: a row whose data is gone counts as unreadable.
                found = self._row("id, topic_id, timestamp, length(CAST(data AS BLOB) || x'')", row)
                misses = 0 if found else misses + 1
                if found:
                    rows.append(found)
            if self._is_cut():
                del rows[-1:]  # sqlite reads pages behind the end as zeros, and may not notice in the last message
        for row, topic, stamp_ns, _ in rows:
            if isinstance(stamp_ns, int) and isinstance(row, int):
                self._contents.count(topic, stamp_ns)
                self._rows.append((stamp_ns, row))
        self._rows.sort()


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The whole records in `data`, as (opcode, content); a record that is cut off ends it."""
    at = 0
    while at + 9 <= len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        if at + 9 + size > len(data):
            return
        yield opcode, data[at + 9 : at + 9 + size]
        at += 9 + size


def _chunk_messages(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    for opcode, body in _records(data):
        if opcode == MESSAGE and len(body) >= 22:
            channel, _, stamp_ns = struct.unpack_from("<HIQ", body)
            yield channel, stamp_ns, body[22:]


def _string(body: bytes, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", body, at)
    return body[at + 4 : at + 4 + size].decode(errors="replace"), at + 4 + size
