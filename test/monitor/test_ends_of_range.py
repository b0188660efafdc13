# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values at the end of a chip's range, whole units away for a moment: what is known then, and what is not."""

from pathlib import Path

import numpy as np
import pytest
from monitor.streams import RATE, START, parallel

from fdi_ros import Block, Config, Pipeline
from fdi_ros.monitor.output import ChannelState

CASES = Path(__file__).parents[3] / "shared" / "data" / "cases"
SEQUENTIAL = {"detector__name": "sequential", "noise__scale_std": 0.003}


def case(name):
    if not (CASES / name).exists():
        pytest.skip(f"needs {CASES / name}, which is not here")
    table = np.genfromtxt(CASES / name, delimiter=",", names=True)
    values = np.column_stack([table[key] for key in table.dtype.names[1:]])
    return table["time"], values


def spun(end, rates, seconds=20.0):
    """Three units that spin about z at a rate (N,) beyond the end of their range, in its steps."""
    pipeline = Pipeline(parallel(3, health__max_rate=35.0, **SEQUENTIAL))
    rng = np.random.default_rng(1)
    truth = np.column_stack([0.0 * rates, 0.0 * rates, rates])
    values = truth @ pipeline.geometry.axes.T + rng.normal(0, 0.003, (len(rates), 9))
    step = end / 32767
    values = np.clip(np.round(values / step) * step, -end, end)
    stamps = START + np.arange(len(rates)) * round(1e9 / RATE)
    return pipeline.process(Block(stamps, values))


@pytest.mark.parametrize("degrees", [250, 500, 1000, 2000])
def test_no_rate_at_the_end_of_the_range_of_all(degrees):
    end = (
        np.radians(32767 / (32750 / degrees))
        if degrees != 250
        else np.radians(32767 / 131)
    )
    t = np.arange(2000) / RATE
    rates = 1.5 * end * np.clip(np.minimum(t - 8.0, 13.0 - t), 0.0, 1.0)
    output = spun(end, rates)
    beyond = rates > 1.02 * end
    lied = output.valid & beyond & ~np.isinf(output.level).all(axis=1)
    # A smaller range than the largest shows when its end repeats.
    assert lied.sum() <= (0 if degrees == 2000 else 5)
    assert output.valid[rates < 0.9 * end].mean() > 0.85
    assert not [event for event in output.events if event.declares]


@pytest.mark.parametrize("degrees", [250, 500, 1000])
def test_a_steady_turn_near_the_end_of_a_smaller_range_is_measured(degrees):
    t = np.arange(2000) / RATE
    rates = np.radians(degrees) * np.clip(t - 8.0, 0.0, 1.0)
    output = spun(np.radians(32767 / 16.4), rates)
    assert output.valid[300:].all()
    assert (output.state[-500:] != ChannelState.SUSPECT).all()


def test_a_recording_at_the_end_of_the_range():
    time, values = case("all_saturate_2000dps.csv")
    output = Pipeline(Config.from_file(CASES / "clean_settings.yaml")).process(
        Block(START + np.round(time * 1e9).astype(int), values)
    )
    beyond = (time > 17.4) & (time < 18.6)
    assert (~output.valid[beyond] | np.isinf(output.level[beyond]).all(axis=1)).all()
    assert output.valid[time > 19.5].all()


@pytest.mark.parametrize("silent", [True, False])
@pytest.mark.parametrize("latch", [True, False])
def test_what_was_known_is_kept_while_another_unit_is_away(silent, latch):
    time, values = case("offset_then_other_drops_out.csv")
    config = Config.from_file(CASES / "clean_settings.yaml", {"decision.latch": latch})
    received = np.isfinite(values) if silent else np.ones(values.shape, bool)
    stamps = START + np.round(time * 1e9).astype(int)
    output = Pipeline(config).process(Block(stamps, values, received))
    bad = np.isin(output.state, (ChannelState.AMBIGUOUS, ChannelState.FAULTY))
    since = time > 15.3
    assert bad[since][:, 3:6].all()
    assert not bad[:, :3].any()
    assert not bad[:, 6:].any()
    assert (output.state[-1, :3] == ChannelState.OK).all()
    truth_of_others = (values[:, :3] + values[:, 6:]) / 2
    rows = output.valid & since & np.isfinite(truth_of_others).all(axis=1)
    assert np.abs(output.rate - truth_of_others)[rows].max() < 0.05


@pytest.mark.parametrize("spike", [0.0, 30.0])
def test_after_a_spike_the_end_of_a_range_is_still_learned(spike):
    """The chips of one unit of three end at 250 deg/s."""
    t = np.arange(3000) / RATE
    end = np.radians(32767 / 131)
    truth = [5.0 * np.sin(t), 0.4 * np.cos(0.9 * t), 0.6 * np.sin(0.7 * t)]
    values = np.tile(np.column_stack(truth), (1, 3))
    values += np.random.default_rng(5).normal(0, 0.003, values.shape)
    values[:, 6:] = np.clip(values[:, 6:], -end, end)
    values[50, 6] += spike
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    stamps = START + np.arange(len(t)) * round(1e9 / RATE)
    output = pipeline.process(Block(stamps, values))
    assert not [event for event in output.events if event.declares]
    assert (output.state[:, 6] == ChannelState.SUSPECT).any()
