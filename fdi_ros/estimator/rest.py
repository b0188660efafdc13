# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rest: the test of it by the estimator of the running monitor, by calibration and by inspection.

The average of the biases at the start has a test of its own, which needs no estimator (`core/bias.py`).
"""

from __future__ import annotations

from fdi_ros.arrays import Array
from fdi_ros.compiling.compiled import compiled

REST_BLOCKS = 25
"""Blocks without motion that are rest."""
REST_STD = 3e-4
"""rad/s; of the rate at rest: the turn of the earth, and a table that trembles."""
UNLEARNED = 0.003
"""rad/s; biases of which less is known do not make a larger rate one of rest: it may be a turn."""
REST_CHI, REST_MEAN, REST_LAST = 1.6, 9.0, 12.0
"""At rest the scatter of those is at most so many times that of noise, the square of their mean and of the last one's
distance from it so many variances."""


@compiled
def rests(rates: Array, newest: int, variance: Array, bias_variance: Array, floor: float) -> bool:
    """Whether the rates of `REST_BLOCKS` blocks scatter as noise does, about zero.

    Parameters
    ----------
    rates
        (`REST_BLOCKS`, c) rad/s, in any order: of the body, or as single channels measure it.
    newest
        Place of the last of them.
    variance
        (c,) of the noise of each, (rad/s)^2.
    bias_variance
        (c,) of what is not known of the biases, (rad/s)^2.
    floor
        Variance of the rate at rest, (rad/s)^2.
    """
    scatter = largest = last = 0.0
    for a in range(rates.shape[1]):
        mean = 0.0
        for k in range(REST_BLOCKS):
            mean += rates[k, a] / REST_BLOCKS
        for k in range(REST_BLOCKS):
            gap = rates[k, a] - mean
            scatter += gap * gap / (variance[a] + floor)
            if k == newest:
                last = max(last, gap * gap / (variance[a] + floor))
        largest = max(largest, mean * mean / (floor + variance[a] / REST_BLOCKS + bias_variance[a]))
    return scatter < rates.shape[1] * (REST_BLOCKS - 1) * REST_CHI and largest < REST_MEAN and last < REST_LAST
