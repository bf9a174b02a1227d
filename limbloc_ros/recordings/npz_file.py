# SPDX-License-Identifier: Apache-2.0
"""NumPy's .npz archives, read without trust: no pickled objects, no more memory than the file holds.

`np.load` believes the header of each array: one that claims 10^9 numbers makes it allocate them before it reads the
first. Here the claim is held against the member's size, and that against a limit, before anything is allocated.
"""

from __future__ import annotations

import lzma
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError

#: All arrays of an archive together, unpacked: 3.5 hours of eight cameras' masks at 640x480 and 1 Hz.
MOST_BYTES = 4 * 2**30
#: Of an error's text, so many characters are told.
LONGEST = 300
#: Booleans, whole numbers, floats and texts; neither objects nor records.
_KINDS = "biufU"


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz archive, by name.

    Raises:
        InputError: it is missing, damaged or too large, or holds something else than arrays of plain values.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > MOST_BYTES:
                raise InputError(f"{path} would unpack to {size} bytes; expected at most {MOST_BYTES}")
            packed, held = sum(member.compress_size for member in members), path.stat().st_size
            if packed > held:
                raise ValueError(f"its directory claims {packed} bytes of arrays, but the file has {held}")
            return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    # RuntimeError: encrypted; NotImplementedError: an unknown compression
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as error:
        # zipfile quotes what it finds in the place of a name, however long
        raise InputError(f"{path} cannot be read as an .npz archive ({str(error)[:LONGEST]}); copy it again") from None


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array; raises ValueError when it is not what its header says."""
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{member.filename} is of the unknown version {version}")
        try:
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, fortran, dtype = read(file)
        except Exception as error:  # NumPy parses it as Python's literals, which can fail in any way
            raise ValueError(f"{member.filename}: its header is damaged ({error})") from None
        if dtype.kind not in _KINDS:
            raise ValueError(f"{member.filename} holds {dtype}; expected numbers or texts")
        claimed, held = math.prod(shape) * dtype.itemsize, member.file_size - file.tell()
        if claimed != held or min(shape, default=0) < 0:
            raise ValueError(f"{member.filename}: its header claims {list(shape)} {dtype}, but {held} bytes are there")
        data = bytearray(file.read())
        if len(data) != held:
            raise ValueError(f"{member.filename} ends after {len(data)} of {held} bytes")
    if not held:
        return np.zeros(shape, dtype)
    array = np.frombuffer(data, dtype).reshape(shape[::-1] if fortran else shape)
    return array.transpose() if fortran else array
