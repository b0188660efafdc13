# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When an autopilot started, in UTC, by what is true in its log and not by what is wild."""

import numpy as np

from fdi_ros.bag.dataflash import _start_utc
from fdi_ros.bag.tlog import _start_utc_by

SECOND = 1_000_000
GPS_EPOCH, LEAP, WEEK = 315_964_800, 18, 604_800


def test_a_gps_time_counts_from_a_fix_in_three_dimensions_on():
    """Before that a receiver gives the time of its own clock."""
    columns = [("TimeUS", "i8"), ("GMS", "i8"), ("GWk", "i8"), ("Status", "u1")]
    rows = np.zeros(2, columns)
    rows[0] = (5 * SECOND, 1000, 2100, 1)
    rows[1] = (7 * SECOND, 60_000, 2300, 3)
    start = (GPS_EPOCH - LEAP + 2300 * WEEK + 60 - 7) * SECOND
    assert _start_utc(rows) == start
    assert _start_utc(rows[:1]) is None


def test_of_messages_the_least_delayed_sets_the_start_and_a_wild_one_does_not():
    start = 1_700_000_000 * SECOND
    delays = np.random.default_rng(0).integers(4000, 90_000, 200)
    starts = start + delays
    assert _start_utc_by([starts]) == starts.min()
    wild = np.append(starts, start - 86_400 * SECOND)
    assert _start_utc_by([wild]) == starts.min()
