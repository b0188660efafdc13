# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compiling with Numba: functions, and the records they work on. With `cache` the only module that calls Numba.

Numba optimises each function by itself, and again within every function that calls it: at five levels of calls, five
times. Here only functions that Python calls are optimised and made machine code. A function that compiled code calls is
a `Part`: translated once and linked into its callers. The private interfaces of Numba that this needs are tested
with the oldest and the newest version allowed.

`cache` keeps the results on disk. With ``NUMBA_DISABLE_JIT=1`` everything runs as plain Python: slowly, with the same
results.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
import typing
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager
from numba.core.typing.typeof import typeof
from numba.extending import intrinsic
from numba.np.numpy_support import map_layout
from numpy.typing import NDArray

from fdi_ros.compiling.cache import Kept, Results

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

INTERPRETED = bool(numba.config.DISABLE_JIT)
"""Whether everything runs as plain Python."""
LOG = logging.getLogger("fdi_ros")
# Functions over a record accept longer records that begin with the same fields: Numba
# calls this experimental.
warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)

# Records --------------------------------------------------------------------------------
# A record is a class whose annotated fields form a NumPy structured type. Each field is
# one line, ``name: Real  # unit, meaning``. Type checkers see plain numbers, arrays and
# other records. Records nest. A list of records is an array.

# Compiled records have fixed sizes: more than 12 channels would cost everybody time.
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


# Compiling ----------------------------------------------------------------------------
# --------------------------------

_dispatchers: list[Any] = []
_callbacks: list[Callback] = []


UNUSED_PASSES = {
    "WithLifting",
    "InlineClosureLikes",
    "MakeFunctionToJitFunction",
    "RewriteSemanticConstants",
    "DeadBranchPrune",
    "RewriteDynamicRaises",
    "FindLiterallyCalls",
    "LiteralUnroll",
    "LiteralPropagationSubPipelinePass",
    "InlineInlinables",
    "InlineOverloads",
    "NoPythonSupportedFeatureValidation",
    "DumpParforDiagnostics",
}
"""Passes of Numba for Python that no part contains, such as closures; code that needs one does not compile.

Without them, and without the text of `_Arguments`, everything compiles in 63 s of CPU instead of 76 s.
"""


class Part(CompilerBase):  # type: ignore[misc,unused-ignore]
    """Pipeline that translates a function, to be linked into others."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's own pipeline of the passes in use, with a library that code does not run from."""
        self.state.library = _Library(
            self.state.targetctx.codegen(), self.state.func_id.func_qualname
        )
        self.state.args = _Arguments(self.state.args)
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state).passes
        pipeline = PassManager("part")
        for one, description in passes:
            if one.__name__ not in UNUSED_PASSES:
                pipeline.add_pass(one, description)
        pipeline.finalize()
        return [pipeline]


class _Arguments(tuple[Any, ...]):
    """Types of arguments. Numba writes them out before each pass, which takes long for large records."""

    def __str__(self) -> str:
        return "types of arguments"


class _Library(JITCodeLibrary):  # type: ignore[misc,unused-ignore]
    """Code that is never run by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: a part has no machine code."""
        return 0

    @property
    def codegen(self) -> _Library:
        """Return the library: Numba passes the environment of running code to ``library.codegen``."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Ignore the environment."""


def compiled(function: F) -> F:
    """Compile a function at its first call, and keep the result on disk.

    Division by zero gives infinity or NaN, as in NumPy. No fast-math: results do not depend on the processor.
    """
    if INTERPRETED:
        return _quiet(function)
    dispatcher = numba.njit(error_model="numpy", no_cfunc_wrapper=True)(function)
    dispatcher._cache = Results(function)
    dispatcher.typeof_pyval = type_of
    _call_as_part(dispatcher)
    _dispatchers.append(dispatcher)
    return cast(F, dispatcher)


def _call_as_part(dispatcher: Any) -> None:
    """Have compiled code link a function in as a `Part`, once for all whole numbers instead of for each constant."""

    # Made when first needed: a process that finds all results needs none.
    @functools.cache
    def part() -> Any:
        return numba.njit(
            pipeline_class=Part,
            error_model="numpy",
            no_cfunc_wrapper=True,
            no_cpython_wrapper=True,
        )(dispatcher.py_func)

    def find(arguments: Any, named: Any) -> Any:
        found = part().get_call_template(
            tuple(numba.types.unliteral(one) for one in arguments),
            {name: numba.types.unliteral(one) for name, one in named.items()},
        )
        Kept.new_marks.add(dispatcher._cache.mark())
        return found

    dispatcher.get_call_template = find
    dispatcher.get_overload = lambda signature: part().get_overload(signature)


def type_of(value: Any) -> Any:
    """Return Numba's type of an argument, that Numba itself would derive anew for each array of records."""
    if isinstance(value, tuple):
        return numba.types.BaseTuple.from_types(
            [type_of(one) for one in value], type(value)
        )
    if isinstance(value, np.ndarray) and value.dtype.names:
        element = _record_type(value.dtype, value.dtype.isalignedstruct)
        return numba.types.Array(
            element, value.ndim, map_layout(value), readonly=not value.flags.writeable
        )
    return typeof(value)


@functools.cache
def _record_type(kind: np.dtype[Any], aligned: bool) -> Any:
    # Types that differ in `isalignedstruct` alone are equal.
    return numba.from_dtype(kind)


class Callback:
    """A compiled function over records, called through its address, so that its callers are compiled separately."""

    def __init__(
        self, function: Callable[..., None], records: tuple[type, ...]
    ) -> None:
        self.function = function
        self.records = records
        self.compiled: Any = None  # once the address was asked for
        _callbacks.append(self)

    def __call__(self, *arguments: Any) -> None:
        """Call the plain Python function. Compiled code uses `call`."""
        self.function(*arguments)

    @property
    def address(self) -> int:
        """Address for `call`. The first access compiles the function."""
        if INTERPRETED:
            return _callbacks.index(self)
        if self.compiled is None:
            types = tuple(numba.from_dtype(kind.dtype) for kind in self.records)  # type: ignore[attr-defined]
            signature = (types, numba.types.void)
            compiled: Any = CFunc(
                self.function, signature, {}, {"error_model": "numpy"}
            )
            compiled._cache = Results(self.function)
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
    """Address of the first record. The array must outlive every use of the address."""
    if INTERPRETED:
        _by_address[rows.ctypes.data] = rows
    return int(rows.ctypes.data)


@contextlib.contextmanager
def reported(what: str) -> Iterator[None]:
    """Log one line with the duration if anything is compiled within, and not just loaded."""
    begun = time.perf_counter()
    before = compilations()
    yield
    if compilations() > before:
        LOG.warning(
            "compiled %s in %.1f s, once on this machine",
            what,
            time.perf_counter() - begun,
        )


def compilations() -> int:
    """Count the compilations of this process so far, without loaded results."""
    misses = sum(
        sum(dispatcher.stats.cache_misses.values()) for dispatcher in _dispatchers
    )
    return misses + sum(
        one.compiled is not None and one.compiled.cache_hits == 0 for one in _callbacks
    )


def missing() -> set[str]:
    """Return the names of the functions imported so far that have no result on disk, and are in no result of others."""
    return {
        name_of(dispatcher.py_func)
        for dispatcher in _dispatchers
        if not dispatcher._cache.exist()
    }


def name_of(function: Callable[..., Any]) -> str:
    """Return the full name of a function."""
    return f"{function.__module__}.{function.__qualname__}"


# Calling by address -------------------------------------------------------------------
# ------------------------------

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
        """Call a `Callback`. See the compiled form."""
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
