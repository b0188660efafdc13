#!/usr/bin/env bash
# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# What flies, tested with nothing but what a live node may need and in the versions of Ubuntu 24.04: tools/ubuntu.sh [ARGS]
# In an environment of its own, .venv-ubuntu; numba 0.58 from PyPI runs on Python up to 3.11 (Ubuntu's own on 3.12).
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/environment.sh
clean_environment

libraries=(numpy==1.26.4 numba==0.58.1 PyYAML==6.0.1)
for python in python3.11 python3.10 python3; do
    # Of an environment that is active the interpreter it was made with.
    if python=$("$python" -c 'import sys; print(sys._base_executable); sys.exit(not (3, 10) <= sys.version_info < (3, 12))' \
        2> /dev/null); then
        break
    fi
    python=
done
if [ -z "$python" ]; then
    echo "not run: numba 0.58.1 from PyPI needs Python 3.10 or 3.11, and neither is here" >&2
    exit 0
fi
key=$({ "$python" --version; echo "${libraries[*]}"; cat setup.py; } | cksum | tr -d ' ')
if [ ! -e ".venv-ubuntu/installed-$key" ]; then
    rm -rf .venv-ubuntu
    "$python" -m venv .venv-ubuntu
    ros=$("$python" - << 'PYTHON'
import re
print(*re.findall(r'"(ros-jazzy-[^;"]*)', open("setup.py").read()), sep="\n")
PYTHON
    )
    # hypothesis, pytest: of the tests; there they are python3-hypothesis and python3-pytest.
    # shellcheck disable=SC2086
    .venv-ubuntu/bin/python -m pip install -qq --disable-pip-version-check "${libraries[@]}" $ros pytest hypothesis
    touch ".venv-ubuntu/installed-$key"
fi
# Of the compiler everything but its optimiser, which takes most of the time; then nothing is kept on disk.
export NUMBA_OPT=0 NUMBA_CACHE_DIR=.venv-ubuntu/compiled PYTHONPATH=$PWD
if [ $# = 0 ]; then
    # A monitor fed with messages, a live node, its files, and what the verbs say.
    set -- test/test_libraries.py test/test_files.py test/monitor/test_receiver.py \
        test/test_layers.py::test_a_live_node_imports_nothing_that_is_for_offline_use
fi
exec .venv-ubuntu/bin/python -m pytest -p no:cacheprovider "$@"
