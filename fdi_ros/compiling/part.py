# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Functions that compiled code calls: optimised, and made machine code, once, as parts of what Python calls.

Numba alone does both for each function by itself, and once more within every function that calls it: at five levels of
calls five times. A part is only translated, and linked into its callers as it is. What is used of Numba here beside
its documented pipeline is tested with the oldest and the newest version allowed.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder


class Part(CompilerBase):  # type: ignore[misc,unused-ignore]
    """Pipeline that translates a function, to be linked into others."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's own pipeline, with a library that code does not run from."""
        self.state.library = _Library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
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
