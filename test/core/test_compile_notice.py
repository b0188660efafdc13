# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is seen of compiling: before it begins, while it goes on, and in no figure of what comes after."""

import os
import re
import subprocess
import sys
import time

import numba
import pytest

from fdi_ros.compiling.notice import WORDS, announced, clock, compiling_seconds, refused
from fdi_ros.errors import FdiError


def new_function():
    """One that no call has compiled yet."""
    return numba.njit(lambda x: x + 1)


def test_compiling_is_announced_before_or_refused(caplog):
    one, two = new_function(), new_function()
    with announced():
        one(1)
    assert caplog.messages == [WORDS]
    with announced(), refused("no"):
        one(1)
    with pytest.raises(FdiError, match=r"^not now$"), refused("not now"):
        two(1)
    assert two(1) == 2
    assert caplog.messages == [WORDS]


def test_the_clock_of_a_replay_stands_still_while_anything_is_compiled():
    wall, own, compiled = time.perf_counter(), clock(), compiling_seconds()
    new_function()(1)
    spent = compiling_seconds() - compiled
    assert spent > 0
    assert clock() - own <= time.perf_counter() - wall - spent
    with pytest.raises(FdiError), refused("no"):
        new_function()(1)
    before = compiling_seconds()
    assert compiling_seconds() == before


def test_a_verb_says_it_before_its_result(tmp_path, root, flight):
    """The first on a machine; those after it say nothing."""
    command = [sys.executable, "-m", "fdi_ros.cli", "inspect", str(flight)]
    # Another kind of compiled code than that of the package, which would be taken over.
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_BOUNDSCHECK": "1"}
    for said in (WORDS, ""):
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root, env=environment)
        first, _, rest = done.stderr.partition("\n")
        assert first == said
        assert all(re.fullmatch(r"compiling +\d+ % \|[# ]{20}\| \d+ s", line) for line in rest.splitlines())
        assert done.stdout.startswith("READY: ")
        assert [*tmp_path.rglob("*.nbi")], "kept in the folder that the user wishes"
