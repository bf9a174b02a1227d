# SPDX-License-Identifier: Apache-2.0
"""What a node's process says by its exit code to those who would start it again; 0 is a clean end."""

from __future__ import annotations

#: A node refused its parameters or input: starting again would not help.
REFUSED = 2
#: What it did came to an end before its time, which it has told (a full disk): starting again would not help either,
#: and it is no reason for the others to end.
ENDED = 3
