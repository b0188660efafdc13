# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Times of a recorder whose clock was set back, topic by topic."""

import numpy as np
import pytest

from fdi_ros.bag.recorder_clock import RecorderClock

NS = 1_000_000_000


def followed(clock, *messages):
    """Times, s, after messages of topics at times, s."""
    topic, time = np.array(messages).T
    times = clock.follow(topic.astype(np.int64), np.round(time * NS).astype(np.int64))
    return (times / NS).tolist()


@pytest.mark.parametrize(("back", "set_back"), [(0.9, 0.0), (5.0, 5.0)])
def test_a_topic_that_begins_after_the_clock_was_set_back_goes_on_as_the_others(
    back, set_back
):
    """Less than a second back is disorder, and the times stay as they are."""
    clock = RecorderClock()
    later = 20.0 - back
    assert followed(clock, (0, 10.0), (0, 20.0)) == [10.0, 20.0]
    assert followed(clock, (0, later)) == [later + set_back]
    times = followed(clock, (1, later + 1.0), (0, later + 2.0))
    assert times == [later + 1.0 + set_back, later + 2.0 + set_back]
    assert followed(clock, (1, later + 3.0)) == [later + 3.0 + set_back]
    assert clock.set_back == set_back * NS


def test_a_topic_from_before_is_shifted_only_once_it_has_stepped_back_itself():
    clock = RecorderClock()
    followed(clock, (0, 10.0), (1, 10.0), (0, 20.0), (1, 20.0))
    assert followed(clock, (0, 15.0), (1, 21.0), (1, 15.5)) == [20.0, 21.0, 21.0]
    assert clock.least_shift == 5 * NS
