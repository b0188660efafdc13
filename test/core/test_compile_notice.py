# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is seen of compiling: before it begins, while it goes on, and in no figure of what comes after."""

import contextlib
import fcntl
import os
import re
import shutil
import struct
import subprocess
import sys
import termios
import time

import numba
import pytest

from fdi_ros.compiling import notice as compile_notice
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


def test_the_log_has_a_bar_now_and_then(monkeypatch, caplog):
    monkeypatch.setattr(compile_notice, "LOG_PERIOD", 0.0)
    view = compile_notice.View()
    view.begin()
    for share in (0.0, 0.5, 1.0):
        view.draw(share)
    assert caplog.messages[0] == WORDS
    assert [re.sub(r" \d+ s$", "", line) for line in caplog.messages[1:]] == [
        "compiling   0 % |                    |",
        "compiling  50 % |##########          |",
        "compiling 100 % |####################|",
    ]


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


@pytest.mark.usefixtures("compiled")
def test_nothing_is_missing_once_all_is_compiled(root):
    # In a process of its own: tests compile functions, too.
    count = "import fdi_ros.cli.settings; from fdi_ros.compiling.notice import missing; print(missing())"
    done = subprocess.run([sys.executable, "-c", count], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"


def on_a_terminal(command, folder, **environment):
    """What a command writes to a terminal of 24 lines of 90 characters."""
    terminal, other = os.openpty()
    fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 90, 0, 0))
    process = subprocess.Popen(
        command, stdin=other, stdout=other, stderr=other, cwd=folder, env={**os.environ, **environment}
    )
    os.close(other)
    said = b""
    # Reading a terminal that nobody writes to any more is an error.
    with contextlib.suppress(OSError):
        while part := os.read(terminal, 65536):
            said += part
    os.close(terminal)
    assert process.wait() == 0, said.decode()
    return said.decode()


def test_a_verb_shows_a_bar_before_its_result(tmp_path, root, flight):
    """The first on a machine; of those after it, none."""
    command = [sys.executable, "-m", "fdi_ros.cli", "inspect", str(flight)]
    # Another kind of compiled code than that of the package, which would be taken over.
    environment = {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_BOUNDSCHECK": "1", "TERM": "vt100"}
    before, said, result = on_a_terminal(command, root, **environment).partition("cone_flight: ")
    assert said
    assert before.startswith(WORDS)
    shares = re.findall(r"compiling: +(\d+) %\|", before)
    assert shares
    assert "compiling" not in result
    assert "\ncone_flight: " in on_a_terminal(command, root, **environment)
    assert [*tmp_path.rglob("*.nbi")], "kept in the folder that the user wishes"
    shutil.rmtree(tmp_path)
