# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Over which times a slow drift is searched."""

import numpy as np
import pytest

from fdi_ros import Geometry, NoiseModel
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.estimator.error_states import places_of

RATE = 5.0


@pytest.mark.parametrize(
    ("seconds", "longest"), [(40.0, 0.0), (61.0, 60.0), (130.0, 60.0)]
)
def test_a_bias_that_changes_too_fast_is_searched_over_the_last_minutes(
    seconds, longest
):
    """No drift is in the values: each time is tried, and the shortest one last."""
    geometry = Geometry.from_triads([np.eye(3)] * 3)
    detector = Sequential(geometry, NoiseModel(1.0), sample_rate=RATE)
    noise = np.random.default_rng(0).standard_normal((2000, geometry.n))
    samples = round(seconds * RATE)
    detector.detect(noise[:samples])
    (place,) = places_of("bias rate", geometry.n, 3)[4]
    state, prior = detector.states[0], detector.constants[0]["layout"]["prior"][place]
    kf, case = state["estimator"], state["case"]
    for sigmas in (6.0, 6.6):
        searched = set()
        # It is looked for once in some blocks.
        for k in range(samples, samples + 40):
            # It is known well: the run length of 3.6e8 is reached at 6.3 deviations.
            kf["states"]["x"][place] = sigmas * prior
            kf["states"]["p"][place, place] = 0.0
            case["onset"] = 0
            detector.detect(noise[k : k + 1])
            if case["onset"]:
                searched.add(int(kf["samples"] - case["onset"]) / RATE)
        assert searched == ({longest} - {0.0} if sigmas > 6.3 else set())
        assert not case["open"]
