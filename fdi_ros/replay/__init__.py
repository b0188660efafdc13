# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording through the pipeline: run, evaluated, checked, written, reported. Called, it replays: `front.replay`."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fdi_ros.replay.front import ConfigSource, Injected, Source
    from fdi_ros.replay.summary import Summary


class _Callable(ModuleType):
    """Package that can be called: ``fdi_ros.replay`` is a verb, too."""

    def __call__(
        self,
        path: Source,
        config: ConfigSource = None,
        faults: Sequence[Injected] = (),
        start: float = 0.0,
        end: float = math.inf,
    ) -> Summary:
        """Replay a recording; arguments as of `fdi_ros.replay.front.replay`, whose docstring explains them."""
        from fdi_ros.replay.front import replay

        return replay(path, config, faults, start, end)


sys.modules[__name__].__class__ = _Callable
