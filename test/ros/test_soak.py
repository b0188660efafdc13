# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Some seconds of faults one after the other; the long form is benchmark/soak.py."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from ros.harness import RATE, SIGMA, TWO_IMUS, monitoring, sound, wait

from fdi_ros.monitor.output import ChannelState

FAULTS = 5
SECONDS = 1.2


def test_every_fault_is_isolated_no_other_is_and_nothing_is_lost(tmp_path) -> None:
    random = np.random.default_rng(7)
    count = round(SECONDS * RATE)
    with monitoring(TWO_IMUS, tmp_path) as (listener, process):
        assert listener.settle()
        memory = []
        for k in range(FAULTS):
            listener.trigger("reset")
            listener.clear()
            omega, z = sound(count, seed=k)
            channel, size = int(random.integers(6)), float(random.uniform(0.05, 0.5)) * random.choice([-1, 1])
            z[count // 2 :, channel] += size
            stamps = listener.play(z)
            assert wait(lambda: len(listener.fused) == count), (k, len(listener.fused))
            rates = listener.rates()
            error = np.array([rates[stamp] for stamp in stamps.tolist()]) - omega
            assert np.abs(error).max() < 6 * 1.5 * SIGMA
            assert np.flatnonzero((listener.states() == ChannelState.FAULTY).any(axis=0)).tolist() == [channel]
            memory.append(process.memory())
        assert memory[-1] - memory[1] < 2.0
