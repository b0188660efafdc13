# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A snapshot of the monitor after its last sample: channels, units, and what the channels left can still do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.config.unit_names import short_names
from fdi_ros.core.bias import (
    FIXED,
    IN_MOTION,
    LEARNED,
    LEARNING,
    LEAST_ROWS,
    RESTORED,
    TOO_FEW,
)
from fdi_ros.core.records import Condition
from fdi_ros.core.states import REASONS, ChannelState, Reason
from fdi_ros.core.subsets import flags_of, is_in, mask_of, members
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import GeometryError
from fdi_ros.estimator.error_states import ERROR_KINDS, places_of
from fdi_ros.model.geometry import MIN_CHANNELS, Geometry, lone_pairs, one_of_words
from fdi_ros.model.noise import assumption_words
from fdi_ros.model.quantity import FORCE, RATE, Quantity
from fdi_ros.model.samples import Array, Mask
from fdi_ros.monitor.integrity import NO_LEVEL, Axes, Integrity
from fdi_ros.system.text import listed, plus_minus

CERTAIN_SIGMAS = 4.0
"""Standard deviations from which a measured delay, difference or trend is certain: by chance 1 in 16 000."""
LOST_STATES = (ChannelState.FAULTY, ChannelState.STALE, ChannelState.EXCLUDED)
SCALE_PARTS = ("scale x", "scale y", "scale z")  # kinds of `ErrorStatus`
LEAST_SEEN = 0.6
"""Smallest share of its scale error that the mean with the others leaves to a channel that is
compared with others: it is 2/3 with three parallel channels, and 1/2 with two."""


class ErrorLimits(NamedTuple):
    """Which estimated errors are unusual."""

    #: scale error against the others, a share. In 20 recordings of healthy vehicles
    #: it is 0.013 at most; data sheets of consumer IMUs allow 0.03
    scale: float = 0.04
    #: standard deviations by which a scale error is beyond that
    beyond: float = 2.0
    #: expected standard deviations from which an estimated error is unusual
    sigmas: float = 3.0
    #: start bias, a multiple of ``bias.turn_on_std``: one healthy start in 16 000
    #: has more
    start_bias: float = 4.0


UNUSUAL_ERRORS = ErrorLimits()


@dataclass(frozen=True)
class NoisySpell:
    """A time in which a channel was much noisier than before, and than the other units."""

    since: int  #: Stamp of its first sample, ns.
    until: int  #: Stamp of its last sample so far, ns.
    samples: int  #: Number of noisy samples.
    #: Their mean noise over the expected or usual one, whichever is smaller.
    times: float

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return (self.until - self.since) / 1e9


NEVER_NOISY = NoisySpell(0, 0, 0, 0.0)


@dataclass(frozen=True)
class ChannelStatus:
    """Present state of one channel."""

    #: Such as ``imu_1.x``.
    name: str
    #: At the last sample.
    state: ChannelState
    #: Why the channel has that state.
    reason: Reason
    since: int  #: Stamp of the sample that brought the state, ns, 0 before the first sample.
    group: tuple[str, ...]  #: AMBIGUOUS: names of the set one of which is faulty.
    error: float  #: Estimated error when declared or suspected, in ``unit``.
    residual: float  #: Of the last sample, in ``unit``, NaN where missing.
    last_received: int  #: Stamp of the last sample with a value, ns, 0 if none.
    counts: Mapping[str, int]
    """``samples``, with ``missing``, ``non-finite``, ``out of range``, ``stuck`` and ``noisy`` (much noisier than
    expected, and than the other units) among them, and ``spikes``: how
    often a few values were far off and left out of the rate."""
    #: Share of the recent samples in which the channel gave a finite value.
    delivers: float = 1.0
    drift: float = 0.0  #: How far its bias has been followed in flight from that at the start, in ``unit``.
    #: Bias learned at the start, beyond ``bias.fixed``, in ``unit``. Where no start at rest shows it
    #: alone, only one that is far beyond ``turn_on_std``.
    start_bias: float = 0.0
    #: Standard deviation of the bias without the part common to all channels, in
    #: ``unit``, NaN: not estimated.
    bias_std: float = math.nan
    noise: float = 0.0  #: Recent noise in noise_std, 0 if not measured.
    noisy: bool = False  #: Whether that is much, and more than the others show.
    last_noisy: NoisySpell = NEVER_NOISY  #: Present or last spell of noise.
    longest_noisy: NoisySpell = NEVER_NOISY  #: Longest spell of noise so far.
    unit: str = RATE.unit  #: rad/s of a gyro, m/s^2 of an accelerometer.
    axis: tuple[float, ...] = (0.0, 0.0, 0.0)  #: Sensitivity axis in the body.
    #: Finite values in whose samples the other channels could have shown its fault.
    checked: int = 0

    @property
    def finite(self) -> int:
        """Number of its finite values."""
        return self.counts["samples"] - self.counts["non-finite"]

    @property
    def is_left_out(self) -> bool:
        """Whether its values count for nothing."""
        return self.state in LOST_STATES or self.reason is Reason.COPY


@dataclass(frozen=True)
class UnitStatus:
    """One unit as a whole: the channels that share their stamps."""

    #: Such as ``imu_1``.
    name: str
    #: Names of its channels.
    channels: tuple[str, ...]
    #: Lateness of its stamps against another unit, s. Negative if early, NaN if not
    #: measured.
    delay: float
    #: Standard deviation of the delay, s.
    delay_std: float
    #: The other unit: with two units the first, with more the middle one, which names
    #: itself.
    against: str
    #: Whether the certain part of the delay is corrected.
    taken_off: bool = False
    frozen: float = 0.0
    """Time for which all its values have repeated while the others measure motion, s, 0 if shorter than
    ``health.stuck_time``."""


@dataclass(frozen=True)
class ApartStatus:
    """Two channels that alone measure one axis and surely differ.

    One is faulty, and no evidence tells which.
    """

    #: Names of the two.
    channels: tuple[str, str]
    #: The two in words.
    who: str
    #: By how much they differ, in ``unit``.
    size: float
    #: Standard deviation of the difference, in ``unit``, NaN if unknown.
    std: float
    #: rad/s of gyros, m/s^2 of accelerometers.
    unit: str = RATE.unit

    def __str__(self) -> str:
        return f"{self.who.removesuffix(',')}, {plus_minus(self.size, self.std)} {self.unit} apart"


@dataclass(frozen=True)
class ErrorStatus:
    """What is known of one error of a channel or a unit."""

    #: Name of the channel, or of the unit.
    owner: str
    #: Name in `fdi_ros.estimator.error_states.ERROR_KINDS`, with x, y or z if the error
    #: has three components.
    kind: str
    #: Of value, std and prior. Empty: dimensionless.
    unit: str
    #: Estimated error.
    value: float
    #: Standard deviation of the estimate.
    std: float
    #: Standard deviation by now if nothing had been measured: at the start, and its
    #: walk since.
    prior: float

    @property
    def is_unusual(self) -> bool:
        """Whether the error is certainly larger than expected."""
        return (
            abs(self.value) > UNUSUAL_ERRORS.sigmas * self.prior
            and abs(self.value) - UNUSUAL_ERRORS.sigmas * self.prior > 2.0 * self.std
        )

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        size = f"{self.kind} {self.value:.2g} +- {self.std:.1g}{unit}"
        if self.prior == 0.0:
            # Not estimated: the settings say that there is no such error.
            return size
        return f"{size}, {abs(self.value) / self.prior:.1f} times its prior"


@dataclass(frozen=True)
class ScaleError:
    """How much more a channel reads than others."""

    #: Against the mean of all channels along its axis, itself included, as a share. 0: none is certain.
    size: float = 0.0
    #: Share of the error against the others that is in ``size``.
    seen: float = 1.0


@dataclass(frozen=True)
class Status:
    """State of the whole monitor after the last sample."""

    #: Settings of the monitor.
    config: Config = field(repr=False)
    stamp: int  #: Of the last sample, ns, 0 before the first.
    #: Number of samples so far.
    samples: int
    #: ``detector.name``.
    detector: str
    channels: tuple[ChannelStatus, ...]  #: Gyros, then accelerometers.
    #: Of the last sample. An alarm is a statistic at the threshold or above.
    statistic: float
    #: Of the statistic.
    threshold: float
    has_rate: bool  #: Whether the last sample gave a fused rate.
    withheld: bool  #: Whether a rate was withheld because of old values or doubted channels (``publish_under_doubt``).
    all_repeat: bool  #: Whether all channels repeat their values.
    can_detect: tuple[str, ...]  #: Channels whose fault would be detected.
    can_isolate: tuple[str, ...]  #: Channels whose fault would be detected and named.
    bias: tuple[
        float, ...
    ]  #: Subtracted from each channel, in its unit: the bias of the start, and its drift in flight.
    bias_state: str  #: Words: fixed, learned, learning, refused and why, followed from a start in motion.
    note: str  #: Why checking is limited, in words, empty without limits.
    protection_level: tuple[float, float, float] = (math.inf,) * 3
    """Of the fused rate in the last sample, for each body axis, rad/s, inf where none holds."""
    protection_level_after_loss: tuple[float, float, float] = (math.inf,) * 3
    """Protection level after the loss of the worst further channel on each axis, rad/s."""
    units: tuple[UnitStatus, ...] = ()  #: Units of several channels, in their order.
    delays: tuple[
        float, ...
    ] = ()  #: Lateness of each unit against the first, s, empty if not measured.
    delay_std: tuple[float, ...] = ()  #: Standard deviation of each, s.
    errors: tuple[
        ErrorStatus, ...
    ] = ()  #: Of the sensors, in the order of ``ERROR_KINDS``.
    names_rest_on: str = ""  #: Assumption that no data can test and every name rests on, empty for one fault at a time.
    copies: tuple[tuple[str, str], ...] = ()
    """Pairs of units that give the same values, by name and topic: one sensor, and no evidence for each other."""
    apart: ApartStatus | None = (
        None  #: Where a set is declared: the pair of its channels that surely differs.
    )
    acceleration: Status | None = None
    """The same of the accelerometers alone, in m/s^2 where it is rad/s here; None: there are none."""

    def joined(self, acceleration: Status) -> Status:
        """Return the status of the gyros, this one, with that of the accelerometers of the same units."""
        other = {unit.name: unit for unit in acceleration.units}
        units = (
            replace(
                unit,
                channels=unit.channels + other[unit.name].channels,
                frozen=max(unit.frozen, other[unit.name].frozen),
            )
            if unit.name in other
            else unit
            for unit in self.units
        )
        notes = dict.fromkeys(filter(None, (self.note, acceleration.note)))
        return replace(
            self,
            channels=self.channels + acceleration.channels,
            can_detect=self.can_detect + acceleration.can_detect,
            can_isolate=self.can_isolate + acceleration.can_isolate,
            bias=self.bias + acceleration.bias,
            note="; ".join(notes),
            units=tuple(units),
            errors=self.errors + acceleration.errors,
            copies=tuple(dict.fromkeys(self.copies + acceleration.copies)),
            apart=self.apart or acceleration.apart,
            acceleration=acceleration,
        )

    def drift_since_rest(self, channel: ChannelStatus) -> float:
        """Return how far a bias moved since it was learned at rest, or 0 if it was not."""
        return channel.drift if self.bias_state.startswith("learned") else 0.0

    def certain_scale_errors(
        self, followed: Mapping[str, tuple[float, float]] | None = None
    ) -> dict[str, ScaleError]:
        """Return how much more each channel reads than the mean along its axis, by name.

        It is 0 unless the error against the others exceeds `UNUSUAL_ERRORS.scale` by
        `UNUSUAL_ERRORS.beyond` standard deviations.

        Parameters
        ----------
        followed
            Certain shares of the rate or force in the residuals of channels, beyond what the
            estimator corrects, and their standard errors. None: not measured.
        """
        followed = followed or {}
        own: dict[str, list[tuple[float, float]]] = {}
        for error in self.errors:
            if error.kind in SCALE_PARTS:
                own.setdefault(error.owner, []).append((error.value, error.std))
        found = {one.name: ScaleError() for one in self.channels}
        known = [one for one in self.channels if one.name in own]
        for unit in dict.fromkeys(one.unit for one in known):
            half = [one for one in known if one.unit == unit]
            axes = np.array([one.axis for one in half])
            parts = np.array([own[one.name] for one in half])
            value = (axes * parts[:, :, 0]).sum(axis=1)
            std = np.linalg.norm(axes * parts[:, :, 1], axis=1)
            used = np.array([not one.is_left_out for one in half])
            fit = (
                axes[used] @ np.linalg.pinv(axes[used])
                if used.any()
                else np.zeros((0, 0))
            )
            left = np.eye(len(fit)) - fit
            if followed and np.diag(left).min(initial=1.0) > 0.0:
                more = np.array([followed.get(one.name, (0.0, 0.0)) for one in half])
                value[used] = left @ (value + more[:, 0])[used]
                std = np.where(more[:, 0] != 0.0, more[:, 1], std)
            seen = np.ones(len(half))
            seen[used] = np.diag(left)
            # Of two, each may have the whole difference or none of it.
            seen[seen < LEAST_SEEN] = 1.0
            least = UNUSUAL_ERRORS.scale + UNUSUAL_ERRORS.beyond * std
            certain = np.abs(value) / seen > least
            for i in np.flatnonzero(certain).tolist():
                found[half[i].name] = ScaleError(float(value[i]), float(seen[i]))
        return found

    def turn_on_std(self, channel: ChannelStatus) -> float:
        """Return the standard deviation of a bias from one start to the next, in the channel's unit."""
        is_force = channel.unit == FORCE.unit
        settings = self.config.accelerometers if is_force else self.config.bias
        return settings.turn_on_std

    def has_implausible_start_bias(self, channel: ChannelStatus) -> bool:
        """Whether a channel is used that began with a bias no healthy sensor is expected to have."""
        limit = UNUSUAL_ERRORS.start_bias * self.turn_on_std(channel)
        return not channel.is_left_out and abs(channel.start_bias) > limit > 0.0


def status_of(
    core: Any,
    subsets: NDArray[Any],
    guard: Detector,
    detector: Detector,
    integrity: Integrity,
    config: Config,
    quantity: Quantity = RATE,
) -> Status:
    """Snapshot of one half of a monitor after its last sample.

    ``subsets`` (2^n,): capability of every set of channels. ``guard``: detector that keeps the estimator. ``detector``:
    the one that declares. ``quantity``: what the channels measure.
    """
    natural = quantity.natural
    geometry = detector.geometry
    names = geometry.channel_names
    n = geometry.n
    now = core["now"]
    last = core["last"]
    begun = bool(core["samples"])
    state = core["state"][:n]
    repeated = flags_of(int(core["copies"]["channels"]), n)
    checked = state != ChannelState.UNCHECKED
    detectable, isolable, note, rests_on = _capability(
        detector, ~(np.isin(state, LOST_STATES) | repeated), checked
    )
    seen = detectable & checked
    well = mask_of(
        np.flatnonzero((state == ChannelState.OK) | (state == ChannelState.UNCHECKED))
    )
    valid = begun and bool(last["valid"])
    level = after_loss = NO_LEVEL
    if valid:
        level = _scaled(last["level"].tolist(), natural)
        lossy = integrity.after_loss(subsets, int(now["fused"]) & well)
        after_loss = _scaled(lossy, natural)
    late, late_std = _delays(guard, begun)
    bias = (core["bias"]["value"] + core["sample"]["estimate"]["bias"])[:n]
    return Status(
        config=config,
        stamp=int(last["stamp"]) if begun else 0,
        samples=int(core["samples"]),
        detector=detector.name,
        channels=tuple(_channel(core, i, geometry, quantity) for i in range(n)),
        statistic=float(last["statistic"]) if begun else math.nan,
        threshold=float(last["threshold"]) if begun else math.nan,
        has_rate=valid,
        withheld=begun and bool(now["withheld"]) and not now["learned_from"],
        all_repeat=begun and bool(now["all_repeat"]),
        can_detect=_named(names, seen),
        can_isolate=_named(names, isolable & seen),
        bias=tuple((natural * bias).tolist()),
        bias_state=_format_bias(core["bias"], names, config.bias.turn_on_std),
        note=note,
        protection_level=level,
        protection_level_after_loss=after_loss,
        units=_units(core, guard, late, late_std),
        delays=tuple(late[:, 0].tolist()),
        delay_std=tuple(late_std[:, 0].tolist()),
        errors=_errors(guard, begun, quantity),
        names_rest_on=rests_on,
        copies=_copies(core, geometry, config),
        apart=_apart(guard, core, quantity),
    )


def _scaled(axes: Sequence[float], natural: float) -> Axes:
    """Multiply three values of the axes of the body."""
    x, y, z = axes
    return natural * x, natural * y, natural * z


def _channel(
    core: Any, i: int, geometry: Geometry, quantity: Quantity
) -> ChannelStatus:
    names = geometry.channel_names
    natural = quantity.natural
    health = core["health"]
    state = ChannelState(core["state"][i])
    count = health["counts"][:, i]
    begun = bool(core["samples"])
    return ChannelStatus(
        name=names[i],
        state=state,
        reason=REASONS[core["reason"][i]],
        since=int(core["since"][i]),
        group=tuple(names[k] for k in members(int(core["group"])))
        if state == ChannelState.AMBIGUOUS
        else (),
        error=natural * float(core["error"][i]),
        residual=natural * float(core["last"]["residual"][i]) if begun else math.nan,
        last_received=int(health["received_stamp"][i]) if health["samples"][i] else 0,
        counts={
            "samples": int(health["samples"][i]),
            "missing": int(count[Condition.MISSING] + count[Condition.SILENT]),
            "non-finite": int(
                count[Condition.NON_FINITE] + count[Condition.NON_FINITE_LASTING]
            ),
            "out of range": int(count[Condition.OUT_OF_RANGE]),
            "stuck": int(health["stuck"][i] + count[Condition.FROZEN]),
            "noisy": int(health["noisy"][i]),
            "spikes": int(core["sample"]["estimate"]["spikes"][i]),
        },
        delivers=(1.0 - float(health["gone"][i])) * (1.0 - float(health["absent"][i])),
        drift=natural * float(core["sample"]["estimate"]["bias"][i]),
        start_bias=natural
        * float(
            core["bias"]["value"][i]
            - core["bias"]["centre"][i]
            + core["sample"]["estimate"]["far_bias"][i]
        ),
        bias_std=natural * float(core["remaining"][i]),
        noise=float(core["now"]["verdict"]["noise"][i]),
        noisy=is_in(i, int(core["now"]["noisy"])),
        last_noisy=_spell(health["last_noisy"], i),
        longest_noisy=_spell(health["longest_noisy"], i),
        unit=quantity.unit,
        axis=tuple(geometry.axes[i].tolist()),
        checked=int(health["checked"][i]),
    )


def _spell(spell: Any, i: int) -> NoisySpell:
    fields = [spell[name][i].item() for name in spell.dtype.names]
    return NoisySpell(*fields)


def _named(names: Sequence[str], marked: Mask) -> tuple[str, ...]:
    return tuple(names[i] for i in np.flatnonzero(marked).tolist())


def _capability(
    detector: Detector, mask: Mask, checked: Mask
) -> tuple[Mask, Mask, str, str]:
    """Return whether a fault of each channel would be detected, and isolated, (n,).

    Also limits and assumptions in words. mask: the channels in use, (n,). checked: those that
    the others check now, (n,): of the rest nothing is said to be seen.
    """
    detectable, isolable = np.zeros((2, len(mask)), dtype=bool)
    try:
        reduced = detector.geometry.subset(mask)
    except GeometryError:
        return detectable, isolable, _too_little(int(mask.sum())), ""
    bits = mask_of(np.flatnonzero(mask))
    method = detector.fewer(bits)
    if method is None:
        return detectable, isolable, detector.refusals[bits], ""
    detectable[mask] = reduced.detectable
    isolable[mask] = method.isolable
    limits = (
        (mask & ~detectable, "not be seen"),
        (detectable & ~isolable & checked, "be seen, but not isolated"),
    )
    names = detector.geometry.channel_names
    notes = [
        f"a fault of {listed(short_names(_named(names, marked)), 'or')} would {words}"
        for marked, words in limits
        if marked.any()
    ]
    return detectable, isolable, "; ".join(notes), assumption_words(reduced)


def _too_little(left: int) -> str:
    """Return why this number of channels checks nothing."""
    if left >= MIN_CHANNELS:
        return (
            f"the axes of the {left} channels left do not span three dimensions: a fault of one"
            " would not be detected"
        )
    if left == 0:
        return f"no channel is left: {MIN_CHANNELS} are needed to see a fault"
    plural = "s are" if left > 1 else " is"
    return f"only {left} channel{plural} left: a fault of one would not be detected, {MIN_CHANNELS} are needed"


def _unit_names(geometry: Geometry) -> list[str]:
    return [geometry.unit_of[channels[0]] for channels in geometry.units]


def _delays(guard: Detector, begun: bool) -> tuple[Array, Array]:
    """Lateness of each unit against each other one, and its standard deviation, (units, units) s.

    Unknown ones are (0, 1).
    """
    units = len(guard.geometry.units)
    if units < 2 or not begun:
        return np.zeros((0, 1)), np.zeros((0, 1))
    estimator = guard.states[0]["estimator"]
    places = [place for (place,) in places_of("delay", guard.geometry.n, units)]
    value = estimator["late"][:units].copy()
    covariance = np.zeros((units, units))
    value[1:] += estimator["states"]["x"][places]
    of_delays = np.ix_(places, places)
    covariance[1:, 1:] = estimator["states"]["p"][of_delays]
    covariance += np.diag(estimator["taught_delay"][:units] ** 2)
    variance = (
        np.add.outer(np.diag(covariance), np.diag(covariance))
        - covariance
        - covariance.T
    )
    return np.subtract.outer(value, value), np.sqrt(np.maximum(variance, 0.0))


def _units(
    core: Any, guard: Detector, late: Array, late_std: Array
) -> tuple[UnitStatus, ...]:
    """Units of several channels. With three or more, lateness counts against the middle one."""
    geometry = guard.geometry
    measured = len(late) > 0
    names = _unit_names(geometry)
    middle = 0
    if len(late) > 2:
        in_order = np.argsort(late[:, 0])
        middle = int(in_order[(len(late) - 1) // 2])
    off = guard.states[0]["estimator"]["late"] if measured else np.zeros(len(names))
    return tuple(
        UnitStatus(
            names[u],
            tuple(geometry.channel_names[i] for i in channels),
            delay=float(late[u, middle]) if measured else math.nan,
            delay_std=float(late_std[u, middle]) if measured else math.nan,
            against=names[middle] if measured else "",
            taken_off=bool(off[u] != off[middle]),
            frozen=_frozen(core, channels),
        )
        for u, channels in enumerate(geometry.units)
    )


def _frozen(core: Any, channels: Sequence[int]) -> float:
    """Time for which a unit has certainly given old values, s, 0 if none."""
    unit = mask_of(channels)
    now = core["now"]
    changed = core["health"]["run_stamp"][list(channels)].max()
    seconds = float(core["last"]["stamp"] - changed) / 1e9
    is_old = int(now["repeated"]) & unit == unit and not now["all_repeat"]
    return (
        seconds
        if is_old and seconds >= core["settings"]["stuck_time"] / 1e9 > 0
        else 0.0
    )


def _errors(
    guard: Detector, begun: bool, quantity: Quantity
) -> tuple[ErrorStatus, ...]:
    if not begun:
        return ()
    estimator = guard.states[0]["estimator"]
    layout = guard.constants[0]["layout"]
    names = guard.geometry
    states = estimator["states"]
    units = _unit_names(names)
    found = []
    prior = np.sqrt(
        layout["prior"] ** 2 + layout["walk"] ** 2 * float(estimator["seconds"])
    )
    for kind in ERROR_KINDS:
        is_scaled = kind.unit.startswith(RATE.unit)
        factor = quantity.natural if is_scaled else 1.0
        unit = quantity.unit if kind.unit == RATE.unit else kind.unit
        if is_scaled and kind.unit != RATE.unit:
            unit = f"{quantity.unit}/s"
        owners = units[1:] if kind.per_unit else names.channel_names
        for owner, places in zip(
            owners, places_of(kind.name, names.n, len(units)), strict=True
        ):
            parts = {1: [""], 3: [" x", " y", " z"]}.get(len(places)) or [
                f" {k + 1}" for k in range(len(places))
            ]
            for place, part in zip(places, parts, strict=True):
                value = float(states["x"][place])
                std = float(np.sqrt(states["p"][place, place]))
                found.append(
                    ErrorStatus(
                        owner,
                        kind.name + part,
                        unit,
                        factor * value,
                        factor * std,
                        factor * float(prior[place]),
                    )
                )
    return tuple(found)


def _apart(guard: Detector, core: Any, quantity: Quantity) -> ApartStatus | None:
    """Find the pair of one axis, in the set that is declared, that differs by most of its standard deviations."""
    geometry = guard.geometry
    group = set(members(int(core["group"])))
    case = guard.states[0]["case"]
    found = None
    largest = 0.0
    for a, b in lone_pairs(geometry) if group else ():
        if not group.issuperset((a, b)):
            continue
        size = abs(float(core["error"][b]))
        std = math.nan
        if case["open"]:
            # The detector explains the mean since the onset, with all its uncertainty.
            axes = geometry.axes
            mean = case["inference"]["y"]
            covariance = case["inference"]["covariance"]
            share = float(axes[a] @ axes[b]) / float(axes[b] @ axes[b])
            size = abs(float(mean[a] - share * mean[b]))
            std = math.sqrt(
                max(
                    covariance[a, a]
                    + share**2 * covariance[b, b]
                    - 2 * share * covariance[a, b],
                    0.0,
                )
            )
        elif len(group) > 2:
            continue
        certainty = size / std if std > 0.0 else math.inf
        if certainty > largest and (len(group) == 2 or certainty >= CERTAIN_SIGMAS):
            names = geometry.channel_names[a], geometry.channel_names[b]
            found = ApartStatus(
                names,
                one_of_words(geometry, (a, b)),
                quantity.natural * size,
                quantity.natural * std,
                quantity.unit,
            )
            largest = certainty
    return found


def _copies(
    core: Any, geometry: Geometry, config: Config
) -> tuple[tuple[str, str], ...]:
    names = _unit_names(geometry)
    if config.has_units:
        names = [
            f"{name} ({topic})"
            for name, topic in zip(names, config.topics, strict=True)
        ]
    original = core["copies"]["original"][: len(names)].tolist()
    return tuple(
        (names[first - 1], names[unit]) for unit, first in enumerate(original) if first
    )


def _format_bias(bias: Any, names: Sequence[str], turn_on_std: float) -> str:
    """Say where the biases come from, or why a time was refused as rest."""
    outcome = int(bias["outcome"])
    if outcome in (LEARNED, RESTORED):
        missed = [
            name
            for i, name in enumerate(names)
            if not is_in(i, int(bias["channels_known"]))
        ]
        words = "learned" if outcome == LEARNED else "restored from the state file"
        return f"{words}, but not of {', '.join(missed)}" if missed else words
    known = {
        FIXED: "fixed" if bias["given"] else "zero",
        LEARNING: "learning",
        IN_MOTION: "not at rest at the start: biases as given, what the channels see of each other is followed; the"
        f" common bias is unknown to {turn_on_std:g} rad/s",
    }
    return known.get(outcome) or f"refused{_format_refusal(bias, names)}"


def _format_refusal(bias: Any, names: Sequence[str]) -> str:
    heard = int(bias["heard"]).bit_count()
    restless = list(members(int(bias["restless"])))
    if bias["outcome"] == TOO_FEW:
        return f": {heard} channels gave {bias['rows']} samples, expected 3 and {LEAST_ROWS} at least"
    mean = bias["average"]
    std = bias["scatter"]
    max_mean = bias["max_rate"]
    max_std = bias["max_std"]
    if len(restless) > 1:
        worst = max(
            restless, key=lambda i: abs(mean[i]) / max_mean + std[i] / max_std[i]
        )
        return (
            f", not at rest: {names[worst]} had mean {mean[worst]:.3g} rad/s (at most {max_mean:g})"
            f" and standard deviation {std[worst]:.3g} rad/s (at most {max_std[worst]:.3g})"
        )
    if bias["common_rate"] > bias["max_common_rate"]:
        return (
            f", not at rest: the channels agree on a turn of {bias['common_rate']:.3g} rad/s (at most"
            f" {bias['max_common_rate']:.3g} with biases that differ as little); if it was at rest, give bias.fixed"
        )
    if bias["sway"] > bias["max_sway"]:
        motion = f"{bias['sway']:.3g} rad/s (at most {bias['max_sway']:.3g})"
        return f", not at rest: a motion that the channels agree on, {motion}"
    return f": {heard} channels gave values, one of them was not at rest, expected 3 at rest at least"
