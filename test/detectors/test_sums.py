# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Since when the values of one time scale show a fault, to the value."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.detectors.sums import Scale, look_back
from fdi_ros.estimator.estimator import Constants, Estimator


def looked_back(values, sign=1.0):
    """Values since the onset of a fault of the only channel, and their evidence."""
    params, kf = allocate(Constants)[0], allocate(Estimator)[0]
    params["sensors"]["n"] = 1
    kf["judged"] = 1
    kf["noise"]["degrees"][0] = 50.0
    scale = allocate(Scale)[0]
    scale["series"][: len(values), 0] = values
    scale["newest"] = len(values) - 1
    scale["kept"] = len(values)
    return look_back(params, kf, scale, 0, sign)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("faulty", [2, 3, 6])
def test_a_fault_began_with_the_first_value_that_shows_it(faulty, sign):
    values = np.repeat([0.0, 4.0 * sign], [8, faulty])
    since, evidence = looked_back(values, sign)
    assert since == faulty
    # Of normal values it would be half their squares: 8 for each.
    assert 0.4 * 8.0 * faulty < evidence < 8.0 * faulty
    assert looked_back(values, -sign) == (0, 0.0)


def test_a_single_value_is_no_evidence():
    assert looked_back([0.0, 0.0, 0.0, 8.0]) == (1, 0.0)
