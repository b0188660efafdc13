# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which positions of accelerometers are written, and how uncertain they are said to be."""

import numpy as np
import pytest
from monitor.streams import parallel

from fdi_ros.setup.positions import Position, position_settings

VALUE = np.array([0.10, -0.05, 0.02])


@pytest.mark.parametrize(
    ("error", "place", "std"),
    [
        ([0.002, 0.009, 0.004], [0.10, -0.05, 0.02], 0.009),
        # Axes that are not measured stay as configured, and the worst one counts.
        ([0.002, 0.011, 0.004], [0.10, 0.01, 0.02], 0.3),
        ([0.4, 0.4, 0.004], [0.01, 0.01, 0.02], 0.3),
    ],
)
def test_a_position_is_as_uncertain_as_its_worst_axis(error, place, std):
    config = parallel(
        2,
        accelerometers__positions=[0.0] * 3 + [0.01] * 3,
        accelerometers__position_std=[0.0, 0.3],
    )
    found = Position(1, "imu_2", VALUE, np.array(error))
    written = position_settings((found,), config)
    assert written["accelerometers.positions"] == [0.0] * 3 + place
    assert written["accelerometers.position_std"] == [0.0, std]


def test_a_position_of_which_no_axis_is_measured_is_not_written():
    found = Position(1, "imu_2", VALUE, np.full(3, 0.011))
    assert position_settings((found,), parallel(2)) == {}
