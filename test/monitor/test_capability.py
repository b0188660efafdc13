"""What the channels left can do is what their detector can do, not the axes alone."""

from __future__ import annotations

import numpy as np
import pytest

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.monitor.capability import Capabilities, Capability

SIGMA = 1e-3
ALL = np.ones(6, dtype=bool)
FIVE_LEFT = np.arange(6) != 0


def capability(name: str, mask: np.ndarray, **options: object) -> Capability:
    noise = NoiseModel(SIGMA, bound=4 * SIGMA)
    return Capabilities(create_detector(name, Geometry.two_triad_cone(), noise, **options)).of(mask)


def test_method_that_allows_no_fault_names_none() -> None:
    none = capability("guaranteed", ALL, max_faults=0)
    assert none.detectable.all()
    assert not none.isolable.any()
    assert "would be seen but not named" in none.note
    assert capability("guaranteed", ALL).isolable.all()


@pytest.mark.parametrize("options", [{"name": "max_residual"}, {"name": "projector", "norm": "l1"}], ids=str)
def test_method_that_takes_one_channel_for_another(options: dict[str, str]) -> None:
    assert capability(mask=ALL, **options).isolable.all()
    left = capability(mask=FIVE_LEFT, **options)
    assert np.array_equal(left.detectable, FIVE_LEFT)
    assert not left.isolable[0]
    assert left.isolable.sum() < 5
    assert "would be seen but not named" in left.note
    assert np.array_equal(capability("likelihood_ratio", FIVE_LEFT).isolable, FIVE_LEFT)
