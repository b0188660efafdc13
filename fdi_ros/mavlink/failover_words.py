# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Texts of failover for the pilot: one sentence for each condition of an IMU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi_ros.mavlink.failover_policy import Condition
from fdi_ros.mavlink.report import CRITICAL, INFO, TEXT_LENGTH, WARNING


class Words(NamedTuple):
    """One sentence."""

    severity: int  #: MAV_SEVERITY.
    text: str  #: What follows "FDI: ", or for an IMU "FDI: IMU 1 ".


CONDITION_WORDS = {
    Condition.FINE: Words(INFO, "in use, differs no more"),
    Condition.DANGER: Words(CRITICAL, "faulty AND IN USE: land"),
    Condition.OUT: Words(CRITICAL, "out of use"),
    Condition.STAYS_OUT: Words(CRITICAL, "still faulty, stays out of use"),
    Condition.NOT_OK: Words(WARNING, "stays out, monitor finds it not OK"),
    Condition.UNTURNED: Words(WARNING, "stays out until turned by hand"),
    Condition.REBOOT: Words(CRITICAL, "no notch: set INS_USE{} 1 and reboot"),
    Condition.STUCK_OUT: Words(WARNING, "not back in use, though asked"),
    Condition.LEFT_ALONE: Words(WARNING, "left alone until disarmed"),
    Condition.UNUSED: Words(WARNING, "not in use, not by failover"),
    Condition.APART: Words(WARNING, "differs from the others"),
    Condition.DISAGREE: Words(CRITICAL, "the IMUs disagree: land"),
    Condition.ALONE: Words(CRITICAL, "one IMU or none is alive: land"),
    Condition.REDUNDANT: Words(INFO, "two IMUs or more agree again"),
    Condition.LAST_IMU: Words(CRITICAL, "one IMU left in use: land"),
    Condition.LAST_LANE: Words(CRITICAL, "one EKF lane left: land"),
}


def imu_name(imu: int, channels: Sequence[str]) -> str:
    """Return the autopilot's name of an IMU, from 0, and the topic's: IMU 1 (front).

    Without the topic's name if that only repeats the number: imu_1.
    """
    name = channels[3 * imu].rpartition(".")[0]
    repeats = name in ("", f"imu_{imu + 1}")
    return f"IMU {imu + 1}" if repeats else f"IMU {imu + 1} ({name})"


def imu_text(
    imu: int,
    condition: Condition,
    channels: Sequence[str],
    error: tuple[str, float] | None = None,
) -> str:
    """Return the sentence for an IMU, from 0.

    Parameters
    ----------
    channels
        Channel names, three for each IMU.
    error
        Axis and size, rad/s, in REP-103 axes. The text has ArduPilot's: y to the right,
        z down.
    """
    # ArduPilot's parameters are INS_USE, INS_USE2, INS_USE3.
    words = CONDITION_WORDS[condition].text.format(imu + 1 if imu else "")
    if error is not None:
        axis, size = error
        words += f" (gyro {axis} {size if axis == 'x' else -size:+.2f} rad/s)"
    text = f"FDI: {imu_name(imu, channels)} {words}"
    return (text if len(text) <= TEXT_LENGTH else f"FDI: IMU {imu + 1} {words}")[
        :TEXT_LENGTH
    ]
