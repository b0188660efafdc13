# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The real recording of three IMUs, as they come, through the whole path: nothing declared, every fault named."""

import numpy as np
import pytest

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.core.decision import ChannelState
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.monitor.pipeline import Pipeline

CHANNELS = [f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"]


@pytest.fixture(scope="module")
def config(root):
    return Config.from_file(root / "config" / "three_imus.yaml")


@pytest.fixture(scope="module")
def block(recording, config):
    return read_block(recording, config, end=180.0)


@pytest.fixture(scope="module")
def sound(block, config):
    """What the monitor says of it as it is."""
    return Pipeline(config).process(block)


def declared(pipeline, output):
    return [(pipeline.channel_names[e.channel], e.after.name, e.stamp) for e in output.events if e.declares]


def test_shaken_to_saturation_it_declares_no_sound_channel(recording, config):
    """The last 30 s reach the gyros' limit of 2000 deg/s, with nominal axes and scale factors."""
    whole = read_block(recording, config)
    assert len(whole) == 13_125
    pipeline = Pipeline(config)
    output = pipeline.process(whole)
    assert declared(pipeline, output) == []
    # 3 s at rest for the bias, then a rate for every sample up to there.
    assert output.valid[188:11_251].all()
    assert pipeline.status().bias_state == "learned"
    counted = sum(channel.counts["out of range"] for channel in pipeline.status().channels)
    assert counted == (np.abs(whole.z) >= 34.8).sum() > 100


@pytest.mark.parametrize("when", ["rest", "motion"])
@pytest.mark.parametrize("channel", CHANNELS)
def test_a_bias_on_any_one_channel_is_isolated(block, config, sound, channel, when):
    seconds = (block.stamp - block.stamp[0]) / 1e9
    speed = np.linalg.norm(sound.rate, axis=1)
    moving = int(np.nanargmax(speed))
    start = 60.0 if when == "rest" else seconds[moving]
    at = int(np.searchsorted(seconds, start))
    assert speed[at] > 2.0 if when == "motion" else speed[at] < 0.02
    pipeline = Pipeline(config)
    fault = parse_fault(f"channel={channel} kind=bias size=0.2 start={start:.9f}")
    output = pipeline.process(Injector([fault], pipeline.channel_names).apply(block))
    # In motion a unit that is wrong as a whole may explain it as well for a moment: then a set is declared first.
    named = [d for d in declared(pipeline, output) if d[1] == "FAULTY"]
    assert [d[0] for d in named] == [channel]
    assert not (output.state[-1] == ChannelState.AMBIGUOUS).any()
    assert (named[0][2] - block.stamp[at]) / 1e9 <= (0.3 if when == "rest" else 1.0)
    assert output.valid[at:].all()
