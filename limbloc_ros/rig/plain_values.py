# SPDX-License-Identifier: Apache-2.0
"""Text files of keys and numbers -> plain values and arrays, with messages that say which key, what was expected, what
came.

Files come from strangers too: `yaml_values` and `json_values` make nothing but plain values of them, and refuse texts
that are long, deep, or grow by repeating themselves (anchors) beyond what any of our files needs.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from limbloc_ros.core.errors import LimblocError, RigError

Array = NDArray[np.float64]

#: Limits of a text file: its length (PyYAML reads 0.1 to 1 MB/s), and its values when all anchors are written out.
MOST_CHARACTERS = {"YAML": 1_000_000, "JSON": 20_000_000}
MOST_VALUES, MOST_DEPTH = 1_000_000, 50
#: No length, pixel or coefficient is larger; beyond it squares and products overflow.
LARGEST_NUMBER = 1e12


def read_values(path: Path, what: str, expected: str, error: type[LimblocError] = RigError) -> Any:
    """The plain values of a YAML or JSON file; arguments and errors as of `read_text`, and of `parse`."""
    return parse(read_text(path, what, expected, error), path, what, error)


def read_text(path: Path, what: str, expected: str, error: type[LimblocError] = RigError) -> str:
    """A UTF-8 text file.

    Args:
        path: the file.
        what: how messages call it, e.g. `rig file`.
        expected: what to name instead when it is a folder.
        error: the kind to raise when it is missing, a folder, unreadable or no text.
    """
    if path.is_dir():
        raise error(f"{what} {path}: expected a file, this is a folder; name {expected}")
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise error(f"{what} {path} does not exist; check the path") from None
    except UnicodeDecodeError as cause:
        raise error(f"{what} {path}: expected UTF-8 text, got other bytes at position {cause.start}") from None
    except OSError as cause:
        raise error(f"{what} {path} cannot be read: {cause.strerror}") from None


def parse(text: str, path: Path, what: str, error: type[LimblocError] = RigError) -> Any:
    """Text -> plain values; YAML, or JSON by its file name (YAML refuses tabs, JSON reads faster).

    Raises:
        LimblocError: of the kind `error`: what is wrong, and in which line.
    """
    is_json = path.suffix.lower() == ".json"
    try:
        return json_values(text) if is_json else yaml_values(text)
    except ValueError as cause:
        raise error(f"{what} {path}{cause}") from None


#: Ten times as fast where PyYAML was built with libyaml.
_SafeLoader: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):  # type: ignore[misc, valid-type]
    """PyYAML's safe loader, which also takes OpenCV's matrices for mappings."""

    def flatten_mapping(self, node: Any) -> None:
        """Sections that merge others (`<<`), which merge others in turn, may not grow without end."""
        super().flatten_mapping(node)
        if len(node.value) > MOST_VALUES // 100:
            raise yaml.constructor.ConstructorError(None, None, "sections merged into each other", node.start_mark)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_yaml_map)


def yaml_values(text: str, several: bool = False) -> Any:
    """YAML -> plain values; `several`: the list of all its documents.

    Raises:
        ValueError: what is wrong, as `, line 3: not valid YAML: ...` or `: not valid YAML: ...`.
    """
    _check_length(text, "YAML")
    try:
        _check_depth(text)
        values = list(yaml.load_all(text, _Loader)) if several else yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}:" if error.problem_mark else ":"
        raise ValueError(f"{line} not valid YAML: {error.problem or error.context}") from None
    except Exception as error:  # PyYAML fails in many ways: the 99th of a month, `!!bool x`, a lone `%`, 5000 digits
        raise ValueError(
            f": not valid YAML: {next(iter(str(error).splitlines()), type(error).__name__):.200}"
        ) from None
    _check_size(values, "YAML")
    return values


def _check_depth(text: str) -> None:
    """Raise ValueError where sections lie too deep in each other: what builds values calls itself for each level."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_DEPTH:
            raise ValueError(f"more than {MOST_DEPTH} sections within each other")


def json_values(text: str) -> Any:
    """JSON -> plain values.

    Raises:
        ValueError: what is wrong, as in `yaml_values`.
    """
    _check_length(text, "JSON")
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f", line {error.lineno}: not valid JSON: {error.msg}") from None
    except RecursionError:
        raise ValueError(": not valid JSON: brackets within each other without end") from None
    except ValueError as error:  # a number of 5000 digits
        raise ValueError(f": not valid JSON: {error}") from None
    _check_size(values, "JSON")
    return values


def _check_length(text: str, what: str) -> None:
    if len(text) > MOST_CHARACTERS[what]:
        raise ValueError(f": expected at most {MOST_CHARACTERS[what]} characters of {what}, got {len(text)}")


def _check_size(values: Any, what: str) -> None:
    """Raise ValueError when values hold themselves, or too many others when all that is shared is written out."""
    sizes: dict[int, int] = {}  # by id; 0 while its parts are being counted
    waiting = [values]
    while waiting:
        value = waiting[-1]
        parts: Iterable[Any] = ()
        if isinstance(value, Mapping):
            parts = value.values()
        elif isinstance(value, (list, tuple, set, frozenset)):
            parts = value
        parts = [part for part in parts if isinstance(part, (Mapping, list, tuple, set, frozenset))]
        if id(value) not in sizes:
            sizes[id(value)] = 0
            if any(sizes.get(id(part)) == 0 for part in parts):
                raise ValueError(f": not valid {what}: a section holds itself")
            waiting += [part for part in parts if id(part) not in sizes]
            continue
        waiting.pop()
        if sizes[id(value)] == 0:
            own = len(value) if isinstance(value, (Mapping, list, tuple, set, frozenset)) else 1
            sizes[id(value)] = 1 + own + sum(sizes[id(part)] for part in parts)
            if sizes[id(value)] > MOST_VALUES:
                raise ValueError(f": not valid {what}: expected at most {MOST_VALUES} values, anchors written out")


def required(entry: Mapping[str, Any], key: str, at: str) -> Any:
    """The value of `key`; raises RigError that lists the keys there are."""
    if not isinstance(entry, Mapping):
        raise RigError(f"{at}: expected key {key} and others, got {kind(entry)}")
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
    except (TypeError, ValueError, OverflowError):  # text or nothing, rows of different lengths, or 400 digits
        array = None
    if array is None:
        raise RigError(f"{at}: expected {expected}, got {kind(value)}")
    if shape is None:
        expected = "pairs of numbers" if pairs else expected
        shape = (array.size // 2, 2) if pairs else (array.size,)
    if array.shape != shape and array.shape != (int(np.prod(shape)),):
        raise RigError(f"{at}: expected {expected}, got {'x'.join(map(str, array.shape))}")
    return usable(array, at).reshape(shape)


def flattened(value: Any) -> list[Any]:
    """A list, or the elements of its rows: tools write a vector as [x, y, z], [[x, y, z]] or [[x], [y], [z]]."""
    items = value if isinstance(value, list) else [value]
    return [item for part in items for item in (part if isinstance(part, list) else [part])]


def usable(array: Array, at: str) -> Array:
    """The same array; raises RigError when it holds a number that is not finite, or larger than any room needs."""
    if not np.isfinite(array).all():
        raise RigError(f"{at}: expected finite numbers, got {kind(array.tolist())}")
    if array.size and np.abs(array).max() > LARGEST_NUMBER:
        raise RigError(f"{at}: expected numbers up to {LARGEST_NUMBER:g}, got {kind(array.tolist())}")
    return array


def kind(value: Any) -> str:
    """A value in a few words, for messages."""
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
