# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A driver or a link that repeats old values, while the other units go on."""

import numpy as np
import pytest
from monitor.streams import (
    body_rate,
    parallel,
    seconds,
    stream,
)

from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

SEQUENTIAL = {"detector__name": "sequential", "bias__startup_bias_duration": 0.0}
THIRD = slice(6, 9)  #: Channels of the third unit.


def repeated(block: Block, start: int, stop: int) -> Block:
    """Return the stream with values of the third unit that repeat from one row to another."""
    z = block.z.copy()
    z[start:stop, THIRD] = z[start, THIRD]
    return Block(block.stamp, z)


@pytest.mark.parametrize("excluded", [(), ("imu_3.x", "imu_3.y", "imu_3.z")])
def test_beside_a_unit_that_repeats_old_values_the_others_still_check_each_other(
    excluded,
):
    pipeline = Pipeline(parallel(3, excluded_channels=excluded, **SEQUENTIAL))
    block = repeated(stream(pipeline.geometry, 900), 300, 900)
    block.z[700:, 0] += 0.15
    output = pipeline.process(block)
    fault = [one for one in output.events if one.declares and one.channel in (0, 3)]
    assert {pipeline.channel_names[one.channel] for one in fault} == {
        "imu_1.x",
        "imu_2.x",
    }
    assert all(7.0 <= seconds(one) < 7.1 for one in fault)
    assert (output.state[720:, [0, 3]] == ChannelState.AMBIGUOUS).all()
    assert (output.state[320:700, [0, 1, 2, 3, 4, 5]] == ChannelState.OK).all()
    assert (output.state[-1, [1, 2, 4, 5]] == ChannelState.OK).all()
    assert not (output.state == ChannelState.FAULTY).any()
    off = np.abs(output.rate - body_rate(900))[720:, 0]
    assert (off < 3 * np.sqrt(output.covariance[720:, 0, 0])).all()
