#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Makes the virtual environment that the Makefile's targets use: setup_venv.sh VENV ROS_DISTRIBUTION
# Says which apt packages are missing, and installs them when it may (as root, or with a sudo that asks nothing).
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$1
ros=$2

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }
die() {
  say "setup: $*"
  exit 1
}

[ "$(uname -s)" = Linux ] || die "expected Linux (the ROS 2 wheels are built for it), this is $(uname -s); use a container"
[ "$(uname -m)" = x86_64 ] || die "expected x86_64 (the ROS 2 wheels are built for it), this is $(uname -m); install ROS 2 by apt and see README.md"

# An interpreter the ROS 2 wheels and numba exist for, the best tried first.
usable() { command -v "$1" >/dev/null && "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; }
find_python() {
  local name
  for name in ${PYTHON:-} python3.12 python3.11 python3; do
    if usable "$name"; then
      echo "$name"
      return
    fi
  done
}

# A package that apt does not know ends the script with apt's own message.
install_apt() {
  local sudo=""
  if [ "$(id -u)" -ne 0 ]; then
    if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
      sudo="sudo -n"
    else
      die "missing apt packages: $*. Install them with   sudo apt-get install $*   and run make again"
    fi
  fi
  command -v apt-get >/dev/null || die "missing: $*, and there is no apt-get here; install them in your system's way"
  say "setup: installing apt packages: $*"
  $sudo apt-get update -qq
  $sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
}

python=$(find_python)
if [ -z "$python" ]; then
  [ -z "${PYTHON:-}" ] || die "PYTHON=$PYTHON is not a Python 3.11 or 3.12"
  install_apt python3 python3-venv
  python=$(find_python)
  [ -n "$python" ] || die "expected Python 3.11 or 3.12, found $(python3 --version); Debian 12 and Ubuntu 24.04 have one"
fi
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
  install_apt "python$version-venv"
fi

say "setup: Python $version and ROS 2 $ros into $venv (about a minute, 400 MB, the first time)"
"$python" -m venv "$venv"
# Every file that pip takes must have a hash in the lock (tools/lock_requirements.sh). Then we ourselves: -e, so that
# tests and demo run what stands in the source tree.
pip=("$venv/bin/python" -m pip install -qq --disable-pip-version-check)
"${pip[@]}" --require-hashes -r "requirements/$ros.lock"
"${pip[@]}" --no-deps --no-build-isolation -e .
"$venv/bin/python" -c 'import cv2, numba, rclpy' || die "the installed packages cannot be imported; remove $venv and try again"
# /tf: the wheels lack its message. Nothing else needs that, so that no failure here ends the setup.
if built=$("$venv/bin/python" tools/build_tf2_msgs.py 2>&1); then
  say "setup: TF is there: ${built##*$'\n'}"
else
  say "setup: there will be no /tf; everything else works. ${built##*$'\n'}"
  say "setup: try again with   $venv/bin/python tools/build_tf2_msgs.py"
fi
say "setup: done"
