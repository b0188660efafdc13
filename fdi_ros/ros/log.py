# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node logs: bounded, however often something outside causes it."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from fdi_ros.limits import LINE
from fdi_ros.text import shown

MOST = 20
"""Lines of one severity in one period: what anybody may cause with requests hides no declaration."""
PERIOD = 1.0
"""s."""


class BoundedLog:
    """Logs so many lines a second at most, each of bounded length, and says how many were left out.

    Parameters
    ----------
    logger
        Of the node.
    clock
        Steady time, s.
    """

    def __init__(self, logger: Any, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._since = clock()
        self._lines: Counter[str] = Counter()
        self._left_out = 0

    # The logger of ROS refuses another severity from the same line of code.
    def info(self, words: str) -> None:
        """Log what is as it should be."""
        if self._has_room("info"):
            self._logger.info(shown(words, LINE))

    def warning(self, words: str) -> None:
        """Log what somebody should know of."""
        if self._has_room("warning"):
            self._logger.warning(shown(words, LINE))

    def error(self, words: str) -> None:
        """Log what somebody should act on."""
        if self._has_room("error"):
            self._logger.error(shown(words, LINE))

    def begin_period(self) -> None:
        """Begin the next period if it is time, with a line on what was left out of the last one."""
        now = self._clock()
        if now - self._since < PERIOD:
            return
        left_out, self._since, self._left_out = self._left_out, now, 0
        self._lines.clear()
        if left_out:
            self._lines["warning"] = 1
            self._logger.warning(f"and {left_out} more lines, left out")

    def _has_room(self, severity: str) -> bool:
        self.begin_period()
        has_room = self._lines[severity] < MOST
        self._lines[severity] += has_room
        self._left_out += not has_room
        return has_room


class _Handler(logging.Handler):
    def __init__(self, log: BoundedLog) -> None:
        super().__init__()
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        self._log.info(record.getMessage())


def log_through(log: BoundedLog) -> None:
    """Send what the package logs to the log of a node, and nowhere else."""
    package = logging.getLogger("fdi_ros")
    package.handlers = [_Handler(log)]
    package.propagate = False
