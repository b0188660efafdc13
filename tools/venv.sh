#!/usr/bin/env bash
# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# Bring .venv up to date with setup.py: tools/venv.sh EXTRAS [PYTHON [compile]]
# compile: what every sample passes through is compiled while the larger part of the packages, ROS, is fetched.
# In a shell with ROS 2 Jazzy sourced the environment sees that ROS; elsewhere ROS comes as wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/environment.sh

extras=$1
python=$(find_python "${2:-}")
mode=$(ros_mode "$python")
if [ "$mode" = wheels ]; then
    clean_environment
    extras="ros,$extras"
fi
extras=${extras%,}

# An environment belongs to one interpreter, one place and one set of requirements.
key=$({ "$python" -c 'import sys; print(sys.version, sys.base_prefix)'; echo "$PWD $mode"; cat setup.py; } | cksum | tr -d ' ')
stamp=.venv/installed-$key
# What begins a longer list that was installed is there already.
if grep -qsE "^$extras(,|$)" "$stamp"; then
    exit 0
fi
echo "installing fdi_ros${extras:+[$extras]} into .venv ($("$python" --version), ROS from $mode); once, about a minute" >&2
if [ ! -e "$stamp" ]; then
    rm -rf .venv
    site=()
    [ "$mode" = wheels ] || site=(--system-site-packages)
    "$python" -m venv "${site[@]}" .venv || {
        rm -rf .venv
        echo "cannot make a virtual environment with $python: on Debian and Ubuntu, apt install python3-venv" >&2
        exit 1
    }
fi
# Settings that would send the packages elsewhere.
unset PIP_USER PIP_TARGET PIP_PREFIX PIP_ROOT PIP_REQUIRE_VIRTUALENV
# --no-compile: what is imported is compiled then; all else, most of it, would take ten seconds of a first start.
install() {
    .venv/bin/python -m pip install -qq --no-compile --disable-pip-version-check "$@"
}
# What builds the package is fetched once, and not for each of two builds: 5 s of CPU less.
install "setuptools>=64" wheel
if [ "${3:-}" = compile ]; then
    install --no-build-isolation --editable .
    .venv/bin/python -m fdi_ros.cli compile --detector sequential &
fi
install --no-build-isolation --editable ".${extras:+[$extras]}"
# Whether it could be compiled shows when it is used.
wait
echo "$extras" >> "$stamp"
