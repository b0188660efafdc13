# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the rest of the package logs, passed on to a node's logger."""

from __future__ import annotations

import logging
from typing import Any


class _Handler(logging.Handler):
    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        self._logger.info(record.getMessage())


def log_through(logger: Any) -> None:
    """Send what the package logs to a ROS logger, and nowhere else."""
    log = logging.getLogger("fdi_ros")
    log.handlers = [_Handler(logger)]
    log.propagate = False
