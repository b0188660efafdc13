"""Result of a calibration: what was found, how sure it is, and what to be warned of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.bias import Bias
from fdi_ros.calibration.data import Array, Index
from fdi_ros.calibration.faults import Faults
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.calibration.plausibility import mount_warnings, noise_warnings, reference_warnings
from fdi_ros.calibration.self_check import HIGH, LOW, SelfCheck

LARGE_ERROR = 0.005
"""Standard error of an axis worth a warning: 0.5 % or 0.3 deg."""
LARGE_BIAS = 0.1
"""rad/s."""
LARGE_SWING = 5e-4
"""Within a recording a bias moves by less, rad/s: 0.03 deg/s."""
SPANNING = 0.1
"""Determinant of three axes that are a unit of their own."""


@dataclass(frozen=True)
class Delay:
    """Delay of the stamps of channels that are sampled together, against those of the reference."""

    channels: tuple[int, ...]
    value: float
    """s; positive: their stamps are late, what they stand for was measured that much earlier. As imus.delays has it."""
    error: float
    """s."""

    @property
    def shown(self) -> bool:
        """Whether the data show one."""
        return abs(self.value) > 3 * self.error


@dataclass(frozen=True)
class Unusable:
    """Samples of each channel that were not used, (n,) each, and why."""

    missing: Index
    non_finite: Index
    out_of_range: Index
    repeated: Index
    spikes: Index


@dataclass(frozen=True)
class Calibration:
    """Result on the channels in use; what it says of channels is in their order."""

    names: tuple[str, ...]
    channels: tuple[int, ...]
    """Number of each of these channels in the configuration."""
    reference: tuple[int, ...]
    """The three channels that fix the body frame and the scale, as numbers of these channels."""
    nominal: Array
    """(n, 3) as configured."""
    axes: Array
    """(n, 3)."""
    axes_covariance: Array
    """(n, 3, 3); zero for the reference."""
    bias: Bias
    noise: NoiseFit
    """As the pipeline meets it."""
    delays: tuple[Delay, ...]
    faults: Faults
    unusable: Unusable
    seconds: dict[str, float]
    """Length of the recording, of its rests and of its motion, s."""
    settings: dict[str, object]
    """Parameters to be changed, ``{"section.field": value}``."""
    before: SelfCheck
    """The configuration as it was, on the same samples."""
    after: SelfCheck
    """With the settings."""
    notes: tuple[str, ...] = ()
    """What the recording does not show, and what stands in its place; empty: from rest, all of it is shown."""

    @property
    def scale_error(self) -> Array:
        """(n,) standard error of each scale factor, relative."""
        return np.sqrt(np.maximum(np.einsum("ia,iab,ib->i", self._unit, self.axes_covariance, self._unit), 0))

    @property
    def angle_error(self) -> Array:
        """(n,) standard error of each direction, rad, in each of the two directions across it."""
        across = np.trace(self.axes_covariance, axis1=1, axis2=2) - self.scale_error**2
        return np.sqrt(np.maximum(across, 0) / 2) / np.linalg.norm(self.axes, axis=1)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to look at before trusting it, a line each."""
        return (
            *self._of_repeats(),
            *self._of_faults(),
            *self._of_mounting(),
            *self._of_accuracy(),
            *self._of_swing(),
            *self._of_check(),
        )

    def _of_repeats(self) -> list[str]:
        counts = self.unusable.repeated
        return [
            f"{name} repeats one value exactly for long, {counts[i]} samples in all: they were left out as neither rest"
            " nor data"
            for i, name in enumerate(self.names)
            if counts[i]
        ]

    def _of_faults(self) -> list[str]:
        return [
            f"{' or '.join(self.names[i] for i in span.channels)} disagrees with the others from {span.start:.1f} s to"
            f" {span.end:.1f} s by {span.size:.3g} rad/s: that time was left out"
            for span in self.faults.spans
        ]

    def _of_mounting(self) -> list[str]:
        reference = list(self.reference)
        found, explained = reference_warnings(self.axes, self.nominal, self._units, reference, self.names)
        found += mount_warnings(self.axes, self.nominal, self.names, [*reference, *explained])
        return [*found, *noise_warnings(self.noise.std, reference, self.names)]

    def _of_accuracy(self) -> list[str]:
        found = []
        for i, name in enumerate(self.names):
            if max(self.scale_error[i], self.angle_error[i]) > LARGE_ERROR:
                found.append(
                    f"axis of {name} is uncertain by {np.degrees(self.angle_error[i]):.2f} deg and"
                    f" {self.scale_error[i]:.2%}: record more rotation"
                )
            if abs(self.bias.mean[i]) > LARGE_BIAS:
                found.append(f"{name} has a bias of {self.bias.mean[i]:.3f} rad/s")
        return found

    def _of_swing(self) -> list[str]:
        swing = np.ptp(self.bias.course, axis=0)
        moving = [name for name, size in zip(self.names, swing, strict=True) if size > LARGE_SWING]
        if not moving:
            return []
        most = float(swing.max())
        who = "every channel" if len(moving) == len(self.names) else ", ".join(moving)
        return [
            f"bias of {who} moved within the recording, by up to {most:.2g} rad/s"
            f" ({np.degrees(most):.2g} deg/s): bias.fixed is its mean"
        ]

    def _of_check(self) -> list[str]:
        found = [
            f"normalised residuals are {c.overall:.2f} in {c.name} motion, expected {LOW} to {HIGH}"
            for c in self.after.classes
            if c.samples > 100 and not self._lowest <= c.overall <= HIGH
        ]
        found += [f"with these settings the monitor declares at {at:.1f} s: {text}" for at, text in self.after.declared]
        return found

    @property
    def _lowest(self) -> float:
        """Least normalised residual that is no surprise: where noise is that of flight, rest and aligning lower it."""
        return 0.0 if self.notes else LOW

    @property
    def _units(self) -> list[list[int]]:
        """Channels of the triads that are whole, in use, and not the reference."""
        place = {channel: k for k, channel in enumerate(self.channels)}
        whole = [[3 * u, 3 * u + 1, 3 * u + 2] for u in range(max(self.channels) // 3 + 1)]
        units = [[place[i] for i in unit] for unit in whole if all(i in place for i in unit)]
        spanning = [unit for unit in units if abs(np.linalg.det(self.nominal[unit])) > SPANNING]
        return [unit for unit in spanning if not set(unit) & set(self.reference)]

    @property
    def _unit(self) -> Array:
        return self.axes / np.linalg.norm(self.axes, axis=1)[:, None]
