# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compiling with Numba: records, functions over them, and where compiled code is kept; no other module calls Numba.

Numba alone optimises each function by itself, and once more within every function that calls it: at five levels of
calls five times. Here only what Python calls is optimised, and made machine code; what compiled code calls is a `Part`:
translated, and linked into its callers as it is. What is used of Numba for this beside its documented pipeline is
tested with the oldest and the newest version allowed.

Results are kept in a folder named by a digest of the source of the function and of all that it imports from this
package: a change of a called function can never leave an old result in use, and a copied or upgraded package never
meets the results of another one. The folder lies in the package's own ``__pycache__``, or where that cannot be
written in the user's cache folder, or else in a temporary one that no other user can write. A package folder that is
read-only but was filled beforehand (``fdi compile``) serves as it is.

What is found is run: so folders and files must belong to this user or root, closed to all others (`system.files`).

With ``NUMBA_DISABLE_JIT=1`` everything runs as plain Python: slow, with the same results.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import time
import typing
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.core.caching import IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.extending import intrinsic
from numpy.typing import NDArray

from fdi_ros.system.files import (
    OTHERS,
    DistrustError,
    check_ancestor,
    check_trusted,
    close_to_others,
    lock,
    replacing,
)

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

INTERPRETED = bool(numba.config.DISABLE_JIT)  #: whether everything runs as plain Python
LOG = logging.getLogger("fdi_ros")
# A function over a record takes records that begin with the same fields, too; Numba warns that this is new to it.
warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)

# Records --------------------------------------------------------------------------------------------------------------
# Classes whose annotated fields are a NumPy structured type of fixed size. A field is declared as one line,
# ``name: Real  # unit, meaning``. A type checker sees plain numbers, arrays and other records; `record` makes the dtype
# of the same layout. Records nest, and lists of records are arrays of them.

MAX_CHANNELS = 12
MAX_UNITS = 4

Real = Annotated[float, "f8"]
Whole = Annotated[int, "i8"]
Mask = Annotated[int, "i8"]  #: a set of channels, one bit each
Small = Annotated[int, "u1"]
Flag = Annotated[bool, "u1"]
Vector = Annotated[NDArray[np.float64], "f8", (3,)]
Channels = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS,)]
Axes = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, 3)]
Square = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, MAX_CHANNELS)]
Symmetric = Annotated[NDArray[np.float64], "f8", (6,)]
"""Upper triangle of a symmetric (3, 3) matrix: xx, xy, xz, yy, yz, zz."""
Units = Annotated[NDArray[np.float64], "f8", (MAX_UNITS,)]
Stamps = Annotated[NDArray[np.int64], "i8", (MAX_CHANNELS,)]
Counts = Annotated[NDArray[np.int64], "i8", (MAX_CHANNELS,)]
Flags = Annotated[NDArray[np.uint8], "u1", (MAX_CHANNELS,)]


def record(kind: type[T]) -> type[T]:
    """Give a class of annotated fields the attribute `dtype`, the NumPy type of the same fields."""
    hints = typing.get_type_hints(kind, include_extras=True)
    taken = hints.keys() & set(dir(np.record))
    if taken:
        # In plain Python a record is an np.record: a field may not hide behind an attribute of it.
        raise TypeError(
            f"{kind.__name__} has fields named like attributes of np.record: {', '.join(sorted(taken))}"
        )
    layout = [_field(name, hint) for name, hint in hints.items()]
    kind.dtype = np.dtype(layout, align=True)  # type: ignore[attr-defined]
    return kind


def _field(name: str, hint: Any) -> tuple[Any, ...]:
    if isinstance(getattr(hint, "dtype", None), np.dtype):
        # Another record.
        return (name, hint.dtype)
    about = hint.__metadata__
    if isinstance(about[0], str):
        return (name, *about)
    # A list of records of a fixed length.
    (element,) = typing.get_args(hint.__origin__)
    return (name, element.dtype, about)


def allocate(kind: type, count: int = 1) -> NDArray[Any]:
    """Return records of a class, all zero, (count,)."""
    rows = np.zeros(count, dtype=kind.dtype)  # type: ignore[attr-defined]
    return rows.view(np.recarray) if INTERPRETED else rows


# Compiling ------------------------------------------------------------------------------------------------------------

_PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(
    r"^\s*(?:from\s+(fdi_ros[\w.]*)\s+import|import\s+(fdi_ros[\w.]*))", re.MULTILINE
)
_NAME = "fdi_ros"
_dispatchers: list[Any] = []
_callbacks: list[Callback] = []
_parts: set[Path] = set()  # marks of parts whose callers have not been kept yet


class Part(CompilerBase):  # type: ignore[misc,unused-ignore]
    """Pipeline that translates a function, to be linked into others."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's own pipeline, with a library that code does not run from."""
        self.state.library = _Library(
            self.state.targetctx.codegen(), self.state.func_id.func_qualname
        )
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


class _Library(JITCodeLibrary):  # type: ignore[misc,unused-ignore]
    """Code that is never run by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is no machine code of it."""
        return 0

    @property
    def codegen(self) -> _Library:
        """Itself: Numba tells ``library.codegen`` the environment of the code, which is for code that runs."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Pass it over."""


def compiled(function: F) -> F:
    """Compile a function when it is first called; the compiled result is kept on disk.

    Division by zero gives infinity or NaN, as in NumPy. No fast-math: results do not depend on the processor.
    """
    if INTERPRETED:
        return _quiet(function)
    with _kept(function):
        dispatcher = numba.njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(
            function
        )
    dispatcher._cache._cache_file.__class__ = _Kept
    _call_as_part(dispatcher)
    _dispatchers.append(dispatcher)
    return cast(F, dispatcher)


def _call_as_part(dispatcher: Any) -> None:
    """Have compiled code link a function in as a `Part`, once for all whole numbers instead of for each constant."""
    part = numba.njit(
        pipeline_class=Part,
        error_model="numpy",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
    )(dispatcher.py_func)

    def find(arguments: Any, named: Any) -> Any:
        found = part.get_call_template(
            tuple(numba.types.unliteral(one) for one in arguments),
            {name: numba.types.unliteral(one) for name, one in named.items()},
        )
        _parts.add(_part_path(dispatcher))
        return found

    dispatcher.get_call_template, dispatcher.get_overload = find, part.get_overload


class Callback:
    """A compiled function over records, reached through its address: its callers need not be compiled anew for it."""

    def __init__(
        self, function: Callable[..., None], records: tuple[type, ...]
    ) -> None:
        self.function, self.records = function, records
        self.compiled: Any = None  # once the address was asked for
        _callbacks.append(self)

    def __call__(self, *arguments: Any) -> None:
        """Call the plain Python function; compiled code reaches it by `call`."""
        self.function(*arguments)

    @property
    def address(self) -> int:
        """What `call` takes; compiles the function if that was not done before."""
        if INTERPRETED:
            return _callbacks.index(self)
        if self.compiled is None:
            types = tuple(numba.from_dtype(kind.dtype) for kind in self.records)  # type: ignore[attr-defined]
            # As `numba.cfunc` does, which would load what is kept before it is known whose it is.
            with _kept(self.function):
                compiled: Any = CFunc(
                    self.function,
                    (types, numba.types.void),
                    {},
                    {"error_model": "numpy"},
                )
                compiled.enable_caching()
                compiled._cache._cache_file.__class__ = _Kept
                compiled.compile()
            self.compiled = compiled
        return int(self.compiled.address)


def callback(*records: type) -> Callable[[Callable[..., None]], Callback]:
    """Make a function over records one that `call` reaches through its address."""
    return lambda function: Callback(
        _quiet(function) if INTERPRETED else function, records
    )


def as_input(values: Any, kind: Any) -> NDArray[Any]:
    """Return values as a contiguous array of a kind that can be written: for others all would be compiled once more."""
    array = np.ascontiguousarray(values, dtype=kind)
    return array if array.flags.writeable else array.copy()


def address_of(rows: NDArray[Any]) -> int:
    """Address of the first record; the array must live as long as the address is used."""
    if INTERPRETED:
        _by_address[rows.ctypes.data] = rows
    return int(rows.ctypes.data)


@contextlib.contextmanager
def reported(what: str) -> Iterator[None]:
    """Log one line with the duration if anything is compiled within, and not just loaded."""
    begun, before = time.perf_counter(), compilations()
    yield
    if compilations() > before:
        LOG.warning(
            "compiled %s in %.1f s, once on this machine",
            what,
            time.perf_counter() - begun,
        )


def compilations() -> int:
    """Return how many compilations this process has made so far; what was only loaded does not count."""
    misses = sum(
        sum(dispatcher.stats.cache_misses.values()) for dispatcher in _dispatchers
    )
    return misses + sum(
        one.compiled is not None and one.compiled.cache_hits == 0 for one in _callbacks
    )


def missing() -> int:
    """Count the functions of the modules imported so far that have no compiled result on disk, nor within another's."""
    return sum(
        not (_index_path(one).exists() or _part_path(one).exists())
        for one in _dispatchers
    )


def _index_path(dispatcher: Any) -> Path:
    """Where the results of a function that Python calls are listed."""
    return Path(dispatcher._cache._cache_file._index_path)


def _part_path(dispatcher: Any) -> Path:
    """Empty file that says that a function has become a part of others."""
    return _index_path(dispatcher).with_suffix(".nbp")


# Calling by address -------------------------------------------------------------------------------------------------

_by_address: dict[int, NDArray[Any]] = {}

if INTERPRETED:

    def call(
        address: int,
        constants: int,
        row: int,
        size: int,
        state: int,
        state_size: int,
        sample: Any,
        verdict: Any,
    ) -> None:
        """Call a `Callback`; see the compiled form."""
        _callbacks[address](
            _by_address[constants][row], _by_address[state][row], sample, verdict
        )

else:

    @intrinsic  # type: ignore[untyped-decorator,unused-ignore]
    def call(
        typing: Any,
        address: Any,
        constants: Any,
        row: Any,
        size: Any,
        state: Any,
        state_size: Any,
        sample: Any,
        verdict: Any,
    ) -> Any:
        """Call a `Callback` with row `row` of the constants and of the states at two addresses, and two records."""
        signature = numba.types.void(*[numba.types.intp] * 6, sample, verdict)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer = cgutils.voidptr_t
            where, first, row, size, second, state_size, sample, verdict = arguments
            function = builder.inttoptr(
                where, ir.FunctionType(ir.VoidType(), [pointer] * 4).as_pointer()
            )
            rows = [
                builder.add(first, builder.mul(row, size)),
                builder.add(second, builder.mul(row, state_size)),
            ]
            records = [builder.inttoptr(at, pointer) for at in rows]
            builder.call(
                function,
                [
                    *records,
                    builder.bitcast(sample, pointer),
                    builder.bitcast(verdict, pointer),
                ],
            )
            return context.get_dummy_value()

        return signature, generate


def _quiet(function: F) -> F:
    """Let plain Python divide by zero as compiled code does."""

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*arguments)

    return cast(F, run)


# Where results are kept ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _kept(function: Callable[..., Any]) -> Iterator[None]:
    """Have Numba keep the results of a function decorated within in the folder for its source."""
    before = numba.config.CACHE_DIR
    source = sys.modules[function.__module__].__file__
    assert source is not None
    numba.config.CACHE_DIR = str(folder() / _digest(Path(source)))
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


class _Kept(IndexDataCacheFile):  # type: ignore[misc,unused-ignore]
    """Results of one function, taken in one at a time.

    Numba alone lets two processes that write at once drop each other's results, or give two of them one number, of
    which a third would load the wrong one; and it runs what anybody has put there.
    """

    def save(self, key: Any, data: Any) -> None:
        try:
            self._close()
            with lock(f"{self._index_path}.lock"):
                super().save(key, data)
                while _parts:
                    _parts.pop().touch(0o644)
        except OSError as error:
            LOG.warning(
                "compiled code cannot be kept in %s: %s",
                self._cache_path,
                error.strerror,
            )

    def _load_index(self) -> Any:
        return self._read(self._index_path, super()._load_index) or {}

    def _load_data(self, name: str) -> Any:
        found = self._read(
            self._data_path(name), functools.partial(super()._load_data, name)
        )
        if found is None:
            # What Numba takes for: it is not there.
            raise FileNotFoundError(name)
        return found

    def _read(self, path: str, load: Callable[[], Any]) -> Any:
        try:
            self._close()
            check_trusted(path)
            return load()
        except DistrustError as error:
            LOG.warning(
                "compiled code in %s is not used: %s", error.filename, error.strerror
            )
        except FileNotFoundError:
            pass
        except Exception as error:  # A file that was cut off, or is no pickle at all, may raise anything.
            LOG.warning(
                "compiled code in %s is damaged, and compiled anew: %s",
                path,
                type(error).__name__,
            )
        return None

    def _close(self) -> None:
        """Check that nobody else can write the folder of the function, nor any between it and that of all results."""
        inside, top = Path(self._cache_path), folder()
        for one in (
            inside,
            *(parent for parent in inside.parents if parent.is_relative_to(top)),
        ):
            close_to_others(one)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with super()._open_for_write(filepath) as file:
            os.fchmod(
                file.fileno(), stat.S_IMODE(os.fstat(file.fileno()).st_mode) & ~OTHERS
            )
            yield file
            file.flush()
            os.fsync(file.fileno())


@functools.cache
def folder() -> Path:
    """Folder of all compiled results, writable."""
    version = f"numba-{numba.__version__}-numpy-{np.__version__}{'-checked' if numba.config.BOUNDSCHECK else ''}"
    in_package = _PACKAGE / "__pycache__" / "compiled"
    # Before anything else what the user asked for.
    roots = [Path(numba.config.CACHE_DIR) / _NAME] if numba.config.CACHE_DIR else []
    roots.append(in_package)
    with contextlib.suppress(RuntimeError):
        roots.append(
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / _NAME
        )
    for root in roots:
        if _usable(root, version):
            _take_over(in_package / version, root / version)
            return root / version
    found = _temporary() / version
    _take_over(in_package / version, found)
    LOG.warning(
        "compiled code is kept in %s: neither the package's folder nor a home can be written",
        found,
    )
    return found


def _temporary() -> Path:
    """Folder that no other user can write: compiled code is run as it is found."""
    shared = Path(tempfile.gettempdir()) / f"{_NAME}-{os.getuid()}"
    with contextlib.suppress(OSError):
        shared.mkdir(mode=0o700, exist_ok=True)
        check_trusted(shared)
        if shared.lstat().st_uid == os.getuid():
            return shared
    own = Path(tempfile.mkdtemp(prefix=f"{_NAME}-"))
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def _usable(root: Path, version: str) -> bool:
    """Whether results can be kept in a folder of a root, which are made if need be, and nobody else can write there."""
    path = root / version
    try:
        for folder in (root, path):
            folder.mkdir(parents=True, exist_ok=True)
            close_to_others(folder)
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


def _take_over(prepared: Path, target: Path) -> None:
    """Copy what was compiled beforehand into a package that cannot be written now."""
    if prepared == target:
        return
    for source in prepared.rglob("*.nb?"):
        inside = source.relative_to(prepared)
        copy = target / inside
        if not copy.exists():
            with contextlib.suppress(OSError):
                for one in (
                    prepared.parent,
                    prepared,
                    *(prepared / folder for folder in inside.parents),
                    source,
                ):
                    check_trusted(one)
                copy.parent.mkdir(parents=True, exist_ok=True)
                close_to_others(copy.parent)
                with replacing(copy) as file:
                    file.write(source.read_bytes())


@functools.cache
def _digest(source: Path) -> str:
    """Digest of a module's source and of all that it imports from this package."""
    text = source.read_text(encoding="utf-8")
    found = hashlib.sha256(text.encode())
    for match in _IMPORT.finditer(text):
        imported = _source_of(match[1] or match[2])
        if imported is not None and imported != source:
            found.update(_digest(imported).encode())
    return found.hexdigest()[:16]


def _source_of(module: str) -> Path | None:
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next(
        (one for one in files if one.is_file() and one != _PACKAGE / "__init__.py"),
        None,
    )
