"""What a calibration is asked for and what it knows of the channels, at rest or in flight alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.bias import Bias
from fdi_ros.calibration.data import Array, Data, Index, Mask, Rest
from fdi_ros.calibration.faults import Faults
from fdi_ros.calibration.noise import NoiseFit, View
from fdi_ros.config.config import Config
from fdi_ros.errors import DisagreementError
from fdi_ros.model.geometry import Geometry

MOST_FAULTY = 0.35
"""Share of the windows in which a channel may be faulty; with more, it cannot be said who is right."""


@dataclass(frozen=True)
class Task:
    """The channels in use, and what the configuration says of them."""

    config: Config
    data: Data
    nominal: Geometry
    reference: list[int]
    groups: Index
    """(m,) for every other channel which of them it is sampled together with; -1: with the reference."""
    units: list[list[int]]
    """Channels of each unit; where units are not known: the reference, and all others."""

    @property
    def others(self) -> list[int]:
        """Channels other than the reference."""
        return [i for i in range(self.nominal.n) if i not in self.reference]


@dataclass(frozen=True)
class Estimate:
    """What is known of the channels after some rounds."""

    rest: Rest
    faults: Faults
    bias: Bias
    geometry: Geometry
    covariance: Array
    """(n, 3, 3) of the axes."""
    late: Array
    """(n,) by how much the stamps of each channel are late against those of the reference, s."""
    late_error: Array
    """(n,) its standard error, s."""
    noise: NoiseFit
    """With the delays taken out."""
    seen: View
    notes: tuple[str, ...] = ()
    """What the recording does not show, and what stands in its place."""

    @property
    def late_shown(self) -> Array:
        """(n,) delays that the recording shows, the others zero, s."""
        return np.where(np.abs(self.late) > SHOWN * self.late_error, self.late, 0.0)


SHOWN = 3.0
"""Standard errors from which a delay is shown."""
LEAST_SKEW = 5e-5
"""What imus.max_skew is at least where delays smaller than it are to be taken off, s."""


def skew(task: Task, late: Array) -> float:
    """Find imus.max_skew, s, with which the delays (n,) s are taken off: within it, stamps count as one instant."""
    configured = task.config.imus.max_skew
    left = np.abs(late - np.round(late / task.data.step) * task.data.step)
    hidden = left[(left > 2 * LEAST_SKEW) & (left <= configured)]
    return float(f"{hidden.min() / 2:.2g}") if len(hidden) else configured


def uncertainty(covariance: Array, late_error: Array, others: list[int]) -> Array:
    """Scale and timing errors (2,) that calibrated channels have at least: what is not known of axes and delays, s."""
    axes = np.sqrt(np.trace(covariance, axis1=1, axis2=2)[others].mean() / 3)
    return np.array([axes, np.sqrt(np.mean(late_error[others] ** 2))])


def checked_geometry(axes: Array, nominal: Geometry) -> Geometry:
    """Geometry of the calibrated axes; one that no gyro can have is a channel that does not work."""
    norms = np.linalg.norm(axes, axis=1)
    for i, name in enumerate(nominal.channel_names):
        if not 0.5 <= norms[i] <= 2.0:
            raise DisagreementError(
                f"{name} has the scale factor {norms[i]:.3g} against the reference, expected 0.5 to 2:"
                " it, or the reference, does not work; mend it or name it in excluded_channels"
            )
    return Geometry(axes, nominal.channel_names)


def refuse_faulty(names: tuple[str, ...], rest: Rest, faults: Faults) -> None:
    """Refuse where one channel is faulty so long that the others cannot be sure of each other.

    Raises
    ------
    DisagreementError
        Naming it.
    """
    everything: Mask = np.ones_like(rest.window)
    for span_of in (everything, ~rest.window):
        share = faults.windows[span_of].mean(axis=0)
        if share.max() > MOST_FAULTY:
            group = [names[i] for i in np.flatnonzero(share > MOST_FAULTY)]
            spans = [s for s in faults.spans if int(share.argmax()) in s.channels]
            where = "the recording" if span_of.all() else "the motion"
            raise DisagreementError(
                f"{' or '.join(group)} disagrees with the others in {share.max():.0%} of {where} (from"
                f" {spans[0].start:.1f} s to {spans[-1].end:.1f} s, by {max(s.size for s in spans):.3g} rad/s):"
                " faulty; mend it, cut it out with --start and --end, or name it in excluded_channels"
            )
