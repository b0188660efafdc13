# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which delays are taken off the values to come, and how much of them."""

import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.estimator.delays import transfer_delays
from fdi_ros.estimator.estimator import Constants, Estimator

PLACE = 7  # of the delay of the second unit among the states
LONGEST = 0.06  # s


def transferred(delay, late=0.0, std=1e-4):
    """Delay that is taken off, and the one that stays a state, where so much is off already, s."""
    params, kf = allocate(Constants)[0], allocate(Estimator)[0]
    params["units"] = 2
    params["layout"]["delays"][:2] = -1, PLACE
    kf["states"]["x"][PLACE] = delay
    kf["states"]["p"][PLACE, PLACE] = std * std
    kf["late"][1] = late
    moved = transfer_delays(params, kf)
    assert moved == (kf["late"][1] != late)
    return float(kf["late"][1]), float(kf["states"]["x"][PLACE])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("delay", "late", "taken"),
    [
        (0.0019, 0.0, 0.0),
        (0.0021, 0.0, 0.0021),
        (0.0021, 0.03, 0.0021),
        (0.02, 0.05, 0.01),
        (0.02, LONGEST, 0.0),
        (-0.1, 0.05, -0.1),
        (-0.2, 0.05, -0.05 - LONGEST),
    ],
)
def test_a_delay_of_more_than_two_ms_is_taken_off_up_to_sixty_in_all(
    sign, delay, late, taken
):
    off, left = transferred(sign * delay, sign * late)
    assert off == pytest.approx(sign * (late + taken))
    assert left == pytest.approx(sign * (delay - taken))
    assert abs(off) <= LONGEST * (1.0 + 1e-9)


@pytest.mark.parametrize(("sigmas", "sure"), [(4.9, False), (5.1, True)])
def test_a_delay_is_taken_off_from_five_standard_deviations_on(sigmas, sure):
    assert (transferred(0.01, std=0.01 / sigmas)[0] > 0.0) == sure
