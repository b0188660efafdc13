# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the ground station is told: declarations, soon, in few words, and never more than a link bears."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.mavlink.report import (
    AT_ONCE,
    CRITICAL,
    INFO,
    NOTHING_SEEN,
    TEXT_LENGTH,
    WARNING,
    Announcer,
    allows_arming,
)
from fdi_ros.monitor.diagnostics import MONITOR_LINE, Level, StatusLine

NS = 1_000_000_000
CHANNELS = [f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"]
BOATS = [f"{unit}_imu.{axis}" for unit in ("port", "starboard") for axis in "xyz"]


def report(
    name: str,
    state: str,
    group: str = "",
    apart: str = "",
    repeats: str = "",
    error: str = "",
) -> StatusLine:
    """What a monitor reports of a channel."""
    values = {
        "state": state,
        "one of": group,
        "apart (rad/s)": apart,
        "repeats for (s)": repeats,
        "estimated error (rad/s)": error,
    }
    return StatusLine(Level.OK, name, "", values=tuple(values.items()))


@pytest.mark.parametrize(
    ("state", "allowed"),
    [
        *(("OK", True), ("SUSPECT", True), ("UNCHECKED", True), ("EXCLUDED", True)),
        *(("FAULTY", False), ("AMBIGUOUS", False), ("STALE", False)),
    ],
)
@pytest.mark.parametrize("name", ["imu_2.y", "imu_2.accel_z"])
def test_a_faulty_or_silent_sensor_or_a_set_of_two_units_forbids_arming(
    name: str, state: str, allowed: bool
) -> None:
    whole = StatusLine(Level.WARN, MONITOR_LINE, "8 of 9 gyros healthy")
    others = [report(one, "OK") for one in CHANNELS if one != name]
    pair = "imu_1.y, imu_2.y" if state == "AMBIGUOUS" else ""
    assert allows_arming([whole, *others, report(name, state, pair)]) is allowed


@pytest.mark.parametrize(
    ("level", "allowed"),
    [(Level.OK, True), (Level.WARN, True), (Level.ERROR, False), (Level.STALE, False)],
)
def test_without_rate_samples_or_a_check_of_any_gyro_nobody_arms(
    level: Level, allowed: bool
) -> None:
    channels = [report(name, "OK") for name in CHANNELS]
    assert allows_arming([StatusLine(level, MONITOR_LINE, ""), *channels]) is allowed
    assert not allows_arming(channels)


class Ground:
    """A ground station that keeps what it is told, at 20 looks a second."""

    def __init__(self, channels: list[str] = CHANNELS, apart=None) -> None:
        self.announcer, self.now = Announcer(channels, apart), 100 * NS
        self.told: list[tuple[float, int, str]] = []

    def hear(self, *reports: StatusLine, wait: float = 1.0) -> list[tuple[int, str]]:
        before = len(self.told)
        self.announcer.hear(reports, self.now)
        for k in range(round(wait * 20)):
            self.now += NS // 20
            if k % 20 == 19:
                self.announcer.hear(reports, self.now)
            self.told += [
                (self.now / NS, *text) for text in self.announcer.due(self.now)
            ]
        return [(severity, text) for _, severity, text in self.told[before:]]


def force(name: str, state: str, error: str = "") -> StatusLine:
    """What a monitor reports of an accelerometer."""
    values = (("state", state), ("estimated error (m/s^2)", error))
    return StatusLine(Level.OK, name, "", values=values)


@pytest.mark.parametrize("apart", [None, lambda unit: 0.0])
def test_an_accelerometer_is_named_with_its_size_and_stays_a_warning(apart) -> None:
    ground, name = Ground(apart=apart), "imu_2.accel_z"
    assert (
        ground.hear(force(name, "SUSPECT"), force("imu_1.accel_x", "AMBIGUOUS")) == []
    )
    text = "FDI: accelerometer z of IMU 2 off by 1.2 m/s^2"
    assert ground.hear(force(name, "FAULTY", "-1.234")) == [(WARNING, text)]
    assert ground.hear(force(name, "FAULTY", "-1.6")) == []
    again = [] if apart else [(INFO, "FDI: accelerometer z of IMU 2 agrees again")]
    assert ground.hear(force(name, "OK"), wait=3.0) == again
    unknown = [(WARNING, "FDI: accelerometer z of IMU 2 faulty")]
    assert ground.hear(force(name, "FAULTY")) == unknown
    assert len("FDI: accelerometer z of IMU 4 off by 156.9 m/s^2") <= TEXT_LENGTH


def test_an_accelerometer_that_is_wrong_from_the_start_is_told() -> None:
    def biased(name: str, size: str) -> StatusLine:
        values = (("state", "OK"), ("implausible bias (m/s^2)", size))
        return StatusLine(Level.WARN, name, "", values=values)

    ground = Ground()
    assert ground.hear(biased("imu_1.accel_x", "none")) == []
    text = "FDI: accelerometer x of IMU 1 off by 5.0 m/s^2"
    assert ground.hear(biased("imu_1.accel_x", "-5.02")) == [(WARNING, text)]
    # Of two that differ, either may be the one.
    text = "FDI: accelerometer x of IMU 2 off by 5.0 m/s^2?"
    assert ground.hear(biased("imu_2.accel_x", "5.0")) == [(WARNING, text)]
    assert len(text) <= TEXT_LENGTH


@pytest.mark.parametrize(
    ("state", "severity"), [("FAULTY", CRITICAL), ("AMBIGUOUS", WARNING)]
)
def test_a_fault_of_a_unit_in_gyros_and_accelerometers_is_one_text(
    state, severity
) -> None:
    group = "imu_2.x, imu_2.y, imu_2.z" if state == "AMBIGUOUS" else ""
    gyros = [report(f"imu_2.{axis}", state, group, error="0.5") for axis in "xyz"]
    forces = [force(f"imu_2.accel_{axis}", "FAULTY", "5.0") for axis in "xyz"]
    text = "FDI: imu_2 faulty (gyros and accelerometers)"
    assert len(text) <= TEXT_LENGTH
    ground = Ground()
    assert ground.hear(*gyros, *forces) == [(severity, text)]
    good = [report(f"imu_2.{axis}", "OK") for axis in "xyz"]
    well = [force(f"imu_2.accel_{axis}", "OK") for axis in "xyz"]
    assert ground.hear(*good, *well, wait=3.0) == [(INFO, "FDI: imu_2 agrees again")]


def test_a_single_accelerometer_or_one_of_another_unit_is_a_text_of_its_own() -> None:
    gyros = [report(f"imu_2.{axis}", "FAULTY", error="0.5") for axis in "xyz"]
    one = force("imu_2.accel_x", "FAULTY", "5.0")
    other = force("imu_3.accel_x", "FAULTY", "5.0")
    expected = {
        (CRITICAL, "FDI: imu_2 faulty"),
        (WARNING, "FDI: accelerometer x of IMU 2 off by 5.0 m/s^2"),
        (WARNING, "FDI: accelerometer x of IMU 3 off by 5.0 m/s^2"),
    }
    assert set(Ground().hear(*gyros, one, other)) == expected


def test_beside_failover_accelerometers_are_told_though_a_set_of_gyros_is_not() -> None:
    group = "imu_2.x, imu_2.y, imu_2.z"
    gyros = [report(f"imu_2.{axis}", "AMBIGUOUS", group) for axis in "xyz"]
    forces = [force(f"imu_2.accel_{axis}", "FAULTY", "5.0") for axis in "xyz"]
    told = Ground(apart=lambda unit: 1.0).hear(*gyros, *forces)
    assert len(told) == 3
    assert all("accelerometer" in text for _, text in told)


def test_declarations_are_told_and_suspicions_are_not() -> None:
    ground = Ground()
    assert ground.hear(report("imu_2.y", "SUSPECT")) == []
    assert ground.hear(report("imu_2.y", "FAULTY")) == [
        (CRITICAL, "FDI: imu_2.y faulty")
    ]
    assert ground.hear(report("imu_2.y", "FAULTY")) == []
    good = [(INFO, "FDI: imu_2.y agrees again")]
    assert ground.hear(report("imu_2.y", "OK"), wait=3.0) == good
    assert (
        ground.hear(
            report("another.channel", "FAULTY"), report("imu_1.x", "no such state")
        )
        == []
    )


def test_a_set_that_comes_and_goes_is_told_once() -> None:
    """As that of a unit with a loose mounting. Good news wait for 2 s."""
    ground = Ground()
    group = ", ".join(CHANNELS[3:6])
    bad = [report(name, "AMBIGUOUS", group) for name in CHANNELS[3:6]]
    good = [report(name, "OK") for name in CHANNELS[3:6]]
    told = [text for _ in range(5) for text in ground.hear(*bad) + ground.hear(*good)]
    assert len(told) == 1
    assert ground.hear(*good, wait=3.0) == [(INFO, "FDI: imu_2 agrees again")]


def test_a_frozen_unit_is_told_by_its_name_until_it_is_declared() -> None:
    ground = Ground()

    def reports(state: str, seconds: str) -> list[StatusLine]:
        return [report(name, state, repeats=seconds) for name in CHANNELS[3:6]]

    assert ground.hear(*reports("OK", "0.25")) == [(WARNING, "FDI: imu_2 frozen")]
    assert ground.hear(*reports("OK", "1.25")) == []
    good = [(INFO, "FDI: imu_2 agrees again")]
    assert ground.hear(*reports("OK", ""), wait=3.0) == good
    assert ground.hear(*reports("FAULTY", "2.25")) == [(CRITICAL, "FDI: imu_2 faulty")]


@pytest.mark.parametrize(
    ("names", "state", "apart", "text"),
    [
        (CHANNELS[6:], "STALE", "", (WARNING, "FDI: imu_3 no data")),
        (
            CHANNELS[:6:3],
            "AMBIGUOUS",
            "",
            (WARNING, "FDI: one faulty of imu_1.x, imu_2.x"),
        ),
        (
            CHANNELS[1:6:3],
            "AMBIGUOUS",
            "0.100 +- 0.002",
            (WARNING, "FDI: imu_1.y or imu_2.y wrong by 0.100 rad/s"),
        ),
        (
            BOATS[1::3],
            "AMBIGUOUS",
            "0.100 +- 0.002",
            (WARNING, "FDI: one faulty of port_imu.y, starboard_imu.y"),
        ),
        (CHANNELS[:6], "AMBIGUOUS", "", (WARNING, "FDI: one faulty of imu_1, imu_2")),
        (CHANNELS[:1], "AMBIGUOUS", "", (WARNING, "FDI: imu_1.x likely faulty")),
        (CHANNELS[1:7], "AMBIGUOUS", "", (WARNING, "FDI: one faulty of 6 channels")),
        (
            CHANNELS[6:],
            "AMBIGUOUS",
            "",
            (WARNING, "FDI: imu_3 faulty (axis cannot be told apart)"),
        ),
    ],
)
def test_a_unit_and_a_set_are_one_text(
    names: list[str], state: str, apart: str, text: tuple[int, str]
) -> None:
    ground = Ground(BOATS if names[0] in BOATS else CHANNELS)
    group = ", ".join(names) if state == "AMBIGUOUS" else ""
    assert ground.hear(*(report(name, state, group, apart) for name in names)) == [text]
    # That they come to be further apart is no news.
    assert (
        ground.hear(
            *(report(name, state, group, apart and "0.2 +- 0.002") for name in names),
            wait=5.0,
        )
        == []
    )


def test_the_whole_is_told_too() -> None:
    ground = Ground()
    again = [(INFO, "FDI: all is judged again")]
    for level, message, told in (
        (Level.STALE, "no sample yet", []),
        (
            Level.ERROR,
            "no fused rate: the biases are being learned, at rest; 6 of 6 channels healthy",
            [],
        ),
        (
            Level.ERROR,
            "no fused rate: withheld, as channels under doubt ...",
            [(CRITICAL, "FDI: no fused rate")],
        ),
        (Level.OK, "9 of 9 channels healthy", again),
        (
            Level.ERROR,
            "3 of 6 channels healthy; no further fault would be detected",
            [(CRITICAL, f"FDI: {NOTHING_SEEN}")],
        ),
        (Level.STALE, "no sample for 3.0 s", [(CRITICAL, "FDI: no samples")]),
    ):
        assert (
            ground.hear(StatusLine(level, MONITOR_LINE, message), wait=3.0) == told
        ), message
    assert ground.announcer.due(ground.now + 4 * NS) == []
    assert ground.announcer.due(ground.now + 5 * NS) == [
        (CRITICAL, "FDI: the monitor is silent")
    ]


def test_one_late_unit_is_no_loss_of_redundancy() -> None:
    """The others could not be judged for 0.3 s in healthy flights, and before take-off."""
    ground = Ground()
    words = f"3 of 9 channels healthy; {NOTHING_SEEN}"
    for _ in range(3):
        ground.hear(StatusLine(Level.ERROR, MONITOR_LINE, words), wait=0.9)
        ground.hear(
            StatusLine(Level.OK, MONITOR_LINE, "9 of 9 channels healthy"), wait=0.5
        )
    assert ground.told == []


def test_beside_failover_a_name_waits_while_the_raw_rates_contradict_it() -> None:
    """A unit that was off is named for seconds after its fault is over."""
    apart = [0.002, 0.3, math.nan]
    ground = Ground(apart=apart.__getitem__)
    assert ground.hear(report("imu_1.x", "FAULTY"), wait=5.0) == []
    assert ground.hear(report("imu_1.x", "OK")) == []
    assert ground.hear(report("imu_1.x", "FAULTY", error="0.3")) == []
    assert ground.hear(report("imu_1.x", "FAULTY", error="0.0037")) == []
    for unit in (2, 3):
        told = [(CRITICAL, f"FDI: imu_{unit}.y faulty")]
        assert ground.hear(report(f"imu_{unit}.y", "FAULTY")) == told
    apart[0] = 0.1
    large = report("imu_1.x", "FAULTY", error="0.3")
    assert ground.hear(large) == [(CRITICAL, "FDI: imu_1.x faulty")]
    apart[0] = 0.012
    harmless = report("imu_1.z", "FAULTY", error="-0.012")
    assert ground.hear(harmless) == [(WARNING, "FDI: imu_1.z faulty")]
    assert ground.hear(*(report(name, "OK") for name in CHANNELS)) == []


def test_of_a_name_that_is_too_long_the_end_is_kept() -> None:
    channels = [f"the_imu_on_the_left_hand_side_of_the_nose.{axis}" for axis in "xyz"]
    ((_, text),) = Ground(channels).hear(report(channels[0], "FAULTY"))
    assert len(text) == TEXT_LENGTH
    assert text.endswith("_hand_side_of_the_nose.x faulty")


STATES = ["OK", "SUSPECT", "FAULTY", "AMBIGUOUS", "STALE", "UNCHECKED", "EXCLUDED"]
GROUPS = ["", "imu_1.x, imu_2.x", ", ".join(CHANNELS)]
CHANGES = st.tuples(
    st.sampled_from(CHANNELS), st.sampled_from(STATES), st.sampled_from(GROUPS)
)


@given(st.lists(CHANGES, max_size=80))
def test_however_it_flickers_the_link_is_spared_and_the_last_state_is_told(
    changes,
) -> None:
    ground = Ground()
    states = dict.fromkeys(CHANNELS, "OK")
    for name, state, group in changes:
        ground.hear(report(name, state, group), wait=0.1)
        # A suspicion is no news: what was said stands.
        states[name] = states[name] if state == "SUSPECT" else state
    busy = ground.now
    ground.hear(wait=15.0)
    assert (
        sum(at <= busy / NS for at, _, _ in ground.told)
        <= AT_ONCE + (busy / NS - 100) + 1
    )
    assert all(
        len(text) <= TEXT_LENGTH and text.isascii() for _, _, text in ground.told
    )
    for name, state in states.items():
        known = ground.announcer._said[name][0]
        assert known == (state if state in ("FAULTY", "AMBIGUOUS", "STALE") else "OK")


def test_a_unit_that_comes_and_goes_silences_nothing() -> None:
    ground, told = Ground(), []
    for k in range(40):
        state = "STALE" if k % 2 else "OK"
        told += ground.hear(
            report("imu_1.x", "FAULTY"),
            *(report(f"imu_3.{axis}", state) for axis in "xyz"),
            wait=0.05,
        )
    assert (CRITICAL, "FDI: imu_1.x faulty") in told[:2]
