# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The messages of IMUs: laid out as pymavlink lays them out, in rad/s and m/s^2, front, left, up."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.mavlink.imu import ARDUPILOT, MESSAGES, PX4, read, understood

SHORT = st.integers(-32768, 32767)


def payload_of(message) -> bytes:
    data = bytes(message.pack(mavlink.MAVLink(None)))
    return data[10 : 10 + data[1]]


@pytest.mark.parametrize("number", MESSAGES)
def test_name_and_size_are_those_of_the_dialect(number: int) -> None:
    message, theirs = MESSAGES[number], mavlink.mavlink_map[number]
    assert (message.name, message.size) == (theirs.msgname, theirs.unpacker.size)


@pytest.mark.parametrize("number", MESSAGES)
@given(time=st.integers(1, 2**32 - 1), values=st.lists(SHORT, min_size=6, max_size=6), unit=st.integers(0, 3))
def test_values_are_pymavlinks_in_our_units_and_axes(number: int, time: int, values: list[int], unit: int) -> None:
    message = MESSAGES[number]
    acceleration, rate = values[:3], values[3:]
    if message.name == "HIGHRES_IMU":
        made = mavlink.MAVLink_highres_imu_message(time, *map(float, values), *(0.0,) * 7, 0x3F, unit)
        g = a = 1.0
    elif message.name == "RAW_IMU":
        made = mavlink.MAVLink_raw_imu_message(time, *values, 0, 0, 0, unit, 0)
        g, a = 1e-3, 9.80665e-3
    else:
        made = mavlink.mavlink_map[number](time, *values, 0, 0, 0, 0)
        g, a, unit = 1e-3, 9.80665e-3, message.unit
    reading = read(number, payload_of(made))
    if not any(values):
        assert reading is None
        return
    assert reading is not None
    assert (reading.unit, reading.stamp) == (unit, 1000 * time * (1000 if number in (26, 116, 129) else 1))
    np.testing.assert_allclose(reading.rate, [g * rate[0], -g * rate[1], -g * rate[2]], atol=1e-12)
    np.testing.assert_allclose(reading.acceleration, np.array([1, -1, -1]) * a * np.array(acceleration), atol=1e-9)


@pytest.mark.parametrize("updated", [0, 0b000111, 0b011000])
def test_a_gyro_that_is_not_new_is_no_sample(updated: int) -> None:
    made = mavlink.MAVLink_highres_imu_message(5, 0.0, 0.0, -9.8, 0.1, 0.2, 0.3, *(0.0,) * 7, updated, 0)
    assert read(105, payload_of(made)) is None


def test_raw_counts_have_no_unit_but_from_ardupilot() -> None:
    assert understood("RAW_IMU", ARDUPILOT)
    assert not understood("RAW_IMU", PX4)
    assert understood("SCALED_IMU", PX4)
