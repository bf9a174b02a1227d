# SPDX-License-Identifier: Apache-2.0
"""The few kinds of error and the typed "nobody there".

Every message says what was expected, what came, and what to do about it.
"""

from __future__ import annotations

from dataclasses import dataclass


class LimblocError(Exception):
    """Base of every error that limbloc raises on purpose; the command line prints it without a trace."""


class ConfigError(LimblocError):
    """A parameter is unknown, of the wrong type or out of its bounds."""


class RigError(LimblocError):
    """A rig file or camera calibration is missing, malformed or impossible."""


class InputError(LimblocError):
    """An image, mask, bag, video or folder cannot be used as it is."""


class OutputError(LimblocError):
    """A result or recording cannot be written: the disk is full, no permission, it exists already."""


class Interrupted(LimblocError):
    """Ctrl-C in the middle of long work; the message says what is kept and how to go on."""


@dataclass(frozen=True)
class NoPerson:
    """A frame in which no posture can be given, with the reason in words (never zeros or a silent default)."""

    reason: str
