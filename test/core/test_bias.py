# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The start-up average: what it makes of noise, spikes and biases, and what it does not take for rest."""

from functools import partial

import numpy as np
import pytest
from monitor.streams import RATE, config
from monitor.streams import SIGMA as NOISE

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.core.bias import EFFICIENCY
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

LENGTH = 300
"""Samples of an average."""
config = partial(config, bias__startup_bias_duration=LENGTH / RATE)


def noise(seed, n=6):
    return NOISE * np.random.default_rng(seed).standard_normal((LENGTH + 20, n))


def learned(z, **parameters):
    """Biases after the time of one average, and the words."""
    pipeline = Pipeline(config(**parameters))
    output = pipeline.process(Block(np.arange(len(z)) * round(1e9 / RATE), z))
    status = pipeline.status()
    return np.array(status.bias), status.bias_state, output


def turned(z, rate, axis=2):
    """The same with the body turning about an axis."""
    return z + Pipeline(config()).geometry.axes[:, axis] * rate


def test_in_white_noise_it_is_as_exact_as_stated_and_without_bias():
    rng, pipeline, found = np.random.default_rng(2), Pipeline(config()), []
    stated = pipeline.noise.bias_std
    for k in range(100):
        stamp = (np.arange(LENGTH + 1) + k * (LENGTH + 1)) * round(1e9 / RATE)
        pipeline.process(Block(stamp, NOISE * rng.standard_normal((LENGTH + 1, 6))))
        found.append(pipeline.status().bias)
        pipeline.relearn_bias()
    error = np.ravel(found) / np.tile(stated, 100)
    assert np.abs(error.mean()) < 4 / np.sqrt(len(error))
    assert error.std() == pytest.approx(1.0, abs=2.8 / np.sqrt(2 * len(error)))


@pytest.mark.parametrize(
    ("rows", "channels", "size", "limit"),
    [
        # A spike of 100 sigma a second, of all or one, and half a second of one channel.
        (np.s_[37::100], np.s_[:], 100 * NOISE, 4.5),
        (np.s_[37::100], 4, 100 * NOISE, 4.5),
        (np.s_[100:150], 1, 0.1, 6.0),
    ],
)
def test_what_disturbs_for_a_moment_hardly_moves_a_bias(rows, channels, size, limit):
    z = noise(3)
    z[rows, channels] += size
    bias, words, output = learned(z)
    assert words == "learned"
    assert np.abs(bias).max() < limit * NOISE / np.sqrt(EFFICIENCY * LENGTH)
    assert (output.state[LENGTH + 10] != ChannelState.UNCHECKED).all()


@pytest.mark.parametrize(("every", "known"), [(3, True), (5, False)])
def test_a_channel_with_few_values_learns_no_bias(every, known):
    """A unit may be slower than the others, but not by as much as one that fails."""
    z = noise(8) + 0.01
    kept = np.arange(len(z)) % every == 0
    z[~kept, 4] = np.nan
    bias, words, _ = learned(z, bias__turn_on_std=0.01)
    assert words == ("learned" if known else "learned, but not of g5")
    assert bias[[0, 1, 2, 3, 5]] == pytest.approx(0.01, abs=0.001)
    assert bias[4] == pytest.approx(0.01 if known else 0.0, abs=0.001)


def test_the_bias_of_a_channel_taken_out_at_the_start_is_as_uncertain_as_before():
    """An operator may take it into use again, and nothing was averaged meanwhile."""
    turn_on_std = 0.01
    settings = config(bias__turn_on_std=turn_on_std, excluded_channels=["g5"])
    pipeline = Pipeline(settings)
    z = noise(9)
    pipeline.process(Block(np.arange(len(z)) * round(1e9 / RATE), z))
    assert pipeline.status().bias_state == "learned"
    std = pipeline.core["sample"]["bias_std"][0, :6]
    assert std[4] == turn_on_std
    averaged = NOISE / np.sqrt(EFFICIENCY * LENGTH)
    assert np.delete(std, 4) == pytest.approx(averaged, rel=0.05)


@pytest.mark.parametrize(("rate", "axis"), [(0.02, 0), (0.05, 1), (0.09, 2), (0.02, 2)])
def test_a_slow_turn_is_no_bias(rate, axis):
    found, words, output = learned(turned(noise(5), rate, axis))
    assert words.startswith("not at rest at the start: biases as given")
    assert np.abs(found).max() < 0.3 * rate
    assert output.valid[LENGTH + 2 :].all(), "it goes on with the biases as given"
    # One that biases hide is refused for what it varies.
    bias = 0.02 * np.random.default_rng(6).standard_normal(6)
    sway = 0.02 * np.sin(np.arange(LENGTH + 20) / 100)[:, None]
    _, words, _ = learned(turned(noise(6) + bias, sway, axis))
    assert words.startswith("not at rest at the start: biases as given")


def test_the_rotation_of_the_earth_and_biases_that_are_usual_or_given_are_rest():
    tremble = 0.002 * np.sin(2 * np.pi * 7 * np.arange(LENGTH + 20)[:, None] / RATE)
    for seed in range(12):
        bias = 0.005 * np.random.default_rng(100 + seed).standard_normal(6)
        found, words, _ = learned(turned(noise(seed) + bias, 7.3e-5 + tremble))
        assert words == "learned"
        assert found == pytest.approx(
            bias, abs=5 * NOISE / np.sqrt(EFFICIENCY * LENGTH)
        )
    given = [0.05 * x for x in Pipeline(config()).geometry.axes[:, 0]]
    assert learned(noise(7) + given)[1].startswith("not at rest")
    assert learned(noise(7) + given, bias__fixed=given)[1] == "learned"


def first_average(folder, settings, start, end):
    pipeline = Pipeline(settings)
    pipeline.process(read_block(folder, settings, start, end))
    return pipeline.status().bias_state


def test_real_units_at_rest_are_taken_as_such_and_turned_by_hand_not(recording, root):
    settings = Config.from_file(
        root / "config" / "three_imus.yaml", {"detector.name": "likelihood_ratio"}
    )
    # Biases of up to 0.024 rad/s, not calibrated; all three units and every two of them.
    for kept in ([0, 1, 2], [0, 1], [1, 2], [0, 2]):
        mounts = np.reshape(settings.imus.mounts, (3, 9))[kept].ravel().tolist()
        some = {
            "imus.topics": [settings.imus.topics[k] for k in kept],
            "imus.names": [],
            "imus.mounts": mounts,
        }
        assert first_average(recording, settings.replaced(some), 0.0, 4.0) == "learned"
    assert first_average(recording, settings, 18.0, 21.5).startswith("not at rest")
