# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0


import numpy as np
import pytest
from scipy import stats

from fdi_ros.errors import StudyError
from fdi_ros.experiments.contenders import (
    cusum_run_length,
    fault_of_size,
    log_faulty,
    log_normal,
    lorden_delay,
    moustakides_delay,
)
from fdi_ros.model.geometry import Geometry


def test_one_parity_dimension_gives_the_normal_test():
    """Four axes: an even density ratio in |p|, so the best test is |p| against its quantile; sizes seen are |v_i| f."""
    geometry = Geometry.cone(4)
    limit = fault_of_size(geometry, 6.0)
    t = stats.norm.isf(0.5e-3)
    shift = 6.0 * geometry.sensitivity
    expected = float(np.mean(stats.norm.sf(t - shift) + stats.norm.cdf(-t - shift)))
    declared, right = limit.at(1e-3)
    assert declared == pytest.approx(expected, abs=3e-3)
    # Nothing tells the four apart.
    assert right == pytest.approx(expected / 4, abs=1e-3)


def test_the_best_decision_found_is_reached_by_the_rule_that_it_states():
    """Deciding on samples by P_i f_i / f_0, at the level of a false-alarm rate, gives the probabilities integrated."""
    geometry, size = Geometry.two_triad_cone(), 5.0
    rng = np.random.default_rng(4)
    directions = geometry.parity.T
    draws = 60_000
    channel = rng.integers(6, size=draws)
    struck = (size * rng.choice([-1, 1], draws))[:, None] * directions[channel]

    def evidence(points):
        each = [log_faulty(points, u, np.array([size]), np.eye(3)) for u in directions]
        return np.array(each) - log_normal(points, np.eye(3))

    sound = evidence(rng.standard_normal((draws, 3))).max(axis=0)
    each = evidence(rng.standard_normal((draws, 3)) + struck)
    alarm = each.max(axis=0) >= np.quantile(sound, 0.98)
    declared, right = fault_of_size(geometry, size).at(0.02)
    assert alarm.mean() == pytest.approx(declared, abs=0.012)
    assert (alarm & (each.argmax(axis=0) == channel)).mean() == pytest.approx(right, abs=0.012)


def test_above_three_parity_dimensions_there_is_no_limit():
    with pytest.raises(StudyError, match="1 to 3 dimensions, got 4"):
        fault_of_size(Geometry.cone(7), 5.0)


def test_cusum_run_lengths_of_the_textbook():
    """Reference 0.5, limit 5: two-sided run length 465 and delay 10.4 at one standard deviation (Montgomery)."""
    assert cusum_run_length(5.0, 0.5, 0.0) / 2 == pytest.approx(465, abs=0.6)
    assert cusum_run_length(5.0, 0.5, 1.0) == pytest.approx(10.4, abs=0.05)
    # Without memory: geometric.
    assert cusum_run_length(0.0, 2.0, 0.0) == pytest.approx(1 / stats.norm.sf(2.0))


@pytest.mark.parametrize("shift", [0.25, 0.5, 1.0, 2.0])
def test_the_least_delay_lies_below_a_cusum_that_watches_both_sides_and_near_the_first_order(shift):
    """Two-sided delays 510, 138, 37, 10 at a run length of 3.6e8, as tabulated."""
    known = {0.25: 510, 0.5: 138, 1.0: 37, 2.0: 10}[shift]
    least = moustakides_delay(shift, 3.6e8)
    assert 0.9 * known < least < known * 1.01
    assert least == pytest.approx(lorden_delay(shift, 3.6e8), rel=0.25)
