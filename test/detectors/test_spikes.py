# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A spike of one sample never enters the fused rate; it is counted for its channel, and for no other."""

import sys
from pathlib import Path

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, parallel, swing
from vehicles import vehicle

from fdi_ros import Block, Config, Pipeline, replay
from fdi_ros.experiments.flight import regular_stamps
from fdi_ros.monitor.output import ChannelState

# For this import alone: a module there has the name of a folder of tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))
from trials import START, Asked
from vibration import config_of, flight_of

sys.path.pop(0)

CASES = Path(__file__).parents[3] / "shared" / "data" / "cases"
FIRST = 500  # sample of the first spike


def judged(units, size, whole_unit, every):
    """Judge one flight with and without spikes; return both outputs, the samples of spikes and their counts."""
    pipeline = Pipeline.from_config(config_of(units, 100.0, Asked()))
    rng = np.random.default_rng([units, every])
    flight = flight_of(pipeline.config, pipeline.geometry.axes, rng)
    values = flight.values()
    stamps = regular_stamps(60.0, 100.0, START)[: len(values)]
    clean = pipeline.process(Block(stamps, values.copy()))
    at = np.arange(FIRST, len(values) - 20, every) + rng.integers(
        0, every // 3, len(range(FIRST, len(values) - 20, every))
    )
    struck = [3, 4, 5] if whole_unit else [4]
    for k in at:
        values[k, struck] += size * rng.choice([-1.0, 1.0], len(struck))
    pipeline.restart()
    spiked = pipeline.process(Block(stamps, values))
    counts = [one.counts["spikes"] for one in pipeline.status().channels]
    return clean, spiked, at, np.array(counts), struck


@pytest.mark.parametrize("units", [2, 3])
@pytest.mark.parametrize("size", [1.0, 5.0, 34.0])
@pytest.mark.parametrize("whole_unit", [False, True])
def test_no_spike_enters_the_rate(units, size, whole_unit):
    clean, spiked, at, counts, struck = judged(units, size, whole_unit, 97)
    change = np.abs(spiked.rate - clean.rate)
    std = np.sqrt(np.einsum("kii->ki", clean.covariance))
    assert spiked.valid.sum() == clean.valid.sum()
    assert (change[at] < 6 * std[at]).all()
    assert np.nanmax(change) < 0.05
    # The covariance stays what it was, but for the channels that a sample lacks.
    others = np.sqrt(np.einsum("kii->ki", spiked.covariance))
    assert np.nanmedian(others / std) < 1.1
    assert (counts[struck] == len(at)).all()
    assert not np.delete(counts, struck).any()
    assert not [event for event in spiked.events if event.declares]


def test_a_lasting_step_is_no_spike():
    """It is left out at once as well, and named."""
    pipeline = Pipeline.from_config(config_of(3, 100.0, Asked()))
    flight = flight_of(
        pipeline.config, pipeline.geometry.axes, np.random.default_rng(1)
    )
    values = flight.values()
    values[3000:, 4] += 1.0
    stamps = regular_stamps(60.0, 100.0, START)[: len(values)]
    output = pipeline.process(Block(stamps, values))
    named = [event for event in output.events if event.declares]
    assert [event.channel for event in named] == [4]
    assert 3000 <= named[0].row < 3030
    assert sum(one.counts["spikes"] for one in pipeline.status().channels) == 0
    error = output.rate - flight.truth_at((output.instant - START) * 1e-9)
    assert np.abs(error[3000:3100]).max() < 0.03


def spikes_counted(pipeline, stamps, z):
    """Spikes of each channel, of a stream in which nothing is declared."""
    output = pipeline.process(Block(stamps, z))
    assert not any(event.declares for event in output.events)
    return [one.counts["spikes"] for one in pipeline.status().channels]


def test_a_spike_that_delays_spread_over_several_samples_is_counted_once():
    """Values of a unit that is in time are interpolated where another one is 8 ms late."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time = np.arange(3000) / RATE
    z = np.hstack([swing(time, 2.0), swing(time - 0.008, 2.0), swing(time, 2.0)])
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    z[[2500, 2600, 2700, 2800], 1] += 1.0
    counts = spikes_counted(pipeline, START + np.arange(3000) * 10_000_000, z)
    assert counts == [0, 4, *[0] * 7]


@pytest.mark.parametrize(("hole", "counted"), [(0, 1), (3_000_000_000, 0)])
def test_of_two_units_a_spike_is_counted_only_where_the_rate_before_is_known(
    hole, counted
):
    """Just after a hole in the stream the spike may be of either unit."""
    pipeline = Pipeline(parallel(2, detector__name="sequential"))
    z = np.tile(swing(np.arange(700) / RATE), 2)
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    z[600, 4] += 1.0
    stamps = START + np.arange(700) * 10_000_000
    stamps[600:] += hole
    assert spikes_counted(pipeline, stamps, z) == [0, 0, 0, 0, counted, 0]


@pytest.mark.skipif(not CASES.is_dir(), reason="needs the cases beside the project")
def test_spikes_of_a_recording_are_counted():
    config = Config.from_file(CASES / "clean_settings.yaml")
    summary = replay(CASES / "spikes_5_every_1s.csv", config)
    counts = {one.name: one.spikes for one in summary.monitor.channels if one.spikes}
    assert counts == {"imu_1.y": 24}
    rms = [one.residual_rms_rad_s for one in summary.monitor.channels]
    assert max(rms) < 2 * min(rms)


def test_a_spike_while_a_set_is_open_names_no_channel():
    """Turns by hand that begin at once open sets; the mean that names a channel lacks the spikes."""
    one, sets = vehicle(3, "rest and turns", 3), 0
    axes = {
        "geometry.preset": "axes",
        "geometry.axes": one.axes.ravel().tolist(),
        "imus.mounts": [],
    }
    pipeline = Pipeline.from_config(one.config.replaced(axes))
    for seed in (4, 5, 6, 9):
        rng, z = np.random.default_rng(seed), one.block.z.copy()
        z[rng.integers(len(z), size=60), rng.integers(9, size=60)] += 3.0
        pipeline.restart()
        output = pipeline.process(Block(one.block.stamp, z))
        assert not (output.state == ChannelState.FAULTY).any()
        sets += (output.state == ChannelState.AMBIGUOUS).any()
    assert sets
