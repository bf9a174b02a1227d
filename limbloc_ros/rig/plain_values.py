# SPDX-License-Identifier: Apache-2.0
"""Text files of keys and numbers -> plain values and arrays, with messages that say which key, what was expected, what
came."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from limbloc_ros.core.errors import RigError

Array = NDArray[np.float64]


def read_text(path: Path, what: str, expected: str) -> str:
    """A UTF-8 text file.

    Args:
        path: the file.
        what: how messages call it, e.g. `rig file`.
        expected: what to name instead when it is a folder.

    Raises:
        RigError: it is missing, a folder, unreadable or no text.
    """
    if path.is_dir():
        raise RigError(f"{what} {path}: expected a file, this is a folder; name {expected}")
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RigError(f"{what} {path} does not exist; check the path") from None
    except UnicodeDecodeError as error:
        raise RigError(f"{what} {path}: expected UTF-8 text, got other bytes at position {error.start}") from None
    except OSError as error:
        raise RigError(f"{what} {path} cannot be read: {error.strerror}") from None


def parse(text: str, path: Path, what: str) -> Any:
    """Text -> plain values; YAML, or JSON by its file name (YAML refuses tabs, JSON reads faster).

    Raises:
        RigError: what is wrong, and in which line.
    """
    if path.suffix.lower() == ".json":
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            raise RigError(f"{what} {path}, line {error.lineno}: not valid JSON: {error.msg}") from None
    try:
        return yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise RigError(f"{what} {path}{line}: not valid YAML: {error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise RigError(f"{what} {path}: not valid YAML: {error}") from None


def required(entry: Mapping[str, Any], key: str, at: str) -> Any:
    """The value of `key`; raises RigError that lists the keys there are."""
    if key not in entry:
        raise RigError(f"{at}: key {key} is missing; it has {', '.join(map(str, entry)) or 'no keys'}")
    return entry[key]


def known_keys(entry: Mapping[str, Any], known: Sequence[str], at: str) -> None:
    """Raise RigError at the first key that is not among `known`."""
    for key in entry:
        if key not in known:
            raise RigError(f"{at}: unknown key {key!r}; expected {', '.join(known)}")


def numbers(value: Any, shape: tuple[int, ...] | None, at: str, pairs: bool = False) -> Array:
    """Plain values -> array of `shape` (a flat list of the right length will do; None: any flat list, or pairs)."""
    expected = "a list of numbers" if shape is None else f"{'x'.join(map(str, shape))} numbers"
    try:
        array = (
            np.array(value, dtype=np.float64) if isinstance(value, Sequence) and not isinstance(value, str) else None
        )
    except (TypeError, ValueError):  # text or nothing among the numbers, or rows of different lengths
        array = None
    if array is None:
        raise RigError(f"{at}: expected {expected}, got {kind(value)}")
    if shape is None:
        expected = "pairs of numbers" if pairs else expected
        shape = (array.size // 2, 2) if pairs else (array.size,)
    if array.shape != shape and array.shape != (int(np.prod(shape)),):
        raise RigError(f"{at}: expected {expected}, got {'x'.join(map(str, array.shape))}")
    if not np.isfinite(array).all():
        raise RigError(f"{at}: expected finite numbers, got {array.tolist()}")
    return array.reshape(shape)


def kind(value: Any) -> str:
    """A value in a few words, for messages."""
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
