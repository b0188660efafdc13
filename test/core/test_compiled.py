# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where compiled code is kept, that nothing of it can stop a start, and what is seen of compiling."""

import itertools
import os
import pickle
import re
import shutil
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.typing.typeof import typeof

from fdi_ros.compiling import notice
from fdi_ros.compiling.cache import Kept as _Kept
from fdi_ros.compiling.compiled import Part, type_of
from fdi_ros.compiling.notice import COMPILING, announced, refused
from fdi_ros.errors import FdiError

SCRIPT = """
import logging, sys
logging.basicConfig(stream=sys.stdout, format="%(message)s")
from fdi_ros.compiling.cache import folder
from fdi_ros.compiling.compiled import allocate, compilations
from fdi_ros.core.decision import clear_declarations
from fdi_ros.core.records import Core
from fdi_ros.detectors.papers.single_fault import judge_sums
core = allocate(Core)
core["settings"]["n"], core["settings"]["window"] = 6, 8
core["decision"]["faulty"] = core["decision"]["ambiguous"] = 5
clear_declarations(core)
judge_sums.address
if compilations():
    print("compiled it")
if "numba.np.linalg" in sys.modules:
    print("loaded the compiler")
print("kept in", folder())
print("says", core["decision"]["faulty"][0], core["decision"]["ambiguous"][0])
"""


def place(folder, package):
    """A copy of the package that nothing was compiled in, beside a home and a folder for temporary files."""
    leave_out = shutil.ignore_patterns("__pycache__")
    shutil.copytree(package / "fdi_ros", folder / "copy" / "fdi_ros", ignore=leave_out)
    (folder / "home").mkdir()
    (folder / "temporary").mkdir()
    return folder / "copy"


@pytest.fixture
def copy(tmp_path, root):
    return place(tmp_path, root)


@pytest.fixture(scope="module")
def started(tmp_path_factory, root):
    """A copy in which two were started for the first time at once, what came of them, and a copy of all."""
    folder = tmp_path_factory.mktemp("started")
    package = place(folder / "at", root)
    both = [start(package), start(package)]
    outcomes = [outcome(process) for process in both]
    shutil.copytree(folder / "at", folder / "kept")
    return package, outcomes, folder / "kept"


@pytest.fixture
def warm(started):
    """That copy as it was then, which a test may change, and where its results are: they belong to its place."""
    package, outcomes, original = started
    shutil.rmtree(package.parent)
    shutil.copytree(original, package.parent)
    return package, outcomes[0][0]


WHERE = """
import logging, sys
logging.basicConfig(stream=sys.stdout, format="%(message)s")
from fdi_ros.compiling.cache import folder
print("kept in", folder())
print("says nothing")
"""


def start(copy, script=SCRIPT, **environment):
    place = {
        "PYTHONPATH": str(copy),
        "HOME": str(copy.parent / "home"),
        "TMPDIR": str(copy.parent / "temporary"),
    }
    inherited = {
        k: v
        for k, v in os.environ.items()
        if k not in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
    }
    env, out = (
        {**inherited, **place, **environment},
        {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT},
    )
    return subprocess.Popen(
        [sys.executable, "-B", "-c", script], env=env, cwd=copy, text=True, **out
    )


def outcome(process):
    """Where it keeps what it compiles, what it says, and its whole output."""
    output = process.communicate(timeout=300)[0]
    assert process.returncode == 0, output
    assert "Traceback" not in output
    lines = dict(
        line.split(" ", 1)
        for line in output.splitlines()
        if line.startswith(("kept", "says"))
    )
    return Path(lines["kept"].removeprefix("in ")), lines["says"], output


def test_first_starts_at_once_then_a_load(started, warm):
    copy, made = warm
    assert made.is_relative_to(copy / "fdi_ros" / "__pycache__")
    first, second = started[1]
    assert first[:2] == second[:2] == (made, "0 0")
    # The slower one may have found all that the faster one had kept.
    assert "compiled it" in first[2] + second[2]
    third = outcome(start(copy))
    assert third[:2] == (made, "0 0")
    assert "compiled it" not in third[2]
    # What only the compiler needs takes longer to load than all results.
    assert "loaded the compiler" in first[2] + second[2]
    assert "loaded the compiler" not in third[2]
    for path in made.rglob("*.nbc"):
        (_, _, (machine_code, names)), *_ = pickle.loads(path.read_bytes())
        assert len(names) < 0.5 * len(machine_code), "intermediate code is not kept"


class Pair(NamedTuple):
    one: np.ndarray
    other: float


def test_types_of_arguments_are_those_of_numba():
    fields = [("a", "u1"), ("b", "f8")]
    aligned = np.zeros(2, np.dtype(fields, align=True))
    frozen = aligned.copy()
    frozen.flags.writeable = False
    # Equal for NumPy, and another type for Numba.
    places = {"names": ["a", "b"], "formats": ["u1", "f8"], "offsets": [0, 8]}
    placed = np.zeros(2, np.dtype({**places, "itemsize": 16}))
    assert placed.dtype == aligned.dtype
    for value in (
        aligned,
        frozen,
        placed,
        aligned[::2],
        aligned.reshape(1, 2),
        aligned["b"],
        Pair(aligned, 1.0),
        (aligned, (placed, 3)),
        (aligned, aligned),
        b"bytes",
        True,
    ):
        assert type_of(value) == typeof(value), value


class Passes(event.Listener):
    """Remembers the passes of Numba, and the types of arguments as they are written."""

    def __init__(self):
        self.names, self.arguments = [], set()

    def on_start(self, event):
        self.names.append(event.data["name"].partition(" ")[0])
        self.arguments.add(event.data["args"])

    def on_end(self, event):
        pass


def test_a_part_goes_through_the_passes_that_it_needs_alone():
    """They, and the types of large records that each writes out, take most of the time."""
    part = numba.njit(pipeline_class=Part, no_cpython_wrapper=True)(lambda x: x + 1.0)
    with event.install_listener("numba:run_pass", Passes()) as passes:
        part.compile((numba.float64,))
    assert len(passes.names) <= 14
    assert {"reconstruct_ssa", "native_lowering"} <= set(passes.names)
    assert passes.arguments == {"types of arguments"}


def test_what_was_prepared_is_taken_over_where_the_installation_cannot_be_written(warm):
    """An image: compiled when it was built, started by a user who can write nothing there and has no home."""
    copy, made = warm
    # Prepared results are there, and no new file can be made among them: even root cannot replace this.
    subprocess.run(["chattr", "+i", str(made)], check=False, capture_output=True)
    try:
        (made / "probe").write_text("")
    except OSError:
        kept, _, output = outcome(start(copy, HOME="/proc/nothing"))
    else:
        pytest.skip("this file system has no immutable folders")
    finally:
        subprocess.run(["chattr", "-i", str(made)], check=False, capture_output=True)
    assert kept.is_relative_to(copy.parent / "temporary")
    assert "compiled it" not in output


def test_installation_that_cannot_be_written(copy):
    """The results go to the home, without one to a temporary folder that nobody else can write."""
    # A file is where a folder would be, which fails for every user, root too.
    (copy / "fdi_ros" / "__pycache__").write_text("")
    home = outcome(start(copy, WHERE))[0]
    assert home.is_relative_to(copy.parent / "home" / ".cache" / "fdi_ros")
    # Nor a home, whatever the umask.
    before = os.umask(0)
    try:
        kept, _, output = outcome(start(copy, HOME="/proc/nothing"))
        assert "compiled it" in output
        assert "compiled it" not in outcome(start(copy, HOME="/proc/nothing"))[2]
    finally:
        os.umask(before)
    assert kept.is_relative_to(copy.parent / "temporary")
    assert stat.S_IMODE(kept.parent.stat().st_mode) == 0o700
    assert f"compiled code is kept in {kept}" in output
    for one in (kept, *kept.rglob("*.nb?")):
        assert not one.stat().st_mode & 0o022, one
    # A folder that others can write may hold what they like: it is not used.
    kept.parent.chmod(0o777)
    other = outcome(start(copy, WHERE, HOME="/proc/nothing"))[0]
    assert other.parent != kept.parent


class Planted:
    """What a stranger leaves among the results: loaded, it runs."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def plant(index, mark, what):
    """Put there what is run where it is loaded, as somebody else could have."""
    index.write_bytes(pickle.dumps(Planted(mark)))
    if what == "open to all":
        index.chmod(0o666)
    if what == "a link":
        index.symlink_to(index.rename(index.parent.parent / index.name))
    if what == "a stranger's":
        os.chown(index, 54321, 0)


def skip_unless_root(what):
    if "stranger" in what and os.geteuid() != 0:
        pytest.skip("only root can give a file to another user")


@pytest.mark.parametrize("what", ["mine", "open to all", "a link", "a stranger's"])
def test_a_file_that_somebody_else_may_have_put_there_is_not_loaded(
    what, tmp_path, said
):
    skip_unless_root(what)
    inside, mark = tmp_path / "cache", tmp_path / "mark"
    inside.mkdir()
    _Kept(str(inside), "function", "stamp").save("key", "data")
    (index,) = inside.glob("*.nbi")
    plant(index, mark, what)
    assert _Kept(str(inside), "function", "stamp").load("key") is None
    # What this user has put there is run: that is how the others would be.
    assert mark.exists() == (what == "mine")
    assert any("is not used: " in line for line in said.messages) == (what != "mine")


@pytest.mark.parametrize("what", ["open to all", "a stranger's folder"])
def test_code_that_somebody_else_may_have_put_there_is_not_run(warm, what):
    skip_unless_root(what)
    copy, made = warm
    mark = copy.parent / "mark"
    for index in made.rglob("*.nbi"):
        plant(index, mark, what)
    if what == "a stranger's folder":
        for folder in (made, made.parent):
            os.chown(folder, 54321, 0)
    kept, says, output = outcome(start(copy))
    assert not mark.exists()
    assert says == "0 0"
    assert "is not used: " in output
    assert (kept == made) == (what == "open to all")
    if what == "open to all":
        # What it has compiled anew is its own.
        assert "is not used: " not in outcome(start(copy))[2]
        assert not mark.exists()


def test_a_change_of_a_called_function_is_compiled(warm):
    """Numba alone looks at the file of the caller only."""
    copy, _ = warm
    assert "compiled it" not in outcome(start(copy))[2]
    source = copy / "fdi_ros" / "core" / "decision.py"
    text = source.read_text()
    line = (
        "decision.faulty = decision.ambiguous = decision.voted = decision.suspicion = 0"
    )
    assert line in text
    source.write_text(text.replace(line, "decision.faulty = decision.suspicion = 0"))
    assert outcome(start(copy))[1] == "0 5"


def test_results_kept_at_the_same_time_do_not_drop_each_other(tmp_path):
    kept = [_Kept(str(tmp_path), "function", "stamp") for _ in range(4)]
    keys = list(itertools.product(range(len(kept)), range(20)))
    with ThreadPoolExecutor(len(kept)) as threads:
        list(threads.map(lambda key: kept[key[0]].save(key, str(key)), keys))
    assert [kept[0].load(key) for key in keys] == [str(key) for key in keys]


@pytest.fixture
def said(caplog):
    """What is logged: a verb that another test ran may have been told to be quiet."""
    caplog.set_level("INFO", logger="fdi_ros")
    return caplog


def test_results_that_cannot_be_kept_are_said_and_stop_nothing(tmp_path, said):
    _Kept(str(tmp_path / "gone"), "function", "stamp").save("key", "data")
    assert said.messages == [
        f"compiled code cannot be kept in {tmp_path / 'gone'}: No such file or directory"
    ]


@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"stamp", bytes(range(256))])
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_results_that_were_cut_off_are_made_anew(kind, content, tmp_path):
    kept = _Kept(str(tmp_path), "function", "stamp")
    kept.save("key", "data")
    for path in tmp_path.glob(f"*.{kind}"):
        path.write_bytes(content)
    again = _Kept(str(tmp_path), "function", "stamp")
    assert again.load("key") is None
    again.save("key", "data")
    assert _Kept(str(tmp_path), "function", "stamp").load("key") == "data"


def test_a_planted_lock_is_neither_followed_nor_waited_for(tmp_path):
    victim, inside = tmp_path / "victim", tmp_path / "cache"
    victim.write_text("precious")
    inside.mkdir()
    kept = _Kept(str(inside), "function", "stamp")
    lock = Path(f"{kept._index_path}.lock")
    lock.symlink_to(victim)
    kept.save("key", "data")
    assert victim.read_text() == "precious"
    lock.unlink()
    os.mkfifo(lock)
    kept.save("key", "data")
    assert kept.load("key") == "data"


# What is seen of compiling -------------------------------------------------------------------------------------------


PROGRESS = r"compiling: functions done: \d+"


def new_function():
    """One that no call has compiled yet."""
    return numba.njit(lambda x: x + 1)


def test_compiling_is_announced_before_or_refused(said):
    one, two = new_function(), new_function()
    with announced():
        one(1)
    assert said.messages == [COMPILING]
    with announced(), refused("no"):
        one(1)
    with pytest.raises(FdiError, match=r"^not now$"), refused("not now"):
        two(1)
    assert two(1) == 2
    assert said.messages == [COMPILING]


def test_progress_of_compiling_is_logged_only_where_it_grew(said, monkeypatch):
    asked = threading.Event()
    counts = iter([0, 1, 1, 1, 2, 2, 2])

    def done():
        count = next(counts, None)
        if count is None:
            asked.set()
        return set("abcd"[: 2 if count is None else count])

    soon = notice._REPORTS._replace(first=0.0, period=0.0)
    monkeypatch.setattr(notice, "_REPORTS", soon)
    monkeypatch.setattr(notice, "missing", lambda: set("abcd"))
    with notice.progress_logged(set("abcd"), done, needs_all=False):
        asked.wait()
    assert said.messages == [
        COMPILING,
        "compiling: functions done: 1",
        "compiling: functions done: 2",
    ]


def test_a_verb_says_it_before_its_result(tmp_path, root, flight):
    """The first on a machine; those after it say nothing."""
    # `convert` compiles the least of all verbs.
    command = [sys.executable, "-m", "fdi_ros.cli", "convert", str(flight)]
    # Another kind of compiled code than that of the package, which would be taken over.
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path),
        "NUMBA_BOUNDSCHECK": "1",
    }
    for said, output in (([COMPILING], "first"), ([], "later")):
        done = subprocess.run(
            [*command, "--output", str(tmp_path / output)],
            capture_output=True,
            text=True,
            check=False,
            cwd=root,
            env=environment,
        )
        assert done.returncode == 0
        # On a busy machine the verb says how far it is.
        lines = [
            line
            for line in done.stderr.splitlines()
            if not re.search("% done|so far", line)
        ]
        assert lines[:1] == said
        assert all(re.fullmatch(PROGRESS, line) for line in lines[1:])
        assert done.stdout.endswith(f"wrote {tmp_path / output}\n")
        assert [*tmp_path.rglob("*.nbi")], "kept in the folder that the user wishes"
