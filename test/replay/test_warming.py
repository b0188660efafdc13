# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An error is called warming only if the temperature of the unit explains it better than time does."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from bag.logs import GRAVITY, Unit, write_dataflash
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from replay.test_recurring import episode

from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.episodes import Story, Stretch, warming_words
from fdi_ros.replay.run import replay
from fdi_ros.replay.span_means import SPANS, SpanMeans, Temperature, with_warming
from fdi_ros.replay.warming import LARGEST_SLOPE, WARMING_SIGNS, Warming, fit_warming
from fdi_ros.report.layout import DEGREES

CRASH = ROOT.parent / "shared" / "data" / "logs" / "quad_imu0_warms_and_crashes.bin"
SITL = ROOT.parent / "shared" / "data" / "sitl"
NOISE = 2e-4
"""Noise of the mean of a second, rad/s."""


def curved(time, share=0.25, warming=12.0):
    """A unit that warms as after switching on, degC. ``share``: time constant over the whole."""
    return 30.0 + warming * (1.0 - np.exp(-time / (share * time[-1])))


def straight(time, share=0.0, warming=12.0):
    return 30.0 + warming * time / time[-1]


def flat(time, share=0.0, warming=12.0):
    return 30.0 + 0.2 * np.sin(time)


def means(count=90, seed=0):
    """Times, noise of an error, and a vector in motion."""
    random = np.random.default_rng(seed)
    time = np.arange(count) + 0.5
    return time, random.normal(0.0, NOISE, count), random.normal(0, 0.3, (count, 3))


shares = st.floats(0.1, 0.5)
sizes = st.floats(0.01, 0.5).flatmap(lambda size: st.sampled_from([size, -size]))
counts = st.integers(40, 400)
seeds = st.integers(0, 2**32 - 1)


# The fit


@given(
    counts,
    seeds,
    shares,
    st.floats(4.0, 40.0).flatmap(lambda rise: st.sampled_from([rise, -rise])),
    st.floats(1e-3, 0.009).flatmap(lambda slope: st.sampled_from([slope, -slope])),
)
def test_an_error_in_proportion_to_the_temperature_is_found(
    count, seed, share, rise, slope
):
    time, noise, vector = means(count, seed)
    temperature = curved(time, share, rise)
    # Scale error and mounting of a few percent do not hide it.
    error = noise + vector @ (0.01, -0.02, 0.005) + slope * temperature
    fit = fit_warming(time, error, temperature, vector)
    if fit is None:
        # The part of the motion is larger.
        assert np.std(slope * temperature) < 0.03
        return
    assert fit.slope == pytest.approx(slope, abs=8 * NOISE / np.ptp(temperature))
    assert fit.range == pytest.approx(np.sign(rise) * np.ptp(temperature))
    # An error of 40 times the noise is far from any line.
    assert fit.certain or abs(slope * rise) < 40 * NOISE or share > 0.4


@given(counts, seeds, shares, sizes, st.floats(0.02, 0.98))
def test_a_step_is_no_warming(count, seed, share, size, at):
    time, noise, vector = means(count, seed)
    error = noise + size * (time > at * time[-1])
    for course in (curved, straight, flat):
        temperature = course(time, share)
        assert fit_warming(time, error, temperature, vector, np.inf) is None


@given(seeds, st.floats(0.0, 4.0), st.floats(2.0, 5.0))
def test_a_step_is_no_warming_where_a_heater_starts_about_then(seed, late, lag):
    time, noise, vector = means(90, seed)
    heated = np.maximum(time - 40.0, 0.0)
    temperature = 30.0 + 12.0 * (1.0 - np.exp(-heated / lag))
    step = 0.05 * (time > 40.0 + late)
    assert fit_warming(time, noise + step, temperature, vector) is None
    follows = noise + 0.004 * temperature
    assert fit_warming(time, follows, temperature, vector).certain


@given(counts, seeds, shares, sizes, st.floats(0.0, 0.8))
def test_a_steady_drift_is_never_called_warming(count, seed, share, size, at):
    """From the start or from some time on. Beside a curved or flat temperature nothing is said."""
    time, noise, vector = means(count, seed)
    error = noise + size * np.maximum(time / time[-1] - at, 0.0)
    assert fit_warming(time, error, flat(time), vector, np.inf) is None
    assert fit_warming(time, error, curved(time, share), vector, np.inf) is None
    fit = fit_warming(time, error, straight(time), vector, np.inf)
    assert fit is None or not fit.certain


def test_a_drift_beside_a_temperature_that_rises_as_steadily_is_left_open():
    time, noise, vector = means()
    fit = fit_warming(time, noise + 0.001 * time, straight(time), vector)
    assert fit is not None
    assert not fit.certain
    assert fit.slope == pytest.approx(0.001 * time[-1] / 12.0, rel=0.02)


@given(counts, seeds, shares)
def test_the_fit_is_that_of_least_squares_in_all_columns(count, seed, share):
    time, noise, vector = means(count, seed)
    temperature = curved(time, share)
    error = 3 * noise + 0.01 * vector[:, 1] + 0.002 * temperature
    fit = fit_warming(time, error, temperature, vector)
    beside = np.column_stack([np.ones(count), vector])
    whole = np.column_stack([beside, temperature])
    best, (left,) = np.linalg.lstsq(whole, error, rcond=None)[:2]
    without = np.linalg.lstsq(beside, error, rcond=None)[1]
    assert fit.slope == pytest.approx(best[-1])
    assert fit.explained == pytest.approx(1.0 - left / without[0])


@given(counts, seeds, shares, st.floats(-50.0, 50.0), st.floats(-1e6, 1e6))
def test_offsets_and_signs_change_nothing(count, seed, share, offset, later):
    time, noise, vector = means(count, seed)
    temperature = curved(time, share)
    error = noise + 0.002 * temperature
    one = fit_warming(time, error, temperature, vector)
    other = fit_warming(time + later, 1.0 - error, temperature + offset, vector)
    assert other.slope == pytest.approx(-one.slope, rel=1e-6)
    assert other.range == pytest.approx(one.range)
    assert other.explained == pytest.approx(one.explained)
    assert other.certain == one.certain


numbers = st.floats(-1e6, 1e6) | st.sampled_from([0.0, np.nan, np.inf, -np.inf])


@given(st.lists(st.tuples(*[numbers] * 6), max_size=60), st.booleans())
def test_any_values_give_nothing_or_a_fit_within_its_bounds(rows, warms):
    table = np.array(rows).reshape(-1, 6)
    time = np.arange(len(table)) + 0.5
    error, temperature, *vector = table.T
    if warms:
        with np.errstate(invalid="ignore"):
            error = error * 1e-9 + 0.002 * temperature
    fit = fit_warming(time, error, temperature, np.column_stack(vector))
    if fit is None:
        return
    finite = np.isfinite(table).all(axis=1)
    assert finite.sum() >= WARMING_SIGNS.spans
    assert abs(fit.range) == pytest.approx(np.ptp(temperature[finite]))
    assert abs(fit.range) >= WARMING_SIGNS.warming
    assert WARMING_SIGNS.explained <= fit.explained <= 1.0
    assert abs(fit.slope) <= LARGEST_SLOPE["rad/s"]


@pytest.mark.parametrize(
    ("warming", "slope", "count"),
    [(2.9, 0.005, 90), (12.0, 0.011, 90), (12.0, 0.005, WARMING_SIGNS.spans - 1)],
)
def test_little_warming_large_errors_and_short_records_explain_nothing(
    warming, slope, count
):
    time, noise, vector = means(count)
    temperature = curved(time, 0.2, 1.007 * warming)
    error = noise + slope * temperature
    assert fit_warming(time, error, temperature, vector) is None
    # Within the bounds, the same is warming.
    time, noise, vector = means()
    temperature = curved(time, 0.2, 3.3)
    error = noise + 0.0095 * temperature
    assert fit_warming(time, error, temperature, vector).certain


@pytest.mark.parametrize(("share", "told"), [(0.8, False), (0.95, True)])
def test_a_temperature_that_explains_too_little_is_not_named(share, told):
    time, noise, vector = means(400)
    temperature = 40.0 + 5.0 * np.sin(time / 15.0)
    heat = 0.002 * temperature
    error = heat + noise * heat.std() / noise.std() * np.sqrt(1.0 / share - 1.0)
    fit = fit_warming(time, error, temperature, vector)
    assert (fit is not None) == told


def test_an_error_of_scale_is_no_warming_though_the_rest_is():
    time, noise, vector = means()
    temperature = curved(time)
    error = noise + 0.2 * vector[:, 0] + 0.001 * temperature
    assert fit_warming(time, error, temperature, vector) is None


def test_random_walks_are_not_called_warming():
    random = np.random.default_rng(5)
    certain = left_open = 0
    for _ in range(600):
        time = np.arange(random.choice([60, 120])) + 0.5
        error = 1e-4 * random.normal(size=len(time)).cumsum()
        temperature = curved(time, random.uniform(0.15, 1.0))
        vector = random.normal(0, 1e-3, (len(time), 3))
        fit = fit_warming(time, error, temperature, vector)
        certain += fit is not None and fit.certain
        left_open += fit is not None and not fit.certain
    assert certain == 0
    assert left_open <= 15


# The means

TRIADS = Geometry.from_triads([np.eye(3)] * 3)


def stream(count, rate, warm=(0,), seed=1):
    """Means of three triads with scale errors, and the temperature, which some channels feel."""
    random = np.random.default_rng(seed)
    time = np.arange(count) / rate
    temperature = curved(time)
    rates = random.normal(0.0, 0.2, (count, 3))
    values = rates @ TRIADS.axes.T * random.normal(1.0, 0.01, 9)
    values += random.normal(0.0, 1e-3, values.shape)
    values[:, list(warm)] += 0.002 * temperature[:, None]
    return time, values, temperature


def explained(time, values, temperature, one, state=None, others=()):
    """The warming of an episode, with all units as warm."""
    made = SpanMeans(TRIADS)
    if state is None:
        state = np.full(values.shape, ChannelState.OK, dtype=np.uint8)
    for first in range(0, len(time), 777):
        rows = slice(first, first + 777)
        made.add(time[rows], values[rows], state[rows])
    course = Temperature(time, temperature)
    story = Story((Stretch(0.0, float(time[-1]), 1, 1, 1.0),), (one, *others))
    courses = dict.fromkeys(TRIADS.unit_of, course)
    return with_warming(story, {"rad/s": made}, courses).episodes[0]


def declared(*channels, state="FAULTY"):
    return episode(10.0, channels, state=state)


@pytest.mark.parametrize(("count", "rate"), [(3_000, 50.0), (6_000, 1.0)])
def test_recordings_of_a_minute_and_of_hours_have_the_same_slope(count, rate):
    assert rate > 1.0 or count > 4 * SPANS.most
    one = explained(*stream(count, rate), declared("imu_1.x"))
    (warming,) = one.warming
    assert (warming.channel, warming.unit, warming.certain) == (
        "imu_1.x",
        "imu_1",
        True,
    )
    assert warming.slope_per_c == pytest.approx(0.002, rel=0.03)
    assert warming.range_c == pytest.approx(12.0, abs=0.7)


def test_channels_that_warm_beside_it_are_no_reference():
    """Of three parallel gyros two warm alike: beside each other they would show half of it."""
    data = stream(3_000, 50.0, warm=(0, 3))
    first, second = declared("imu_1.x"), declared("imu_2.x")
    (warming,) = explained(*data, first, others=(second,)).warming
    assert warming.slope_per_c == pytest.approx(0.002, rel=0.03)


def test_values_without_data_and_copies_are_no_reference():
    time, values, temperature = stream(3_000, 50.0)
    state = np.full(values.shape, ChannelState.OK, dtype=np.uint8)
    state[:, 3:6] = ChannelState.EXCLUDED
    values[:, 3:6] = values[:, :3]
    values[1_000:, [2, 8]] = np.nan
    data = time, values, temperature
    # Without the z axes nothing measures z, and without a vector there is no error.
    assert explained(*data, declared("imu_1.x"), state).warming == ()
    values[:, 8] = values[:, 5]
    (warming,) = explained(*data, declared("imu_1.x"), state).warming
    assert warming.slope_per_c == pytest.approx(0.002, rel=0.03)


def test_a_set_is_told_of_as_a_possibility():
    data = stream(3_000, 50.0, warm=(0, 1))
    one = explained(*data, declared("imu_1.x", "imu_1.y", state="AMBIGUOUS"))
    assert one.warming_words.startswith(
        "If imu_1.x and imu_1.y are faulty, their errors follow the temperature of imu_1"
        " (0.002 and 0.002 rad/s per °C over 11 °C), so the cause is warming."
    )


def test_silence_and_other_quantities_are_not_explained():
    data = stream(3_000, 50.0)
    silent = declared("imu_1.x", state="STALE")
    assert explained(*data, silent).warming == ()
    other = declared("imu_1.accel_x")
    assert explained(*data, other).warming == ()
    assert with_warming(Story((), (silent,)), {}, {}).episodes == (silent,)


def test_the_words_have_the_unit_of_the_page_and_of_the_sensor():
    warming = Warming("imu_1.x", "imu_1", -0.002, -8.04, 0.97, True)
    one = episode(10.0, ("imu_1.x",), state="FAULTY", warming=(warming,))
    assert warming_words(one, DEGREES) == (
        "The error of imu_1.x follows the temperature of imu_1"
        " (0.11 deg/s per °C over 8 °C), so the cause is cooling."
    )
    left_open = Warming("imu_1.accel_x", "imu_1", 0.02, 8.0, 0.97, False)
    other = episode(10.0, ("imu_1.accel_x",), state="FAULTY", warming=(left_open,))
    assert warming_words(other, DEGREES) == (
        "The error of imu_1.accel_x changes with the temperature of imu_1"
        " (0.02 m/s^2 per °C over 8 °C). The cause may be heat or a steady drift:"
        " this recording cannot show which."
    )
    whole = episode(10.0, ("imu_1.x",), state="FAULTY", halves=(one, other))
    assert warming_words(whole) == f"{warming_words(one)} {warming_words(other)}"


# Flight logs


def log(path, course, error, seconds=90.0, rate=25.0):
    """A log of three IMUs at rest of which a channel has an error that depends on time and temperature."""
    random = np.random.default_rng(4)
    time = np.arange(round(seconds * rate)) / rate
    temperature = course(time)
    units = []
    for k in range(3):
        rates = random.normal(0.0, 0.002, (len(time), 3))
        if k == 1:
            rates[:, 0] += error(time, temperature - temperature[0])
        force = GRAVITY + random.normal(0.0, 0.05, rates.shape)
        stamp = np.round((10.0 + time) * 1e6).astype(np.int64)
        units.append(
            Unit(
                stamp,
                rates.astype("f4"),
                force.astype("f4"),
                temperature * (1.0 + 0.02 * k),
            )
        )
    return write_dataflash(path, units)


@pytest.mark.parametrize(
    ("course", "error", "words"),
    [
        (
            curved,
            lambda time, heat: 0.0035 * heat,
            r"follows the temperature of imu_2 \(0\.003[45]\d* rad/s per °C over 12 °C\), so the cause is warming\.",
        ),
        (curved, lambda time, heat: 0.04 * (time > 45.0), ""),
        (flat, lambda time, heat: 0.0005 * time, ""),
        (curved, lambda time, heat: 0.0005 * np.maximum(time - 10.0, 0.0), ""),
        (
            straight,
            lambda time, heat: 0.0005 * time,
            r"changes with the temperature of imu_2 .* cannot show which\.",
        ),
    ],
    ids=["warms", "step", "drift, no heat", "drift beside heat", "both are lines"],
)
def test_a_log_tells_warming_from_other_faults(fdi, tmp_path, course, error, words):
    path = log(tmp_path / "a.bin", course, error)
    page, told = tmp_path / "page.html", tmp_path / "told.json"
    code, out, _ = fdi("replay", path, "--report", page, "--json", told)
    assert code == 3
    first = out.splitlines()[0]
    assert first.startswith("FAULTY: imu_2.x from ")
    assert first.endswith("Do not fly before imu_2 is checked or replaced.")
    found = json.loads(told.read_text())
    episodes = [one for one in found["episodes"] if one["state"] == "FAULTY"]
    if not words:
        for text in (out, page.read_text(encoding="utf-8")):
            assert "the temperature of" not in text
        assert all(not one["warming"] for one in episodes)
        return
    assert re.search(rf" The error of imu_2\.x {words}", first)
    assert re.search(rf"\n       temperature: the error of imu_2\.x {words[:-3]}", out)
    assert re.search(rf"The error of imu_2\.x {words}", found["verdict"]["words"])
    assert re.search(rf"^The error of imu_2\.x {words}", episodes[0]["warming_words"])
    (warming,) = episodes[0]["warming"]
    assert (warming["channel"], warming["unit"]) == ("imu_2.x", "imu_2")
    assert "he error of imu_2.x" in page.read_text(encoding="utf-8")


def test_what_is_declared_is_the_same_without_a_thermometer(tmp_path):
    def error(time, heat):
        return 0.0035 * (curved(time) - curved(time)[0])

    known = replay(log(tmp_path / "a.bin", curved, error))
    unknown = replay(log(tmp_path / "b.bin", lambda time: 0.0 * time, error))
    assert unknown.context.temperatures == {}
    (one,), (other,) = known.story.episodes, unknown.story.episodes
    assert one.warming
    assert replace(one, warming=(), warming_words="") == other
    assert known.scores == unknown.scores


@pytest.mark.skipif(not CRASH.exists(), reason=f"not there: {CRASH.name}")
def test_the_imu_that_warms_before_a_real_crash_is_said_to_warm():
    result = replay(CRASH)
    words = (
        "The errors of imu_1.x and imu_1.y follow the temperature of imu_1"
        " (0.0025 and 0.003 rad/s per °C over 11 °C), so the cause is warming."
    )
    assert words in result.verdict.sentence
    (one,) = result.story.declared
    assert one.warming_words == words
    assert min(each.explained for each in one.warming) > 0.98


@pytest.mark.skipif(not SITL.is_dir(), reason="../shared/data/sitl is not there")
@pytest.mark.parametrize("name", ["biases.tlog", "accel_faults.bin"])
def test_faults_of_a_simulator_that_warms_are_steps(name):
    """IMUs warm by 7 and 13 K, and none of the faults depends on that."""
    result = replay(SITL / name)
    assert len(result.story.declared) > 5
    assert [one for one in result.story.episodes if one.warming] == []
