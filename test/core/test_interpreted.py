# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path as plain Python, for a debugger: slow, and the same to the bit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from core.digests import digests


def test_plain_python_gives_the_same_bits(root: Path) -> None:
    environment = os.environ | {
        "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": os.pathsep.join([str(root / "test"), str(root)]),
    }
    command = [sys.executable, "-m", "core.digests"]
    done = subprocess.run(command, env=environment, cwd=root, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    plain = json.loads(done.stdout)
    assert plain["interpreted"]
    assert plain["digests"] == digests()
    assert min(count for _, count in plain["digests"].values()) > 10
