# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The clocks of this computer, and which start of the computer they belong to."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import NamedTuple


class Clocks(NamedTuple):
    """The clocks of this computer at one instant."""

    unix: float  #: Unix time, s. May be wrong by years on a computer without a time source.
    uptime: float = math.nan  #: Time since the start of this computer, s. NaN: unknown.
    boot: str = ""  #: Identity of this start of the computer. Empty: unknown.


def read_clocks() -> Clocks:
    """Return the clocks of this computer now."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return Clocks(time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), boot)
    except (OSError, AttributeError):
        # Not Linux.
        return Clocks(time.time())
