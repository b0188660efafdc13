# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which accelerations the samples of an array take, in whatever blocks a recording is read."""

import numpy as np
import pytest

from fdi_ros.bag.samples import Samples
from fdi_ros.model.samples import Block

MESSAGES = "gaagaggaag"
"""In the order of recording: g a message of the gyros, a one of the accelerometers."""
TAKEN = [None, 2, 4, None, 8]
"""Number of the message that each sample takes: the last one since the sample before."""


@pytest.mark.parametrize(
    "cuts", [[], [1], [2, 3], [3, 4], [2, 6], [4, 6, 7], range(1, 10)]
)
def test_each_message_of_the_accelerometers_is_in_one_sample_at_most(cuts):
    samples = object.__new__(Samples)
    samples._forces, samples._waiting = 6, None
    found = []
    for numbers in np.split(np.arange(len(MESSAGES)), list(cuts)):
        values = np.tile(numbers[:, None].astype(float), 6)
        gyros = np.flatnonzero([MESSAGES[number] == "g" for number in numbers])
        block = Block(numbers[gyros], values[gyros])
        forces = samples._forces_of(block, values, gyros)
        for force, received in zip(forces.z, forces.delivered, strict=True):
            assert len({*received.tolist()}) == 1
            found.append(int(force[0]) if received[0] else None)
    assert found == TAKEN
