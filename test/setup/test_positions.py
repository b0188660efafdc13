# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Positions of accelerometers: simulated vehicles with known arms, and a recording that does not turn."""

import numpy as np
import pytest
from vehicles import vehicle, with_forces

from fdi_ros.inspection.findings import Role, lines_of
from fdi_ros.setup.calibrate import calibrate
from fdi_ros.setup.report import calibration_findings

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.parametrize("kind", ["rest and turns", "flight with rest"])
def test_positions_are_within_their_errors(kind):
    one = vehicle(1, kind)
    arms = np.array([[0.0, 0.0, 0.0], [0.1, -0.05, 0.02], [0.0, 0.0, -0.03]])
    result = calibrate(with_forces(one, arms), one.config)
    for position in result.positions:
        assert (abs(position.value - arms[position.unit]) < 3 * position.error).all()
        assert position.measured.all()
        assert position.error.max() < 0.003
    config = one.config.replaced(result.settings)
    written = np.reshape(config.accelerometers.positions, (3, 3))
    np.testing.assert_allclose(written, arms, atol=0.005)
    std = config.accelerometers.position_std
    assert std[0] == 0.0
    assert 1e-5 < min(std[1:]) <= max(std[1:]) < 0.003


@pytest.mark.parametrize("noise", [0.005, 0.05])
def test_without_turns_no_position_is_measured(noise):
    one = vehicle(0, "rest and turns")
    block = with_forces(one, np.full((3, 3), 0.1) * [[0], [1], [-1]], noise)[:1450]
    result = calibrate(block, one.config)
    assert not any(position.measured.any() for position in result.positions)
    assert "accelerometers.positions" not in result.settings
    unknown = lines_of(calibration_findings(result, "base_link"), Role.UNKNOWN)
    assert sum("x not measured, y not measured" in line for line in unknown) == 2
