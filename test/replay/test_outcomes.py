# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which declarations an injected fault explains."""

import pytest

from fdi_ros.faults.fault import parse_fault
from fdi_ros.replay.outcomes import Followed


@pytest.mark.parametrize(
    ("at", "explains"),
    [(4.99, False), (5.0, True), (6.0, True), (6.99, True), (7.01, False)],
)
def test_a_fault_explains_declarations_until_a_second_after_its_end(at, explains):
    fault = parse_fault("channel=imu_1.x kind=bias size=0.1 start=5 stop=6")
    followed = Followed(fault, [0], ["imu_1.x", "imu_1.y"])
    assert followed.is_active(at) == explains
    assert followed.explains(at, ["imu_1.y", "imu_1.x"]) == explains
    assert not followed.explains(at, ["imu_1.y"])
