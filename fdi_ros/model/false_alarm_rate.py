# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How often healthy channels may raise an alarm: one value, stated in one of three ways."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

from fdi_ros.errors import ConfigError

DEFAULT_PROBABILITY = 1e-6
"""Per sample."""
DEFAULT_RUN_LENGTH, MIN_RUN_LENGTH, MAX_RUN_LENGTH = 3.6e8, 2.0, 1e15
"""Samples; the default is one false alarm in 1000 hours at 100 Hz."""
OPTIONS = ("run_length", "false_alarm_probability", "false_alarms_per_hour", "sample_rate")
"""Names of its fields among the options of a detector."""


@dataclass(frozen=True)
class FalseAlarmRate:
    """A false-alarm rate as it is asked for; stated in no way, each reading has its default.

    Parameters
    ----------
    probability
        Per sample, 0 to 1, both excluded.
    per_hour
        Expected false alarms per hour, > 0; needs the sample rate.
    run_length
        Mean samples to a false alarm.
    sample_rate
        Hz, > 0.

    Raises
    ------
    ConfigError
        If it is stated in two ways, or a value is out of its range.
    """

    probability: float | None = None
    per_hour: float | None = None
    run_length: float | None = None
    sample_rate: float | None = None

    def __post_init__(self) -> None:
        given = [name for name, value in self._named().items() if value is not None and name != "sample_rate"]
        if len(given) > 1:
            raise ConfigError(f"give {' or '.join(given)}, not both")
        if self.per_hour is not None:
            if not self.per_hour > 0 or not math.isfinite(self.per_hour):
                raise ConfigError(f"false_alarms_per_hour is {self.per_hour:g}, expected > 0")
            if self.sample_rate is None or not self.sample_rate > 0 or not math.isfinite(self.sample_rate):
                raise ConfigError(f"false_alarms_per_hour needs a sample_rate > 0 Hz, got {self.sample_rate}")

    def per_sample(self) -> float:
        """Probability of a false alarm in one sample; `DEFAULT_PROBABILITY` if nothing is stated.

        Raises
        ------
        ConfigError
            If it is not between 0 and 1.
        """
        probability = DEFAULT_PROBABILITY if self.probability is None else self.probability
        if self.per_hour is not None and self.sample_rate is not None:
            probability = self.per_hour / (3600.0 * self.sample_rate)
        elif self.run_length is not None:
            probability = 1 / self.mean_run_length()
        if not 0 < probability < 1:
            raise ConfigError(f"false-alarm probability per sample is {probability:g}, expected between 0 and 1")
        return probability

    def mean_run_length(self) -> float:
        """Mean samples to a false alarm; `DEFAULT_RUN_LENGTH` if nothing is stated.

        Raises
        ------
        ConfigError
            If it is not `MIN_RUN_LENGTH` to `MAX_RUN_LENGTH`.
        """
        samples = DEFAULT_RUN_LENGTH if self.run_length is None else self.run_length
        if self.per_hour is not None or self.probability is not None:
            samples = 1 / self.per_sample()
        if not MIN_RUN_LENGTH <= samples <= MAX_RUN_LENGTH:
            raise ConfigError(f"run_length is {samples:g} samples, expected {MIN_RUN_LENGTH:g} to {MAX_RUN_LENGTH:g}")
        return samples

    def as_options(self, accepted: Collection[str] = OPTIONS) -> dict[str, float]:
        """Return the options of a detector that state the same.

        Parameters
        ----------
        accepted
            Options that the detector takes; one that takes a run length and no probability gets the run length.
        """
        options = self._named()
        if self.probability is not None and "run_length" in accepted and "false_alarm_probability" not in accepted:
            options["run_length"] = max(1 / self.probability, MIN_RUN_LENGTH)
        return {name: value for name, value in options.items() if value is not None and name in accepted}

    def _named(self) -> dict[str, float | None]:
        return dict(zip(OPTIONS, (self.run_length, self.probability, self.per_hour, self.sample_rate), strict=True))
