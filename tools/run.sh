#!/usr/bin/env bash
# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# Run a command in .venv with an environment that suits it: tools/run.sh python -m pytest
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
. "$root/tools/environment.sh"
# The environment was made without the system's packages exactly when ROS comes as wheels.
if grep -qs 'include-system-site-packages = false' "$root/.venv/pyvenv.cfg"; then
    clean_environment
fi
export PATH="$root/.venv/bin:$PATH"
exec "$@"
