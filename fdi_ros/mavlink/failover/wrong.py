# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How an axis of an IMU was bad: how large its error was in proportion to the rate.

docs/failover.md needs this twice:

- "When an IMU goes back", rule 3: an IMU that was bad has agreed in a turn that shows its error.
  A turn of 0.06 rad/s shows a dead gyro. A scale error needs a faster turn. A turn at 0.8 of the
  rate at which the error was seen is always fast enough.
- "IMUs that fail alike": two IMUs with similar errors of scale agree with each other, and the
  healthy third one differs from both. An error of more than 1.2 of the rate was none of scale.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: Share of the rate by which two healthy gyros may differ: scales of one type differ by up
#: to 3 %. In a turn of 17 rad/s that is more than the largest limit of a difference, 0.5 rad/s.
HEALTHY_SCALE = 0.05

#: Resolution of the messages, rad/s: no smaller rate or share is known.
RESOLUTION = 1e-3

#: A larger share was no error of scale: the IMU was off at rest, too.
MOST_SCALE_SHARE = 1.2

#: A turn at this part of the rate at which the error was seen shows it. At 0.4, gyros that have
#: lost a part of their scale agree for 13 % of the time, now for 5 %. At 1.0, half of the
#: healed ones stay out in a circle.
SAME_TURN = 0.8

#: Two IMUs have similar errors of scale if their shares differ by this or less.
ALIKE_SHARES = 0.2

#: Largest part of the scale that is lost without the gyro being dead: a dead one does not move,
#: and a gyro with a bias differs from all others by its whole rate in a hover.
MOST_LOST = 0.85

#: Ratio of two steps in which `failover_file` keeps rate and share.
STEP = 1.25
#: A value that is a step already differs from it by less than this part of a step.
STEP_ROUNDING = 1e-3


class Wrong(NamedTuple):
    """How one axis of an IMU was bad."""

    rate: float  #: Largest rate of the others about it then, rad/s.
    share: float  #: Largest ratio of error and rate: 1 for a gyro without scale.

    @property
    def is_of_scale(self) -> bool:
        """Whether it may have been an error of scale."""
        return self.share <= MOST_SCALE_SHARE

    def with_error(self, size: float, rate: float) -> Wrong:
        """Return how the axis was bad, after an error of a size, rad/s, at a rate, rad/s."""
        share = size / max(rate, RESOLUTION)
        if self == WITHOUT_SCALE:
            # That was no measurement.
            return Wrong(rate, share)
        return Wrong(max(rate, self.rate), max(share, self.share))

    def in_steps(self) -> Wrong:
        """Return this with at least its rate and at most its share, in steps of `STEP`.

        So a turn that shows the result shows this error too, and small changes do not
        change the file.
        """
        if self in (WITHOUT_SCALE, UNKNOWN):
            return self
        rate, share = (math.log(max(value, RESOLUTION), STEP) for value in self)
        if math.isfinite(rate):
            rate = STEP ** math.ceil(rate - STEP_ROUNDING)
        return Wrong(rate, STEP ** math.floor(share + STEP_ROUNDING))

    def shown_by(self, dead: float) -> float:
        """Return the least turn that shows this error, rad/s.

        dead: least turn that shows a dead gyro, rad/s.
        """
        return max(dead, min(SAME_TURN * self.rate, dead / self.share))

    def explains(self, rate: float, other: float, min_size: float) -> bool:
        """Return whether a gyro with a similar error of scale would read another rate.

        rate: that of a gyro with the right scale, rad/s. other: the other rate, rad/s.
        """
        size = abs(other - rate)
        reads_more = abs(other) > abs(rate)
        share = self.share + ALIKE_SHARES
        if self == UNKNOWN:
            share = MOST_SCALE_SHARE if reads_more else MOST_LOST
        elif not self.is_of_scale:
            return False
        most = share if reads_more else min(share, MOST_LOST)
        return size < most * abs(rate) + min_size


#: A dead axis, or an axis of which no more is known.
WITHOUT_SCALE = Wrong(rate=math.inf, share=1.0)

#: An axis of which an older `failover_file` has only that it was bad. The turn that shows it
#: shows any loss of scale that healthy gyros do not have.
UNKNOWN = Wrong(rate=math.inf, share=HEALTHY_SCALE)
