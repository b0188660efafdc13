# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMUs that fail alike: agreement that proves nothing.

docs/failover.md, "IMUs that fail alike": two IMUs with similar errors of scale agree with each
other, and the healthy third one differs from both.

- An IMU that was bad shows nothing by agreeing with a second one while the third one differs as
  if both had similar errors of scale. It shows nothing on an axis either while the third one
  differs in any way, if the monitor doubts that axis of the second one (`is_witness`).
- An IMU that is out shows nothing while a third IMU, which is not FAULTY, differs from it on a
  bad axis by half of what its former error would be at this rate (`hides`).
- While an IMU has not yet agreed in turns, an IMU that differs from the other two is not *named
  for this difference*. The second one may have failed like the first one (`others_fail_alike`).
"""

from __future__ import annotations

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.raw import nearest_zero
from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.failover.wrong import ALIKE_SHARES, HEALTHY_SCALE, Wrong


def is_witness(present: Present, unit: int, bad: int, axis: int) -> bool:
    """Return whether agreement with an IMU shows that a bad one measures an axis again."""
    wrong = present.tracks[bad].wrong[axis]
    is_doubted = axis in present.tracks[unit].doubted_axes
    counts_any = is_doubted and wrong.is_of_scale
    thirds = [k for k in present.units if k not in (unit, bad)]
    return not any(
        differs_by(present, None if counts_any else wrong, third, unit, axis)
        for third in thirds
    )


def differs_by(
    present: Present, wrong: Wrong | None, unit: int, other: int, axis: int
) -> bool:
    """Return whether an IMU differs from another as if that one was wrong like this.

    wrong: None for any difference. A delay may explain the difference as well: as a turn
    begins, delays are not known yet.
    """
    rate, found = (present.raw.motion(k).mean[axis] for k in (unit, other))
    least = present.min_size + HEALTHY_SCALE * abs(nearest_zero((rate, found)))
    differs = abs(found - rate) >= least
    return differs and (wrong is None or wrong.explains(rate, found, present.min_size))


def others_fail_alike(present: Present, unit: int, axis: int) -> bool:
    """Return whether the others may be wrong alike on an axis, and an IMU that differs be healthy.

    That is so if a first IMU waits to agree in a turn about this axis, if it is near a second
    one, which counts, and if the two differ from this one as if both had similar errors of scale.
    """
    rate = abs(present.raw.motion(unit).mean[axis])
    near = ALIKE_SHARES * rate + present.min_size
    tracks = present.tracks
    return any(
        axis in tracks[first].waits
        and present.pairs[first, second].mean[axis] < near
        and differs_by(present, tracks[first].wrong[axis], unit, second, axis)
        for first in present.others(unit)
        for second in tracks[unit].partners.on[axis] - {first}
    )


#: The rule `hides` holds for errors of up to this multiple of the rate. With the range of the
#: driver set wrong, 2000 deg/s in place of 250, a gyro reads 8 times the rate.
MOST_HIDDEN_SHARE = 7.0

#: Part of the former error from which a difference may be that error: an IMU that has a small
#: error of scale of its own differs by less than the whole.
HIDDEN_PART = 0.5


def hides(present: Present, unit: int) -> bool:
    """Return whether a scale error of an IMU could hide in the difference to another IMU.

    In a fast turn about another axis scales explain more than that error makes. Agreement
    with a second IMU then proves nothing: that one may have failed alike.
    """
    track = present.tracks[unit]
    return any(
        present.pairs[unit, k].full[axis] >= _hidden(present, wrong, unit, k, axis)
        for k in track.partners.common
        if ChannelState.FAULTY not in present.tracks[k].states
        for axis, wrong in track.wrong.items()
        if wrong.share <= MOST_HIDDEN_SHARE
    )


def _hidden(present: Present, wrong: Wrong, unit: int, other: int, axis: int) -> float:
    """Return the least difference that a part of the former scale error makes now, rad/s."""
    rates = [present.raw.motion(k).mean[axis] for k in (unit, other)]
    # The share was measured without the part that scales explain.
    error = (wrong.share + HEALTHY_SCALE) * abs(nearest_zero(rates))
    return max(present.min_size, HIDDEN_PART * error)
