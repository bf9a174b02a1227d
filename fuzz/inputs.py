# SPDX-License-Identifier: Apache-2.0
"""Raw bytes -> values of messages, and texts and archives -> damaged ones.

A fuzzer knows only bytes. `Draw` reads numbers, texts and choices from them, so that small changes of the bytes make
small changes of the input. `mutate_text` and `mutate_npz` change tokens and arrays in place of bytes, and so get past
the parser.
"""

from __future__ import annotations

import io
import math
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")

#: Parts of an input that is several files.
SPLIT = b"\n%%%%\n"

ODD_FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, 1e6, 1e18, 1e300, -1e300, float("nan"), float("inf"), float("-inf"))
ODD_INTEGERS = (0, 1, 2, 3, 7, 255, 256, 640, 65535, 65536, 10**9, 2**31 - 1, 2**31, 2**32 - 1)
ODD_TOKENS = (
    *("0", "1", "-1", "1e308", "-1e308", "1e999", ".nan", "nan", "NaN", ".inf", "-inf", "Infinity", "1" + "0" * 400),
    *("1" * 5000, "0x", "0b", "1_0", "1:59:59", "2001-99-99", "2001-01-01", "~", "null", "true", "no", "''", '"', "'"),
    *("[]", "{}", "[[]]", "[" * 3000, "{a: " * 500, "]", "}", ":", "- ", "&a [*a]", "*a", "<<", "? ", "|", ">", "%"),
    *("!!int x", "!!float .", "!!binary =", "!!set {a}", "!!omap []", "!!python/object/apply:os.system [x]"),
    *("../../x", "/dev/zero", "a" * 300, "\x00", "\u202e", "\t", "#", "cam0", "cam1", "<!DOCTYPE a>", "&lol;", "</a>"),
    *("1000000000", "2147483648", "18446744073709551616", "640", "1.0", "0.1", "none", "fisheye", "rational", "m"),
)
_TOKEN = re.compile(rb"[-+.\w]+")


class Draw:
    """Values out of bytes, in order; zeros where the bytes are at an end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        found = self._data[self._at : self._at + count]
        self._at += count
        return found + bytes(count - len(found))

    def rest(self) -> bytes:
        """All that is left."""
        found, self._at = self._data[self._at :], len(self._data)
        return found

    def below(self, limit: int) -> int:
        """A whole number from 0 to limit - 1."""
        return int.from_bytes(self.take(2), "little") % limit

    def choice(self, values: Sequence[T]) -> T:
        """One of some values."""
        return values[self.below(len(values))]

    def integer(self, limit: int = 2**32) -> int:
        """A small one, an odd one or any, below `limit`."""
        kind = self.below(3)
        found = (self.below(64), self.choice(ODD_INTEGERS), int.from_bytes(self.take(8), "little"))[kind]
        return found % limit

    def number(self) -> float:
        """A common, odd or arbitrary float."""
        kind = self.below(4)
        if kind == 0:
            return self.choice(ODD_FLOATS)
        if kind == 1:
            return float(struct.unpack("<d", self.take(8))[0])
        return (self.below(65536) - 32768) / (1.0, 100.0)[kind - 2]

    def near(self, usual: float) -> float:
        """Mostly a number near a usual one, seldom any finite one."""
        if self.below(16):
            return usual * (0.5 + self.below(1000) / 1000)
        found = self.number()
        return found if math.isfinite(found) else usual

    def text(self) -> str:
        """A short or odd text without a zero byte."""
        if self.below(2):
            return self.choice(ODD_TOKENS).replace("\x00", "")
        return self.take(self.below(20)).decode("utf-8", errors="ignore").replace("\x00", "")

    def value(self, depth: int = 3) -> object:
        """Any plain value, as a YAML file may hold it."""
        kind = self.below(8 if depth else 6)
        if kind == 6:
            return [self.value(depth - 1) for _ in range(self.below(5))]
        if kind == 7:
            return {self.text(): self.value(depth - 1) for _ in range(self.below(5))}
        makes: tuple[Callable[[], object], ...] = (
            *(lambda: None, lambda: bool(self.below(2)), self.integer, self.number, self.text),
            lambda: self.integer() * 10 ** self.below(400),
        )
        return makes[kind]()


def split(data: bytes, count: int) -> list[bytes]:
    """The `count` files of an input; the last ones are empty where there are fewer."""
    parts = data.split(SPLIT, count - 1)
    return parts + [b""] * (count - len(parts))


def mutate_text(data: bytes, most: int, rng: random.Random) -> bytes:
    """A text with some tokens replaced, or lines taken out, doubled or moved."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        tokens = [m.span() for m in _TOKEN.finditer(data)]
        if not tokens:
            return rng.choice(ODD_TOKENS).encode()
        start, end = rng.choice(tokens)
        other = data[slice(*rng.choice(tokens))]
        lines = data.split(b"\n")
        line = rng.randrange(len(lines))
        kind = rng.randrange(8)
        if kind < 3:
            data = data[:start] + rng.choice(ODD_TOKENS).encode() + data[end:]
        elif kind == 3:
            data = data[:start] + other + data[end:]
        elif kind == 4:
            data = data[:start] + data[end + rng.choice((0, 1, 2)) :]
        elif kind == 5:
            data = b"\n".join(lines[:line] + lines[line + rng.choice((1, 1, 5)) :])
        elif kind == 6:
            data = b"\n".join([*lines[:line], lines[rng.randrange(len(lines))], *lines[line:]])
        else:
            data = data[:start] + b"%d" % (rng.randrange(-3, 3) + 10 ** rng.randrange(12)) + data[end:]
    return data[:most]


def mutate_npz(data: bytes, most: int, rng: random.Random) -> bytes:
    """An archive with arrays of other types, shapes, values or names, missing ones, and headers that lie."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if archive[name].size < 200_000}
    except Exception:  # whatever is wrong with it: a fuzzer's archive may fail in any way
        return data[: rng.randrange(len(data) + 1)]
    lies: dict[str, str] = {}
    for _ in range(rng.choice((1, 1, 2, 3))):
        if not arrays:
            break
        name = rng.choice(sorted(arrays))
        array = arrays[name]
        kind = rng.randrange(9)
        if kind == 0:
            del arrays[name]
        elif kind == 1:
            arrays[rng.choice([*sorted(arrays), "x", "../x", "file", ""])] = array
        elif kind == 2:
            arrays[name] = array[: rng.randrange(len(array) + 1)] if array.ndim else array[None]
        elif kind == 3:
            arrays[name] = np.concatenate([array, array]) if array.ndim else array
        elif kind == 4:
            arrays[name] = array.reshape(rng.choice([(-1,), (1, *array.shape), (*array.shape, 1)]))
        elif kind == 5:
            wanted = rng.choice(["f4", "f8", "c16", "i1", "u1", "i8", "?", "U3", "S2", "M8[s]", ">f8", "V3"])
            raw = array.tobytes()
            size = np.dtype(wanted).itemsize
            arrays[name] = np.frombuffer(raw[: len(raw) // size * size], wanted).copy()
        elif kind == 6 and array.size and array.dtype.kind in "fiu":
            changed = array.copy()
            value = rng.choice(ODD_FLOATS) if array.dtype.kind == "f" else rng.choice((0, 1, 100, 127))
            changed.reshape(-1)[rng.randrange(array.size)] = value
            arrays[name] = changed
        elif kind == 7:
            arrays[name] = np.zeros(rng.choice([(), (0,), (0, 3), (1, 0, 3), (3,)]), array.dtype)
        else:
            lies[name] = rng.choice(["(1000000000,)", "(-1,)", "(3, 100000000000)", "(0, 1000000000)", "'a'", "(1.5,)"])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive_out:
        for name, array in arrays.items():
            member = io.BytesIO()
            if array.dtype.kind == "V":
                array = np.frombuffer(array.tobytes(), np.uint8)
            np.save(member, array, allow_pickle=False)
            raw = member.getvalue()
            if name in lies:
                raw = npy_with_shape(raw, lies[name])
            archive_out.writestr(f"{name}.npy", raw)
    return out.getvalue()[:most]


def npy_with_shape(raw: bytes, shape: str) -> bytes:
    """An .npy file whose header claims another shape."""
    head = 10
    size = struct.unpack("<H", raw[8:10])[0]
    header = re.sub(rb"'shape': \([^)]*\)", b"'shape': " + shape.encode(), raw[head : head + size]).rstrip()
    header += b" " * (-(head + len(header) + 1) % 64) + b"\n"
    return raw[:8] + struct.pack("<H", len(header)) + header + raw[head + size :]


def packed_npz(**arrays: object) -> bytes:
    """An archive as bytes."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def mutate_bytes(data: bytes, most: int, rng: random.Random) -> bytes:
    """Cuts, and numbers of all sizes overwritten, as headers and lengths are."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(out)) if out else 0
        kind = rng.randrange(5)
        if kind == 0:
            del out[at:]
        elif kind == 1:
            del out[at : at + rng.choice((1, 4, 64, 512))]
        else:
            form = rng.choice("BHIQ")
            limit = 2 ** (8 * struct.calcsize(form))
            value = rng.choice((0, 1, limit - 1, limit // 2, rng.randrange(limit), 10**9 % limit))
            raw = struct.pack(f"<{form}", value)
            out[at : at + len(raw)] = raw
    return bytes(out[:most])
