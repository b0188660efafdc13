# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which IMUs count on an axis: with these an IMU is compared.

docs/failover.md, "Which IMUs count on an axis":

1. All IMUs in use count.
2. An IMU out of use counts if it has trust on all axes.
3. An IMU out of use also counts on an axis on which it has trust (`failover.trust`).
4. If every other IMU is out and none counts by rule 2, every other IMU counts.
5. An IMU that is FAULTY is compared only with IMUs that the monitor does not doubt. If the
   monitor doubts all of them, the comparison is with all of them: two that are FAULTY may be so
   alike.
6. An IMU that repeats one value while another IMU moves does not count.
7. An IMU whose samples cannot be paired does not count: the difference is unknown.
"""

from __future__ import annotations

import math

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.records import NO_PARTNERS, Partners, Present


def partners(present: Present, unit: int) -> Partners:
    """Return the IMUs that count for an IMU. None, if that sends no samples."""
    if unit not in present.units:
        return NO_PARTNERS
    tracks = present.tracks
    # Rules 6 and 7.
    others = [k for k in present.others(unit) if not present.raw.is_stuck(k)]
    known = {k for k in others if not math.isnan(max(present.pairs[unit, k].apart))}
    # Rules 1 and 2.
    counting = {k for k in others if k not in present.out or tracks[k].is_trusted}
    if not counting:
        # Rule 4.
        return Partners((known,) * 3, known)
    undoubted = {k for k in known if tracks[k].states and not tracks[k].doubts}
    is_faulty = ChannelState.FAULTY in tracks[unit].states

    def compared(counting: set[int]) -> set[int]:
        # Rule 5.
        return (is_faulty and counting & undoubted) or counting & known

    common = compared(counting)
    if not common:
        return NO_PARTNERS
    # Rule 3.
    proven = [{k for k in others if axis in tracks[k].proven} for axis in range(3)]
    on = tuple(compared(counting | more) for more in proven)
    return Partners(on, common, are_fit=True)
