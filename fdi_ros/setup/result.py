# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a calibration found: figures with their uncertainty, the settings that follow, and what to say of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi_ros.model.noise import much_noisier, noisier_words
from fdi_ros.model.samples import Array, Int
from fdi_ros.report.layout import RADIANS, Column, Unit, figures_of, first_of
from fdi_ros.report.spectrum import Spectrum
from fdi_ros.setup.agreement import SHOWN
from fdi_ros.setup.estimate import SCALE_STD, StateEstimate
from fdi_ros.setup.findings import Finding, Role

UNMEASURED = SCALE_STD / 2  # uncertainty of the axes along a direction of the body from which they are not measured
SHOWN_AXES = SCALE_STD / 4  # the same from which they are not well shown
SHOWN_DELAY = 0.001  # the same of delays, s
LEAST_SHARE = 0.2  # part of a recording that supports its noise
LARGE_SWING = float(np.radians(0.03))  # change of a bias within a recording that is worth a look, rad/s
LARGE_BIAS = 0.2  # rad/s
LARGE_ANGLE, LARGE_SCALE = float(np.radians(5.0)), 0.05  # axes that far from nominal are worth a look
MANY = 0.01  # share of the samples that are missing or spikes, which is worth a look


class StampDelay(NamedTuple):
    """By how much the stamps of a unit are late against those of the first."""

    channels: tuple[int, ...]
    value: float  # s; positive: their stamps are late, what they stand for was measured earlier; as imus.delays has it
    error: float  # s

    @property
    def shown(self) -> bool:
        """Whether the data show one."""
        return abs(self.value) > SHOWN * self.error


class Span(NamedTuple):
    """Channels, one of which at least is faulty from one time to another, s from the start of the part used."""

    channels: tuple[int, ...]
    start: float
    end: float


@dataclass
class Calibration:
    """Result for the channels in use; all that is per channel is in their order."""

    names: tuple[str, ...]
    nominal: Array  # (n, 3) as configured
    estimate: StateEstimate
    timing: float  # what is not known of the sampling instants, s, as written
    delays: tuple[StampDelay, ...]  # of all units but the first
    faults: tuple[Span, ...]
    unusable: dict[str, Int]  # (n,) samples of each channel that were not used, by the reason: as of `Data`, and spikes
    duration: float  # of the recording, s
    settings: dict[str, object]  # parameters to be changed, ``{"section.field": value}``
    spectrum: Spectrum  # of what channels differ by from the fused rate with these settings

    def __post_init__(self) -> None:
        found, n = self.estimate, len(self.names)
        self.axes = axes = found.axes  # (n, 3)
        self.axes_std = np.sqrt(np.diag(found.axes_covariance)).reshape(-1, 3)
        self.bias_std = np.sqrt(np.diag(found.bias_covariance))  # (n,) of the mean biases, rad/s
        self.scale = found.disagreement()  # scale error left between channels, as written, and its uncertainty
        # (n,) angle between calibrated and nominal axes, rad, and its standard error in each of two directions.
        sine = np.linalg.norm(np.cross(axes, self.nominal), axis=1)
        self.angle = np.arctan2(sine, (axes * self.nominal).sum(axis=1))
        length = np.linalg.norm(axes, axis=1)
        each, along = found.axes_covariance.reshape(n, 3, n, 3), axes / length[:, None]
        # (n,) scale factor relative to nominal, and its standard error.
        self.factor = length / np.linalg.norm(self.nominal, axis=1)
        square = np.einsum("ia,iab,ib->i", along, each[range(n), :, range(n)], along)
        self.factor_error = np.sqrt(np.maximum(square, 0))
        across = (self.axes_std**2).sum(axis=1) - self.factor_error**2
        self.angle_error = np.sqrt(np.maximum(across, 0) / 2) / length
        # (3,) uncertainty of the disagreement of axes along x, y and z of the body.
        apart = np.eye(n) - axes @ np.linalg.pinv(axes)
        squares = [np.trace(apart @ each[:, a, :, a] @ apart) / max(n - 3, 1) for a in range(3)]
        self.axis_errors = np.sqrt(np.maximum(squares, 0.0))
        # (n,) channels whose scale factor the recording shows, against the others.
        self.measured = np.sqrt(along**2 @ self.axis_errors**2) < UNMEASURED
        # Places of the channels of each unit; of an array without units each channel is alone.
        unit_of = [name.rpartition(".")[0] or name for name in self.names]
        self.units = [[i for i, one in enumerate(unit_of) if one == unit] for unit in dict.fromkeys(unit_of)]


def calibration_figures(result: Calibration) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    names, found, rest = result.names, result.estimate, result.estimate.rest_seconds
    return {
        "seconds": {"all": result.duration, "rest": rest, "motion": result.duration - rest},
        "channels": figures_of(channel_columns(result)),
        "noise": {
            "share_of_recording": found.floor.share,
            "scale_std": result.scale[0],
            "scale_std_error": result.scale[1],
            "timing_std_s": result.timing,
            "bias_walk": found.bias_walk.value or None,
            "bias_walk_possible": found.bias_walk.possible,
        },
        "delays": [
            {"channels": [names[i] for i in d.channels], "late_s": d.value, "std_s": d.error, "shown": d.shown}
            for d in result.delays
        ],
        "faults": [
            {"channels": [names[i] for i in span.channels], "start_s": span.start, "end_s": span.end}
            for span in result.faults
        ],
        "settings": result.settings,
    }


def channel_columns(result: Calibration, unit: Unit = RADIANS) -> list[Column]:
    """Figures of every channel, one row each."""
    found, rate, degrees = result.estimate, unit.factor, float(np.degrees(1.0))

    def measured(values: Array, form: str) -> list[str]:
        return [
            f"{value:{form}}" if shown else "not measured" for value, shown in zip(values, result.measured, strict=True)
        ]

    lost = [{why: count[i] for why, count in result.unusable.items()} for i in range(len(result.names))]
    return [
        Column("name", result.names, ("channel",)),
        Column("axis", result.axes, ("axis x", "y", "z"), ".5f"),
        Column("axis_std", result.axes_std),
        Column("scale", result.factor),
        Column("scale_std", result.factor_error),
        Column("scale_measured", result.measured),
        Column("", measured(result.factor, ".5f"), ("scale",)),
        Column("", measured(100 * result.factor_error, ".3f"), ("+-%",)),
        Column("off_nominal_rad", result.angle, ("off nominal deg",), ".3f", degrees),
        Column("angle_std_rad", result.angle_error, ("+-deg",), ".3f", degrees),
        Column("bias", found.bias, ("bias rad/s",), ".6f", rate),
        Column("bias_std", result.bias_std, ("+-",), ".6f", rate),
        Column("noise_std", found.floor.std, ("noise rad/s",), ".5f", rate),
        Column("noise_std_error", found.floor.error, ("+-",), ".5f", rate),
        Column("noise_median", np.median(found.moment, axis=0), ("usually rad/s",), ".5f", rate),
        Column("noise_largest", found.moment.max(axis=0)),
        Column("not_used", lost, ("not used",), lambda counts: str(sum(counts.values()))),
    ]


def calibration_findings(result: Calibration, body_frame: str, unit: Unit = RADIANS) -> Iterator[Finding]:
    """List what was found, what is not known, and what to look at."""
    yield from _found(result, unit)
    yield from _unknown(result, body_frame, unit)
    yield from _warnings(result, unit)


def _found(result: Calibration, unit: Unit) -> Iterator[Finding]:
    """Noise, what is left of the errors in motion, the walk of the biases, and the delays."""
    found, name, factor = result.estimate, unit.name, unit.factor
    rest, walk, floor, usual = found.rest_seconds, found.bias_walk, found.floor, np.median(found.moment, axis=0)
    words = f"axes, biases and noise, from {rest:.1f} s at rest and {result.duration - rest:.1f} s in motion"
    yield Finding(Role.FOUND, "time at rest", words, value=rest)
    (least, most), (low, high) = ((std.min() * factor, std.max() * factor) for std in (floor.std, usual))
    words = f"noise_std {least:.2g} to {most:.2g} {name}, from the quietest {floor.share:.0%} of the recording; usually"
    words += f" {low:.2g} to {high:.2g}"
    largest = int(floor.std.argmax())
    yield Finding(Role.FOUND, "noise", words, (), float(floor.std[largest]), float(floor.error[largest]))
    words = f"scale_std {result.scale[0]:.2g} +- {result.scale[1]:.1g}, timing_std {1e3 * result.timing:.2g} ms; "
    if walk.value:
        words += f"biases walk {walk.value * factor:.2g} {name} per sqrt(s)"
    else:
        words += f"no walk of the biases shown, below {walk.possible * factor:.2g} {name} per sqrt(s)"
    yield Finding(Role.FOUND, "scale error", words, (), *result.scale)
    for delay in result.delays:
        names = [result.names[i] for i in delay.channels]
        side = "late (measured earlier than stamped)" if delay.value > 0 else "early (measured later than stamped)"
        taken = "taken off" if delay.shown else "not taken off: it may be none"
        if "imus.delays" not in result.settings:
            taken = "not taken off: one message"
        words = f"{', '.join(names)}: stamps {1e3 * abs(delay.value):.2f} +- {1e3 * delay.error:.2f} ms {side} against"
        words += f" the first unit, {taken}"
        yield Finding(Role.FOUND, "delay", words, names, delay.value, delay.error, SHOWN * delay.error)


def _unknown(result: Calibration, body_frame: str, unit: Unit) -> Iterator[Finding]:
    """List what is not observed, what is taken instead, and how to get it."""
    found, share = result.estimate, result.estimate.floor.share
    if not found.rest_seconds:
        common = float(np.sqrt(np.mean(result.bias_std**2)))
        words = (
            "nowhere at rest: what all biases have in common looks like a rotation"
            f" (+-{common * unit.factor:.2g} {unit.name}); noise_std is the lower envelope in motion. Let the vehicle"
            " stand still for 10 s, motors off"
        )
        yield Finding(Role.UNKNOWN, "rest", words, error=common)
    elif share <= LEAST_SHARE:
        words = f"noise_std is from the quietest {share:.0%} of the recording: a longer rest would show it better"
        yield Finding(Role.UNKNOWN, "rest", words, value=share, bound=LEAST_SHARE)
    error, rms = result.axis_errors, np.std(found.rate, axis=0) * unit.factor
    if unmeasured := ["xyz"[a] for a in range(3) if error[a] > UNMEASURED]:
        which = " and ".join(unmeasured)
        along, about = ("", "") if len(unmeasured) == 3 else (f" along {which}", f" about {which}")
        words = (
            f"scale factors{along}: not measured (no turns{about} beyond what vibration explains); they stay near those"
            " configured, with their uncertainty. Turn it back and forth, some 1 rad/s"
        )
        yield Finding(Role.UNKNOWN, "scale factors", words, unmeasured, None, float(error.max()), UNMEASURED)
    if poor := [a for a in range(3) if SHOWN_AXES < error[a] <= UNMEASURED]:
        turns = ", ".join(f"{'xyz'[a]} ({rms[a]:.2g} {unit.name} rms, axes +-{error[a]:.1%})" for a in poor)
        words = (
            f"too little rotation about {turns} of {body_frame}: the axes stay near those configured there."
            " Turn it back and forth about them, some 1 rad/s"
        )
        yield Finding(Role.UNKNOWN, "axes", words, ["xyz"[a] for a in poor], None, float(error[poor].max()), SHOWN_AXES)
    if late := [d for d in result.delays if d.error > SHOWN_DELAY]:
        names = list(dict.fromkeys(result.names[d.channels[0]].rpartition(".")[0] for d in late))
        worst = max(d.error for d in late)
        words = f"delays of {', '.join(names)} are known to {1e3 * worst:.1f} ms only: turn it faster, back and forth"
        yield Finding(Role.UNKNOWN, "delay", words, names, None, worst, SHOWN_DELAY)


def _warnings(result: Calibration, unit: Unit) -> Iterator[Finding]:
    """List what to look at before the settings are trusted: faults, values lost, and channels beyond a bound."""
    found, names = result.estimate, result.names
    if result.faults:
        spans = [f"{' or '.join(names[i] for i in who)} from {a:.1f} s to {b:.1f} s" for who, a, b in result.faults]
        words = f"the monitor declares channels in this very recording: {first_of(spans, 3, '; ')}"
        struck = sorted({i for span in result.faults for i in span.channels})
        yield Finding(Role.WARNING, "declared", words, [names[i] for i in struck], headline="USABLE, BUT LOOK")
    lost = [
        f"{int(count.sum())} {'frozen' if why == 'repeated' else why.replace('_', ' ')}"
        f" ({'every channel' if count.all() else ', '.join(names[i] for i in np.flatnonzero(count))})"
        for why, count in result.unusable.items()
        if count.max() > (MANY * found.blocks.count.sum() if why in ("missing", "spikes") else 0)
    ]
    if lost:
        yield Finding(Role.WARNING, "values not used", f"values not used: {'; '.join(lost)}")
    moving = np.median(found.moment, axis=0)
    for when, noise, headline in (("in motion", moving, "USABLE, BUT LOOK"), ("at rest", found.floor.std, "")):
        if noisy := much_noisier(noise, result.units):
            words = noisier_words(names, noise, result.units, unit.name, unit.factor)
            words += f" {when}: loose, badly isolated, of another make, or faulty"
            worst, beside = max(noisy, key=lambda one: noise[one[0]])
            who = [names[i] for i, _ in noisy]
            yield Finding(Role.WARNING, "noise", words, who, float(noise[worst]), None, beside, headline)
    rate, swing = f"{{:.3g}} {unit.name}", np.ptp(found.curve, axis=0)
    for what, values, bound, form, factor in (
        ("axes turned from their nominal ones", result.angle, LARGE_ANGLE, "{:.1f} deg", np.degrees(1.0)),
        ("scale factors off their nominal ones", result.factor - 1.0, LARGE_SCALE, "{:+.1%}", 1.0),
        ("biases moved within the recording", swing, LARGE_SWING, rate, unit.factor),
        ("large biases", found.bias, LARGE_BIAS, rate, unit.factor),
    ):
        if len(beyond := np.flatnonzero(np.abs(values) > bound)):
            words = f"{what}: {', '.join(f'{names[i]} by {form.format(values[i] * factor)}' for i in beyond)}"
            largest = float(values[np.abs(values).argmax()])
            yield Finding(Role.WARNING, what, words, [names[i] for i in beyond], largest, None, bound)
