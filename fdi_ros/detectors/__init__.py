# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which channels disagree: one file per method of a paper, one line per method in the registry."""

from __future__ import annotations

from typing import Any

from fdi_ros.detectors.base import Detector, Verdict, accepted_options
from fdi_ros.detectors.papers.cusum import Cusum
from fdi_ros.detectors.papers.guaranteed import Guaranteed
from fdi_ros.detectors.papers.identification import Determinant, Projector, Recursive
from fdi_ros.detectors.papers.likelihood_ratio import LikelihoodRatio
from fdi_ros.detectors.papers.residual_search import MaxResidual, MeanAbsResidual, MeanSquareResidual, RateDeviation
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.errors import DetectorError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

DETECTORS: dict[str, type[Detector]] = {
    "mean_abs_residual": MeanAbsResidual,
    "mean_square_residual": MeanSquareResidual,
    "rate_deviation": RateDeviation,
    "max_residual": MaxResidual,
    "projector": Projector,
    "recursive": Recursive,
    "determinant": Determinant,
    "guaranteed": Guaranteed,
    "likelihood_ratio": LikelihoodRatio,
    "cusum": Cusum,
    "sequential": Sequential,
}


def detector_class(name: str) -> type[Detector]:
    """Class of a detector by name.

    Raises
    ------
    DetectorError
        If there is none of that name; the message lists those there are.
    """
    if name not in DETECTORS:
        raise DetectorError(f"unknown detector {name!r}, expected one of: {', '.join(DETECTORS)}")
    return DETECTORS[name]


def create_detector(name: str, geometry: Geometry, noise: NoiseModel, **options: Any) -> Detector:
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
        If there is no such detector, it does not take an option, or it cannot run on this geometry.
    ConfigError
        If an option is out of its range.
    """
    method = detector_class(name)
    for option in options:
        if option not in accepted_options(method):
            known = ", ".join(accepted_options(method)) or "none"
            raise DetectorError(f"detector {name} has no option {option!r}, expected one of: {known}")
    return method(geometry, noise, **options)


__all__ = ["DETECTORS", "Detector", "Verdict", "accepted_options", "create_detector", "detector_class"]
