# SPDX-License-Identifier: Apache-2.0
"""The subcommands of `limbloc`, one module each: `HELP`, `EPILOG`, `add_arguments`, `run`."""
