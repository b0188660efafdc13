# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accelerations of real recordings: every unit measures about gravity, in m/s^2 and along the axes of its gyros."""

from pathlib import Path

import numpy as np
import pytest

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.inspection.starting_config import starting_config_of

DATA = Path(__file__).parents[3] / "shared" / "data"
RECORDINGS = (
    "logs/quad_good_prop_hover.bin",
    "logs/quad_yaw_turns.bin",
    "logs/solo_log171_start.bin",
    "sitl/accel_faults.bin",
    "sitl/accel_faults.tlog",
)


def forces_in(name):
    """Specific forces (N, units, 3), m/s^2."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"needs the recording {path}")
    found = starting_config_of(path, "refused").parameters
    block = read_block(path, Config.from_parameters(found))
    assert block.acceleration is not None
    return block.acceleration.z.reshape(len(block), -1, 3)


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_unit_of_a_log_measures_gravity_upwards(name):
    force = forces_in(name)
    assert force.shape[1] >= 2
    size = np.nanmedian(np.linalg.norm(force, axis=2), axis=0)
    assert ((size > 8.8) & (size < 10.8)).all()
    mean = np.nanmedian(force, axis=0)
    # Frames of flight logs are turned to z up: a vehicle that stands or hovers feels +g.
    assert (mean[:, 2] > 0.9 * size).all()


def test_log_and_telemetry_of_one_flight_have_the_same_accelerations():
    log, telemetry = map(forces_in, RECORDINGS[-2:])
    for of_log, of_telemetry in zip(
        np.nanmedian(log, axis=0), np.nanmedian(telemetry, axis=0), strict=True
    ):
        np.testing.assert_allclose(of_log, of_telemetry, atol=0.1)
