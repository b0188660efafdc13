# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording through the pipeline: run, evaluated, checked, written, reported. Called, it replays: `run.replay`."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    """Package that can be called: ``fdi_ros.replay`` is a verb, too."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Replay a recording. Arguments as of `fdi_ros.replay.run.replay`, whose docstring explains them."""
        from fdi_ros.replay.run import replay

        return replay(*arguments, **named)

    @property
    def __signature__(self) -> inspect.Signature:
        from fdi_ros.replay.run import replay

        return inspect.signature(replay)


sys.modules[__name__].__class__ = _Callable
