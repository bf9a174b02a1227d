#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Writes requirements/*.lock anew: every package that `make setup` installs, direct or not, with its version and the
# hashes of its files, for Python 3.11 and 3.12 on every platform. Run it after a change of setup.py or of
# requirements/*.txt, and for new releases within their ranges (--upgrade).
set -euo pipefail
cd "$(dirname "$0")/.."
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
python3 -m venv "$tools"
"$tools/bin/python" -m pip install -qq --disable-pip-version-check "uv>=0.9,<1"
for ros in jazzy kilted; do
  "$tools/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
    --custom-compile-command "tools/lock_requirements.sh" --extra dev "$@" \
    "requirements/$ros.txt" requirements/build.txt setup.py --output-file "requirements/$ros.lock"
done
# What `make docs` adds to them.
"$tools/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
  --custom-compile-command "tools/lock_requirements.sh" --extra docs --constraint requirements/jazzy.lock "$@" \
  setup.py --output-file requirements/docs.lock
