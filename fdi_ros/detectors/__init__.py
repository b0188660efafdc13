# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which channels disagree: one file per method of a paper, one row per method in `DETECTORS`.

The table names classes without importing them: help and completion need the names
alone, a monitor one class.
"""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING, Any

from fdi_ros.errors import DetectorError
from fdi_ros.system.text import did_you_mean

if TYPE_CHECKING:
    from fdi_ros.detectors.base import Detector
    from fdi_ros.model.geometry import Geometry
    from fdi_ros.model.noise import NoiseModel

DETECTORS = {
    "mean_abs_residual": "papers.residual_search:MeanAbsResidual",
    "mean_square_residual": "papers.residual_search:MeanSquareResidual",
    "rate_deviation": "papers.residual_search:RateDeviation",
    "max_residual": "papers.residual_search:MaxResidual",
    "projector": "papers.identification:Projector",
    "recursive": "papers.identification:Recursive",
    "determinant": "papers.identification:Determinant",
    "guaranteed": "papers.guaranteed:Guaranteed",
    "likelihood_ratio": "papers.likelihood_ratio:LikelihoodRatio",
    "cusum": "papers.cusum:Cusum",
    "sequential": "sequential:Sequential",
}
"""Modules, in this package, and classes of the detectors by name; the one that flies last."""


def detector_class(name: str) -> type[Detector]:
    """Class of a detector by name; `DetectorError` if there is none of that name lists those there are."""
    if name not in DETECTORS:
        raise DetectorError(
            f"unknown detector {name!r}, {did_you_mean(name, tuple(DETECTORS))}"
        )
    found: type[Detector] = pkgutil.resolve_name(f"{__name__}.{DETECTORS[name]}")
    return found


def create_detector(
    name: str, geometry: Geometry, noise: NoiseModel, **options: Any
) -> Detector:
    """Build a detector by name.

    Parameters
    ----------
    name
        A key of `DETECTORS`.
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel.
    options
        Options of the method.

    Raises
    ------
    DetectorError
        If there is no such detector, it does not take an option, or it cannot run on
        this geometry.
    ConfigError
        If an option is out of its range.
    """
    from fdi_ros.detectors.base import built

    detector: Detector = built(detector_class(name), geometry, noise, options)
    return detector
