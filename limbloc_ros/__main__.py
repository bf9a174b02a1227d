# SPDX-License-Identifier: Apache-2.0
"""`python -m limbloc_ros`."""

from limbloc_ros.cli import main

# Worker processes import this module too, and must not run the command line once more.
if __name__ == "__main__":
    raise SystemExit(main())
