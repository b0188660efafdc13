# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cache of compiled code on disk: where results lie, when they are valid, whose files are trusted.

A result depends on the source of its function, on every module of this package which that source imports, on Numba,
NumPy, the minor version of Python and the target processor. The key holds them all, and neither path nor time: a
copied or installed package finds its results, and a changed one never meets old results.

The target is x86-64-v2 on processors of that level (all but the oldest), else the plain instruction set. So code that
was compiled on one computer runs on every other one. ``NUMBA_CPU_NAME`` chooses another target. Numba has one
target for a process, which holds for the user's own functions, too.

Three folders are searched. New results go to the first:

1. a writable one: below ``NUMBA_CACHE_DIR`` if set, else in the ``__pycache__`` of the package, in the cache
   folder of the user, or in a temporary one,
2. the ``__pycache__`` of the package, which ``fdi compile`` may have filled before the package became read-only,
3. `SHIPPED`, which the build of the package fills (``setup.py``).

Compiled code runs as found. The first folder must be closed to all other users (`fdi_ros.system.files`). The
others are part of the package: a file there is trusted if no more users can write the file than the modules.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import logging
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import binding
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
)
from numba.core.runtime.nrt import rtsys

from fdi_ros.system.files import (
    WRITABLE_BY_OTHERS,
    DistrustError,
    check_ancestor,
    check_trusted,
    close_to_others,
    lock,
)

LOG = logging.getLogger("fdi_ros")
PACKAGE = Path(__file__).resolve().parents[1]
IN_PACKAGE = PACKAGE / "__pycache__" / "compiled"
SHIPPED = PACKAGE / "prebuilt"
X86_64_V2 = ("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3")
"""Features, by their names in LLVM, of the level x86-64-v2 of the processor supplement to the System V ABI."""
_NAME = "fdi_ros"
_IMPORT = re.compile(
    r"^\s*(?:from\s+(fdi_ros[\w.]*)\s+import|import\s+(fdi_ros[\w.]*))", re.MULTILINE
)


def choose_target() -> None:
    """Have Numba compile for a target that other processors have, too, unless the user has chosen one."""
    if numba.config.CPU_NAME is not None or numba.config.CPU_FEATURES is not None:
        return
    numba.config.CPU_NAME = "generic"
    numba.config.CPU_FEATURES = ""
    if platform.machine() == "x86_64":
        features = binding.get_host_cpu_features()
        if all(features.get(name) for name in X86_64_V2):
            numba.config.CPU_NAME = "x86-64-v2"


choose_target()

# Results of one function --------------------------------------------------------------


class _Locator:
    """Answers what Numba asks about the place of a function's results."""

    def __init__(self, function: Callable[..., Any], source: str) -> None:
        self._py_file = source
        self._digest = _digest(Path(source))
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], _: str) -> _Locator:
        """Return the locator of a function."""
        source = sys.modules[function.__module__].__file__
        assert source is not None
        return cls(function, source)

    def get_cache_path(self) -> str:
        """Folder that takes the results."""
        return str(folder() / self._digest)

    def get_source_stamp(self) -> str:
        """Return the part of the key that stands for the sources."""
        return self._digest

    def get_disambiguator(self) -> str:
        """Tell functions of one name in one file apart."""
        return str(self._line)

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        with contextlib.suppress(OSError):
            os.makedirs(self.get_cache_path(), exist_ok=True)


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc,unused-ignore]
    _locator_classes = [_Locator]  # noqa: RUF012, a plain list in Numba

    def reduce(self, result: Any) -> Any:
        """Return what is kept of a result: its machine code, and of its intermediate code the names alone.

        Numba links the intermediate code into compiled callers. Here a `Part` is linked instead, and to parse
        half of each file again would take a quarter of the time of a start.
        """
        library, about, *rest = result._reduce()
        name, kind, (machine_code, _) = library
        called = (
            about.llvm_func_name,
            about.llvm_cpython_wrapper_name,
            about.llvm_cfunc_wrapper_name,
        )
        stubs = "".join(f'define void @"{one}"() {{ ret void }}\n' for one in called)
        names = binding.parse_assembly(stubs).as_bitcode()
        return ((name, kind, (machine_code, names)), about, *rest)


class Results(FunctionCache):  # type: ignore[misc,unused-ignore]
    """Numba's cache of a function, with the folders and the trust of this module."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = Kept(
            self._cache_path,
            self._impl.filename_base,
            self._impl.locator.get_source_stamp(),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kept result for a signature, None if there is none.

        Numba's own method first loads all that only compiling needs, SciPy among it: 0.4 s of CPU in every process.
        The compiler loads it by itself. Machine code needs the run-time library only.
        """
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)

    def mark(self) -> Path:
        """Return the empty file which records that the function was linked into kept results of others."""
        return Path(self._cache_file._index_path).with_suffix(".nbp")

    def exist(self) -> bool:
        """Return whether any folder has results of the function, or its mark."""
        names = (self._cache_file._index_name, self.mark().name)
        inside = Path(self._cache_path).name
        return any(
            (place / inside / name).exists() for place in _places() for name in names
        )


class _Files(IndexDataCacheFile):  # type: ignore[misc,unused-ignore]
    """Index and results of one function in one folder. Files that are not trusted or damaged count as absent."""

    def check(self, path: str) -> None:
        """Raise `DistrustError` unless a file is trusted, `OSError` if none exists."""
        raise NotImplementedError

    def _load_index(self) -> Any:
        return self._read(self._index_path, super()._load_index) or {}

    def _load_data(self, name: str) -> Any:
        load = functools.partial(super()._load_data, name)
        found = self._read(self._data_path(name), load)
        if found is None:
            # Numba then takes the result for missing.
            raise FileNotFoundError(name)
        return found

    def _read(self, path: str, load: Callable[[], Any]) -> Any:
        try:
            self.check(path)
            return load()
        except DistrustError as error:
            LOG.warning(
                "compiled code in %s is not used: %s", error.filename, error.strerror
            )
        except (FileNotFoundError, NotADirectoryError):
            pass
        except Exception as error:  # Unpickling a damaged file may raise anything.
            LOG.warning(
                "compiled code in %s is damaged, and compiled anew: %s",
                path,
                type(error).__name__,
            )
        return None


class _OfPackage(_Files):
    """Files in a folder of the package that is only read."""

    def check(self, path: str) -> None:
        check_as_package(Path(path))


class Kept(_Files):
    """Files in the writable folder, and behind them those of the package.

    Numba's own class lets two processes that write at once drop each other's results, or give two results one number,
    of which a third process would load the wrong one. Here a lock is held.
    """

    new_marks: set[Path] = set()  # noqa: RUF012, shared: of parts whose callers are not kept yet

    def load(self, key: Any) -> Any:
        """Return the result for a key, None if no folder has one."""
        found = super().load(key)
        inside = Path(self._cache_path).name
        base = self._index_name.removesuffix(".nbi")
        for place in _places()[1:]:
            if found is None:
                other = _OfPackage(str(place / inside), base, self._source_stamp)
                found = other.load(key)
        return found

    def save(self, key: Any, data: Any) -> None:
        """Keep a result. A failed write is logged, and stops nothing."""
        try:
            self._close()
            with lock(f"{self._index_path}.lock"):
                super().save(key, data)
                while self.new_marks:
                    mark = self.new_marks.pop()
                    mark.parent.mkdir(exist_ok=True)
                    mark.touch(0o644)
        except OSError as error:
            LOG.warning(
                "compiled code cannot be kept in %s: %s",
                self._cache_path,
                error.strerror,
            )

    def check(self, path: str) -> None:
        """See `_Files.check`."""
        self._close()
        check_trusted(path)

    def _close(self) -> None:
        """Check that no other user can write the folder of the function, or one between it and the top folder."""
        inside = Path(self._cache_path)
        top = folder()
        above = [one for one in inside.parents if one.is_relative_to(top)]
        for one in (inside, *above):
            close_to_others(one)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with super()._open_for_write(filepath) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            os.fchmod(file.fileno(), mode & ~WRITABLE_BY_OTHERS)
            yield file
            file.flush()
            os.fsync(file.fileno())


def check_as_package(path: Path) -> None:
    """Check that a file in the package can be written by no more users than this module.

    Raise `DistrustError` if not, or if not for a folder above in the package, `OSError` without such a file.
    """
    module = os.stat(__file__)
    for one in (path, *path.parents):
        if one == PACKAGE:
            return
        about = os.lstat(one)
        if stat.S_ISLNK(about.st_mode):
            raise DistrustError(one, "it is a link")
        if about.st_uid not in (0, os.geteuid(), module.st_uid):
            raise DistrustError(one, f"it belongs to another user ({about.st_uid})")
        more = about.st_mode & WRITABLE_BY_OTHERS & ~module.st_mode
        other_group = about.st_gid != module.st_gid and about.st_mode & stat.S_IWGRP
        if more or other_group:
            mode = stat.S_IMODE(about.st_mode)
            raise DistrustError(
                one, f"others can write it, and not the modules (mode {mode:o})"
            )


# Folders --------------------------------------------------------------------------------


def _version() -> str:
    """Name of the folder of results that fit the libraries, the target and the way of compiling of this process."""
    target = str(numba.config.CPU_NAME)
    if numba.config.CPU_FEATURES:
        features = hashlib.sha256(str(numba.config.CPU_FEATURES).encode())
        target += f"-{features.hexdigest()[:8]}"
    checked = "-checked" if numba.config.BOUNDSCHECK else ""
    return f"numba-{numba.__version__}-numpy-{np.__version__}-{target}{checked}"


def _places() -> list[Path]:
    """Folders that are searched, the writable one first."""
    others = (IN_PACKAGE / _version(), SHIPPED / _version())
    return [folder(), *(one for one in others if one != folder())]


@functools.cache
def folder() -> Path:
    """Writable folder of all results of this process's version."""
    # Before anything else what the user asked for.
    roots = [Path(numba.config.CACHE_DIR) / _NAME] if numba.config.CACHE_DIR else []
    roots.append(IN_PACKAGE)
    with contextlib.suppress(RuntimeError):
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        roots.append(Path(home) / _NAME)
    for root in roots:
        if _usable(root):
            return root / _version()
    found = _temporary() / _version()
    LOG.warning(
        "compiled code is kept in %s: neither the package's folder nor a home can be written",
        found,
    )
    return found


def _temporary() -> Path:
    """Return a temporary folder that no other user can write."""
    shared = Path(tempfile.gettempdir()) / f"{_NAME}-{os.getuid()}"
    with contextlib.suppress(OSError):
        shared.mkdir(mode=0o700, exist_ok=True)
        check_trusted(shared)
        if shared.lstat().st_uid == os.getuid():
            return shared
    own = Path(tempfile.mkdtemp(prefix=f"{_NAME}-"))
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def _usable(root: Path) -> bool:
    """Return whether this user alone can keep results below a root. Make the folders if need be."""
    path = root / _version()
    try:
        for one in (root, path):
            one.mkdir(parents=True, exist_ok=True)
            close_to_others(one)
        for above in root.resolve().parents:
            check_ancestor(above)
        with tempfile.TemporaryFile(dir=path):
            return True
    except DistrustError as error:
        LOG.warning(
            "compiled code in %s is not used: %s", error.filename, error.strerror
        )
    except OSError:
        pass
    return False


def ship(package: Path) -> None:
    """Copy the kept results that fit the present sources into a copy of the package, as its `SHIPPED` folder."""
    target = package / SHIPPED.name
    shutil.rmtree(target, ignore_errors=True)
    for digest in {_digest(source) for source in PACKAGE.rglob("*.py")}:
        if (folder() / digest).is_dir():
            shutil.copytree(
                folder() / digest,
                target / _version() / digest,
                ignore=shutil.ignore_patterns("*.lock"),
            )


# Digest of the sources --------------------------------------------------------------------


@functools.cache
def _digest(source: Path) -> str:
    """Digest of a module's source and of all its imports from this package."""
    text = source.read_text(encoding="utf-8")
    found = hashlib.sha256(text.encode())
    for match in _IMPORT.finditer(text):
        imported = _source_of(match[1] or match[2])
        if imported is not None and imported != source:
            found.update(_digest(imported).encode())
    return found.hexdigest()[:16]


def _source_of(module: str) -> Path | None:
    """Return the file of a module of the package, None for the package itself and for names of other kinds."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next(
        (one for one in files if one.is_file() and one != PACKAGE / "__init__.py"),
        None,
    )
