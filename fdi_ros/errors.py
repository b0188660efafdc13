# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every error that a user can cause. Each is one line that names the value and the bound."""

from __future__ import annotations


class FdiError(Exception):
    """Base of all known errors: shown as one line, exit code 2."""


class ConfigError(FdiError):
    """A parameter is unknown, of the wrong type or out of its range."""


class GeometryError(FdiError):
    """The sensitivity axes cannot carry a body rate or its check."""


class DetectorError(FdiError):
    """A detector was asked for something it cannot do."""


class FaultError(FdiError):
    """A fault to be injected is not described correctly."""


class BagError(FdiError):
    """A recording is missing, damaged or does not hold what was asked for."""


class CalibrationError(FdiError):
    """A recording does not show what a calibration needs."""


class DisagreementError(CalibrationError):
    """Channels contradict each other."""


class StudyError(FdiError):
    """A Monte-Carlo study is not described correctly, or cannot be run."""
