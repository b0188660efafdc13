# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Health of channels and units without a declared fault: what forbids to call them healthy.

Replay, set-up, fleet, diagnostics and `fdi watch` all ask `concerns_of`. A recording describes
a whole flight, the live monitor its last seconds, by the same records.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fdi_ros.config.unit_names import short_names
from fdi_ros.core.states import ChannelState
from fdi_ros.model.noise import much_noisier
from fdi_ros.model.samples import Array
from fdi_ros.system.text import LINE, figures, listed, percent, shown

if TYPE_CHECKING:
    from fdi_ros.monitor.status import ChannelStatus, Status

DECLARED = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
"""States of a channel in a declared fault, named or in a set."""


class Reported(NamedTuple):
    """From where a finding about a flight is reported."""

    #: largest number of concerns in a verdict or in the line about the monitor
    concerns: int = 3
    #: share of its values that the others must have checked of a healthy channel
    checked: float = 0.5
    #: share of its messages that a healthy unit delivers
    delivered: float = 0.9
    #: time without a fused rate, s. Shorter outages are in the notes
    missing_s: float = 1.0
    #: share of the unchecked samples from which on repeated values are their cause
    cause: float = 0.4
    #: time at the end of a range from which on it is the cause of unchecked
    #: samples, s
    saturated_s: float = 1.0
    #: duration of noise, s
    noisy_s: float = 3.0
    #: noise that ended this short a time ago is taken to last, s
    lasting_s: float = 1.5
    #: move of the bias of a gyro, rad/s. It is 1.4 mrad/s at most in 12 recordings
    #: without a known fault, up to 20 mrad/s where sensors warm up in simulation,
    #: and 30 mrad/s before a real crash
    drift_rad_s: float = 0.02
    #: share of the largest scale error from which on a channel is named with it: of
    #: two channels that differ, both have half of the difference
    scale_share: float = 0.7
    #: number of spikes. Fewer may be chance
    spikes: int = 3


REPORTED = Reported()


class Whole(NamedTuple):
    """What a recording must have of its stream to be called whole."""

    #: share of the samples that must be judged for a verdict
    judged: float = 0.5
    #: intervals without a sample that are a hole: samples of slow recordings are
    #: seconds apart
    intervals: float = 10.0
    #: gap between two stretches, s. A shorter hole is within a stretch: messages
    #: were lost
    pause: float = 10.0
    #: share of its messages from which on a unit lacks no value because of lost
    #: messages
    messages: float = 0.97
    #: share of wrong stamps from which on to look: not a message that came twice
    stamps: float = 0.01
    #: share of the values of a channel that are repeated for long
    frozen: float = 0.1


WHOLE = Whole()


class NoisyDelay(NamedTuple):
    """A delay of a unit that explains its noise: what is left of it shows in motion."""

    #: smallest delay, s
    seconds: float = 0.01
    #: standard deviations from which on it is certain enough
    sigmas: float = 3.0


NOISY_DELAY = NoisyDelay()


class Visible(NamedTuple):
    """How much of the errors of a channel shows in its residual."""

    #: smallest residual that counts as measured, rad/s, as the smallest
    #: ``noise.noise_std``
    residual: float = 1e-9
    #: smallest share of the errors that is taken to show
    share: float = 1e-3
    #: smallest visible share, over the share with equal noise: a noise below a
    #: third of all parallel channels counts as a third
    of_equal: float = 0.25


VISIBLE = Visible()


STAYED_OUT = "remained left out"
"""First words on a channel that the operator has taken out up to the end."""


class Word(str, Enum):
    """First word of a verdict."""

    HEALTHY = "HEALTHY"
    """All channels delivered, were checked, and agreed."""
    LOOK = "LOOK"
    """No fault was declared, but something is not as it should be."""
    CANNOT_TELL = "CANNOT TELL"
    """No fault was declared, but too little was checked."""
    FAULTY = "FAULTY"
    """A fault was declared, or a unit fell silent for good."""


@dataclass(frozen=True, kw_only=True)
class ChannelHealth:
    """How one channel measured."""

    name: str
    """Name of the channel."""
    unit: str = ""
    """Name of its unit. Empty for a channel without a unit."""
    checked: float = 1.0
    """Share of its values, by `checked_share`."""
    delivered: float = 1.0
    """Share of the samples in which it gave a finite value."""
    spikes: int = 0
    """Number of its spikes: wrong values in a run of a few samples at most."""
    saturated_s: float = 0.0
    """Time at the end of its range, s."""
    own_noise_rad_s: float | None = None
    """Usual standard deviation of its own errors while it was OK, by `own_noise`, rad/s.
    None: never OK, or not measured."""
    noisy_s: float = 0.0
    """Duration of its longest spell of noise, s."""
    noisy_from_s: float = 0.0
    """Start of that spell, s. Negative: as long before now."""
    noisy_times: float = 0.0
    """Its mean noise in that spell, over its usual or expected noise, the smaller one."""
    measured_in: str = "rad/s"
    """Unit of its figures: rad/s of a gyro, m/s^2 of an accelerometer."""
    drift: float = 0.0
    """Move of its bias since it was learned at rest, in `measured_in`. 0: not learned."""
    scale: float = 0.0
    """Certain scale error against the mean of all channels along its axis, a share. 0: none is certain."""
    scale_seen: float = 1.0
    """Share of its scale error against the others that is in `scale`."""
    repeated: float = 0.0
    """Share of its values that repeated the value before for too long."""
    doubt: str = ""
    """Why it is not used at the end, as it continues the name: ``remained suspected``. Empty: used."""


@dataclass(frozen=True, kw_only=True)
class UnitHealth:
    """How one unit, which may be a single topic of channels, delivered."""

    name: str
    """Name of the unit."""
    topic: str
    """Topic that carries it."""
    delivered: float = 1.0
    """Share of its messages that arrived, by its usual rate and the rate of the other units."""
    rate_hz: float | None = None
    """Usual messages per second, Hz. None: not measured."""
    slow_from_s: float | None = None
    """Start of the longest time with fewer than 60 % of its messages, s. None: none."""
    slow_to_s: float | None = None
    """End of that time, s. None: no such time, or it lasts to the end."""
    slow_rate_hz: float | None = None
    """Messages per second during that time, Hz. Live: lately."""
    delay_s: float | None = None
    """Delay of its stamps against those of `delay_to`, s. Negative: early. None: not measured."""
    delay_std_s: float | None = None
    """Standard deviation of the delay, s."""
    delay_to: str = ""
    """Unit that the delay refers to, the one in the middle of three or more. Empty: not measured."""
    warning: str = ""
    """What its input warns of while it delivers. Empty: nothing, or a recording."""
    copy_of: str = ""
    """Unit of which it repeats the values. Empty: none."""
    origin: str = ""
    """Message of the flight log, and the id of the device. Empty: no flight log."""
    temperature_c: tuple[float, float] | None = None
    """Lowest and highest temperature, degrees Celsius. None: not logged."""


@dataclass(frozen=True)
class RateHealth:
    """How the fused rate was published, from its first sample on."""

    missing_s: float = 0.0
    """Time without a fused rate, s."""
    missing_from_s: float | None = None
    """Start of the first time without it, s. None: not known, or no such time."""
    share: float = 1.0
    """Share of the samples with a fused rate."""
    frozen: tuple[str, ...] = ()
    """All units, if each repeated one value when the rate was missing first. Empty: another cause."""


class Trouble(Enum):
    """Kind of a concern. The value is what to do about it, with ``{who}`` for the units."""

    UNCHECKED = (
        "judge only the part in flight (--start, --end), or record again, with rest at the start and"
        " less vibration"
    )
    UNCHECKED_REPEATS = (
        "judge only the part before the values repeat (--end), or check the driver if the vehicle moved"
        " meanwhile; at rest, coarse values repeat by themselves"
    )
    SHORT = "record for longer, with some seconds of rest at the start"
    LEFT_OUT = "to judge {who} too, mend the cause"
    TOO_MANY = "to judge {who} too, list the units to judge in a config (--config)"
    STEPS_BACK = "judge {who} as a file of its own, and let the logger begin a new file after a restart"
    DELIVERY = "check connection, driver and bus load of {who}"
    STAMPS = (
        "check the driver of {who}: every message needs the time of its measurement"
    )
    DAMAGE = (
        "copy the recording again from where it was made: the notes say what is damaged"
    )
    HOLE = "check what made the recording: its load, its disk and the connection to it"
    DELAY = (
        "measure the delay of {who} with fdi setup, or let its driver stamp each sample when it is"
        " measured; only then check it for a loose mounting"
    )
    CLOCK = (
        "judge the parts before and after apart (--start, --end), and set clocks only before a"
        " recording"
    )
    INPUT = "check what publishes the messages of {who}"
    COPY = "give {who} a sensor of its own: check wiring and driver"
    DOUBT = "make a longer recording: the suspicion of {who} is still open"
    EXCLUDED = "shorten excluded_channels to use all channels of {who}"
    DRIFT = "let {who} warm up before the flight; replace it if its bias moves again"
    SCALE = "check the range that the driver of {who} sets, and measure the scale factors (fdi setup)"
    END_OF_RANGE = "choose a larger range for {who}"
    NO_RATE = "see in the report (--report) what the channels did meanwhile"
    SPIKES = "check wiring and power supply of {who}"
    NOISE = "check {who} for a loose mounting"
    REPEATS = (
        "check the driver of {who} if the vehicle moved meanwhile; at rest, coarse values repeat by"
        " themselves"
    )

    def advice(self, who: Iterable[str]) -> str:
        """Return what to do. ``who``: channels, units or topics, none if the advice names none."""
        # A name with a space is of a part of a file, and ends with the name of the file.
        units = dict.fromkeys(
            name if " " in name else name.rpartition(".")[0] or name for name in who
        )
        names = [shown(name, LINE) for name in units]
        return self.value.format(who=listed(names) if names else "")


def trouble_of_unused(why: str) -> Trouble:
    """Return the kind of a concern about something that is left out for a reason in words."""
    for words, trouble in _TROUBLE_OF_UNUSED.items():
        if words in why:
            return trouble
    return Trouble.LEFT_OUT


_TROUBLE_OF_UNUSED = {
    "a config has at most": Trouble.TOO_MANY,
    "the time steps back": Trouble.STEPS_BACK,
}
"""Kind of a concern by words of the reason. Other reasons lie in the messages themselves."""


class Concern(NamedTuple):
    """One reason not to call channels healthy."""

    word: Word
    """The verdict it leads to: LOOK or CANNOT TELL."""
    trouble: Trouble
    """Its kind."""
    who: tuple[str, ...]
    """Channels, units or topics, or the fused rate."""
    words: str
    """What is wrong, as it continues the names: ``has 24 spikes``."""
    joined_by: str = "and"
    """``or``: about one of the names, and which one is not known."""
    cause: tuple[str, ...] = ()
    """Channels that cause it, for the advice. Empty: those of the concern."""

    def __str__(self) -> str:
        return f"{listed(short_names(self.who), self.joined_by)} {self.words}"

    @property
    def sentence(self) -> str:
        """The concern as a sentence. Names of channels keep their small letters."""
        words = f"{self}."
        return f"T{words[1:]}" if words.startswith("the ") else words

    @property
    def advice(self) -> str:
        """What to do about it."""
        return self.trouble.advice(self.cause or self.who)


def checked_share(checked: int, finite: int) -> float:
    """Return the share of the values of a channel whose fault the others could have shown.

    Samples without a value of the channel do not count. A unit that delivers less than a third
    of the samples is UNCHECKED or STALE in between, and then 0 of its values were checked.
    """
    return checked / finite if finite else 0.0


def advice_on(concerns: Iterable[Concern]) -> str:
    """Return what to do about some concerns, each kind of trouble once."""
    by_trouble: dict[Trouble, list[str]] = {}
    for one in concerns:
        by_trouble.setdefault(one.trouble, []).extend(one.cause or one.who)
    return "; ".join(trouble.advice(who) for trouble, who in by_trouble.items())


def own_noise(residual: Array, axes: Array) -> Array:
    """Return the standard deviation of the errors of each channel, (n,), rad/s.

    The result is consistent with a rate that weights each channel by its inverse variance.
    It does not depend on the weights of the given rate. Of two parallel channels only the
    difference is known, so they get the same noise.

    Parameters
    ----------
    residual
        Differences from any one rate, (k, n), rad/s. NaN: not usable. A channel that is
        usable in less than half of the samples is ignored.
    axes
        Sensitivity axes, (n, 3).
    """
    usable = np.isfinite(residual)
    known = usable.mean(axis=0) >= 0.5
    rows = residual[usable[:, known].all(axis=1)][:, known]
    noise: Array = np.full(len(axes), np.nan)
    if len(rows) < 2 or not known.any():
        return noise
    covariance = np.atleast_2d(np.cov(rows, rowvar=False))
    own = axes[known]
    variance = np.ones(len(own))
    left = _left_by_fit(own, variance)
    share = np.maximum(np.diag(left), VISIBLE.share)
    least = VISIBLE.of_equal * share
    # It converges by more than a factor of two in each pass.
    for _ in range(20):
        square = np.einsum("ij,jk,ik->i", left, covariance, left)
        variance = np.maximum(np.sqrt(variance * square / share), VISIBLE.residual**2)
        left = _left_by_fit(own, variance)
        share = np.maximum(np.diag(left), VISIBLE.share)
        # Where others err alike, one channel would take all the weight and seem free of noise.
        factor = least / (1.0 - least) * (1.0 - share) / share
        if factor.max() > 1.0:
            variance *= np.maximum(factor, 1.0)
            left = _left_by_fit(own, variance)
            share = np.maximum(np.diag(left), VISIBLE.share)
    noise[known] = np.sqrt(variance)
    noise[noise <= 2.0 * VISIBLE.residual] = np.nan
    return noise


def _left_by_fit(axes: Array, variance: Array) -> Array:
    """Return the matrix (n, n) from values to their residuals with weights 1 / variance."""
    weighted = axes / variance[:, None]
    fit = np.linalg.pinv(axes.T @ weighted, hermitian=True) @ weighted.T
    left: Array = np.eye(len(axes)) - axes @ fit
    return left


def concerns_of(
    channels: Sequence[ChannelHealth],
    units: Sequence[UnitHealth] = (),
    unused: Sequence[tuple[str, str]] = (),
    rate: RateHealth | None = None,
) -> list[Concern]:
    """Return all reasons not to call channels and units healthy, the worst first.

    Parameters
    ----------
    channels, units
        What was measured, over a flight or over the last seconds.
    unused
        Topics of gyros that are left out, and why.
    rate
        How the fused rate was published. None: not measured.
    """
    by_unit = {unit.name for unit in units if _is_slow(unit)}
    alone = [one for one in channels if one.unit not in by_unit]
    left_out = [
        Concern(Word.LOOK, trouble_of_unused(why), (topic,), f"is left out: {why}")
        for topic, why in unused
    ]
    return [
        *_unchecked(channels),
        *left_out,
        *_unit_concerns(units),
        *_incomplete([one for one in alone if one.delivered < REPORTED.delivered]),
        *_doubts([one for one in alone if one.doubt]),
        *_drifted([one for one in channels if _has_drifted(one)]),
        *_wrong_scale(channels),
        *_at_end_of_range([one for one in channels if one.saturated_s > 0.0]),
        *_rate_concerns(rate),
        *_spiky([one for one in channels if one.spikes >= REPORTED.spikes]),
        *_noise_concerns(channels, {one.name: one for one in units}),
    ]


def word_of(concerns: Iterable[Concern]) -> Word:
    """Return the first word of the verdict where no fault was declared."""
    words = {one.word for one in concerns}
    if Word.CANNOT_TELL in words:
        return Word.CANNOT_TELL
    return Word.LOOK if words else Word.HEALTHY


_BY_URGENCY = (Word.HEALTHY, Word.LOOK, Word.CANNOT_TELL, Word.FAULTY)


def live_word(status: Status, concerns: Sequence[Concern]) -> Word:
    """Return the first word of the verdict on a monitor at its last sample."""
    if any(map(is_declared_or_silent, status.channels)):
        return Word.FAULTY
    far = any(map(status.has_implausible_start_bias, status.channels))
    if not status.has_rate or not status.can_detect or far:
        return Word.CANNOT_TELL
    states = {channel.state for channel in status.channels}
    if ChannelState.UNCHECKED in states:
        return Word.CANNOT_TELL
    if states != {ChannelState.OK}:
        return max(word_of(concerns), Word.LOOK, key=_BY_URGENCY.index)
    return word_of(concerns)


def units_in_both_halves(channels: Iterable[ChannelStatus]) -> list[str]:
    """Return the units with a fault that shows in gyros and accelerometers at once.

    Such a unit is loose, frozen, turned or set to a wrong range. In each half two of its
    channels at least are faulty, or a set is of this unit alone.
    """
    shown: dict[str, dict[str, int]] = {}
    for one in channels:
        unit = one.name.rpartition(".")[0]
        others = {name.rpartition(".")[0] for name in one.group} - {unit}
        if unit and one.state in DECLARED and not others:
            halves = shown.setdefault(unit, {})
            halves[one.unit] = halves.get(one.unit, 0) + 1
    return [
        unit
        for unit, halves in shown.items()
        if len(halves) > 1 and min(halves.values()) > 1
    ]


def is_declared_or_silent(channel: ChannelStatus) -> bool:
    """Whether a channel is declared faulty, alone or in a set, or is silent."""
    return channel.state in (*DECLARED, ChannelState.STALE)


def _rate_concerns(rate: RateHealth | None) -> list[Concern]:
    if rate is None or rate.missing_s < REPORTED.missing_s:
        return []
    word = Word.CANNOT_TELL if rate.share < REPORTED.checked else Word.LOOK
    since = rate.missing_from_s
    when = "" if since is None else f", for the first time at {since:.1f} s"
    words = f"was not published for {figures(rate.missing_s)} s{when}"
    who = ("the fused rate",)
    if rate.frozen:
        words += f", when {listed(rate.frozen)} repeated one value"
        return [Concern(word, Trouble.REPEATS, who, words, cause=rate.frozen)]
    return [Concern(word, Trouble.NO_RATE, who, words)]


def _is_slow(unit: UnitHealth) -> bool:
    return unit.delivered < REPORTED.delivered or unit.slow_from_s is not None


def _slow_words(unit: UnitHealth) -> str:
    if unit.delivered == 0.0 and unit.rate_hz is None:
        return "delivered no message"
    words = f"delivered {percent(unit.delivered)} of its messages"
    if unit.slow_rate_hz is None or unit.rate_hz is None:
        return words
    rates = f"{figures(unit.slow_rate_hz)} instead of {figures(unit.rate_hz)} Hz"
    if unit.slow_from_s is None:
        return f"{words} ({rates})"
    until = "to the end" if unit.slow_to_s is None else f"to {unit.slow_to_s:.0f} s"
    return f"{words} (from {unit.slow_from_s:.0f} s {until} at {rates})"


def _unit_concerns(units: Sequence[UnitHealth]) -> list[Concern]:
    """Return concerns about what units deliver."""
    slow = [
        Concern(Word.LOOK, Trouble.DELIVERY, (unit.name,), _slow_words(unit))
        for unit in units
        if _is_slow(unit)
    ]
    copies = [
        Concern(
            Word.LOOK,
            Trouble.COPY,
            (unit.name,),
            f"repeats the values of {unit.copy_of}: one sensor, no redundancy",
        )
        for unit in units
        if unit.copy_of
    ]
    warned = [
        Concern(
            Word.LOOK, Trouble.INPUT, (unit.name,), f"has a warning: {unit.warning}"
        )
        for unit in units
        if unit.warning
    ]
    return slow + copies + warned


def _alike(
    some: Sequence[ChannelHealth], word: Word, trouble: Trouble, words: str
) -> list[Concern]:
    """Return one concern about all of some channels, or none of no channels."""
    names = tuple(one.name for one in some)
    return [Concern(word, trouble, names, words)] if names else []


def why_unchecked(
    channels: Sequence[ChannelHealth],
) -> tuple[Trouble, tuple[str, ...]]:
    """Return what keeps channels from being checked, and the channels that cause it, if known."""
    most = max((1.0 - one.checked for one in channels), default=0.0)
    if any(one.repeated >= REPORTED.cause * most > 0.0 for one in channels):
        return Trouble.UNCHECKED_REPEATS, ()
    at_end = [one.name for one in channels if one.saturated_s >= REPORTED.saturated_s]
    if at_end:
        return Trouble.END_OF_RANGE, tuple(at_end)
    return Trouble.UNCHECKED, ()


def _unchecked(channels: Sequence[ChannelHealth]) -> list[Concern]:
    some = [one for one in channels if one.checked < REPORTED.checked]
    if not some:
        return []
    share = percent(min(one.checked for one in some))
    words = f"could be checked in only {share} of the samples"
    if share == percent(0.0):
        words = "could not be checked"
    trouble, cause = why_unchecked(channels)
    who = tuple(one.name for one in some)
    return [Concern(Word.CANNOT_TELL, trouble, who, words, cause=cause)]


def _incomplete(some: Sequence[ChannelHealth]) -> list[Concern]:
    least = min((one.delivered for one in some), default=0.0)
    words = f"gave a value in only {percent(least)} of the samples"
    return _alike(some, Word.LOOK, Trouble.DELIVERY, words)


def repeating(channels: Sequence[ChannelHealth]) -> list[Concern]:
    """Return a concern about channels that repeated values for long in a recording.

    Live, their state says so.
    """
    some = [one for one in channels if one.repeated >= WHOLE.frozen]
    most = max((one.repeated for one in some), default=0.0)
    words = f"repeated one value for long, in {percent(most)} of the samples"
    return _alike(some, Word.LOOK, Trouble.REPEATS, words)


def _has_drifted(one: ChannelHealth) -> bool:
    return one.measured_in == "rad/s" and abs(one.drift) >= REPORTED.drift_rad_s


def _drifted(some: Sequence[ChannelHealth]) -> list[Concern]:
    most = max((abs(one.drift) for one in some), default=0.0)
    verb = "has a bias that" if len(some) == 1 else "have biases that"
    size = f"{'up to ' if len(some) > 1 else ''}{figures(most, 2)} rad/s"
    words = f"{verb} moved by {size} since the start at rest"
    return _alike(some, Word.LOOK, Trouble.DRIFT, words)


def _wrong_scale(channels: Sequence[ChannelHealth]) -> list[Concern]:
    """Return a concern about the channels that read too much or too little.

    The errors of all channels along an axis have a mean of zero, as the true rate is not known: if
    one of three reads 30 % too much, it is 20 % above the mean, and the others are 10 % below.
    """
    most = max((abs(one.scale) for one in channels), default=0.0)
    odd = [one for one in channels if abs(one.scale) > REPORTED.scale_share * most]
    if not odd:
        return []
    low = min(one.scale for one in odd)
    high = max(one.scale for one in odd)
    if low < 0.0 < high:
        words = f"have scale factors that differ by {percent(high - low)}"
    else:
        verb = "reads" if len(odd) == 1 else "read"
        most = max(abs(one.scale) / one.scale_seen for one in odd)
        words = f"{verb} about {percent(most)} too {'much' if high > 0.0 else 'little'}"
    return _alike(odd, Word.LOOK, Trouble.SCALE, words)


def _at_end_of_range(some: Sequence[ChannelHealth]) -> list[Concern]:
    longest = max((one.saturated_s for one in some), default=0.0)
    words = f"reached the end of the range for {figures(longest, 2)} s"
    return _alike(some, Word.LOOK, Trouble.END_OF_RANGE, words)


def _spiky(some: Sequence[ChannelHealth]) -> list[Concern]:
    return [
        Concern(
            Word.LOOK,
            Trouble.SPIKES,
            (one.name,),
            f"has {one.spikes} spikes",
        )
        for one in some
    ]


def _doubts(some: Sequence[ChannelHealth]) -> list[Concern]:
    """Return a concern for each way in which channels are doubtful at the end."""
    by_words: dict[str, list[str]] = {}
    for one in some:
        by_words.setdefault(one.doubt, []).append(one.name)
    return [
        Concern(
            Word.LOOK,
            Trouble.EXCLUDED if words.startswith(STAYED_OUT) else Trouble.DOUBT,
            tuple(names),
            words,
        )
        for words, names in by_words.items()
    ]


def _noise_concerns(
    channels: Sequence[ChannelHealth], units: Mapping[str, UnitHealth]
) -> list[Concern]:
    """Return concerns about noise: one for each unit, then one for each time of noise.

    Noise that lasts becomes usual, so it is compared with the other units instead.
    """
    ratios = _noise_ratios(channels)
    by_unit: dict[str, list[ChannelHealth]] = {}
    for one in channels:
        if one.name in ratios:
            by_unit.setdefault(one.unit or one.name, []).append(one)
    lasting = []
    for name, own in by_unit.items():
        words = _lasting_noise_words(own, max(ratios[one.name] for one in own))
        trouble = Trouble.NOISE
        if name in units and (late := _late_words(units[name])):
            words += f": {late}"
            trouble = Trouble.DELAY
        who = tuple(one.name for one in own)
        lasting.append(Concern(Word.LOOK, trouble, who, words))
    brief = [
        one
        for one in channels
        if one.noisy_s >= REPORTED.noisy_s and (one.unit or one.name) not in by_unit
    ]
    return [*lasting, *_noisy_for_a_time(brief)]


def _late_words(unit: UnitHealth) -> str:
    """Return the delay of a unit, if it may be the cause of its noise. Empty: it is not."""
    delay, std = unit.delay_s, unit.delay_std_s
    if delay is None or std is None:
        return ""
    if abs(delay) < max(NOISY_DELAY.seconds, NOISY_DELAY.sigmas * std):
        return ""
    side = "late" if delay > 0.0 else "early"
    return (
        f"its stamps are {figures(1000 * abs(delay), 2)} ms {side} against those of {unit.delay_to},"
        " which looks like noise in motion"
    )


def _lasting_noise_words(own: Sequence[ChannelHealth], ratio: float) -> str:
    """Describe the noise of channels of a unit, as it continues their names."""
    most = "up to " if len(own) > 1 else ""
    words = f"had {most}{figures(ratio, 2)} times the noise of the other units"
    began = [one.noisy_from_s for one in own if one.noisy_s >= REPORTED.noisy_s]
    if not began:
        return words
    first = min(began)
    when = f"from {first:.1f} s on" if first >= 0.0 else f"for {-first:.0f} s"
    return f"{words}, {when}"


def _noisy_for_a_time(channels: Sequence[ChannelHealth]) -> list[Concern]:
    """Return concerns about channels that were noisy for a time, one for each time.

    Channels of several units that are noisy at once measure the same axis: only their
    difference is known, and one is noisy.
    """
    found = []
    left = sorted(channels, key=lambda one: -one.noisy_s)
    while left:
        first = left[0]
        same = [one for one in left if _are_noisy_together(one, first)]
        left = [one for one in left if one not in same]
        began = first.noisy_from_s
        when = f"from {began:.1f} s" if began >= 0.0 else f"{-began:.0f} s ago"
        times = figures(max(one.noisy_times for one in same), 2)
        words = f"had noise {times} times as large as usual for {first.noisy_s:.1f} s, {when}"
        if began < 0.0 and -began - first.noisy_s < REPORTED.lasting_s:
            words = f"has noise {times} times as large as usual, for {-began:.0f} s now"
        names = tuple(one.name for one in channels if one in same)
        several = len({one.unit for one in same}) > 1
        joined_by = "or" if several else "and"
        found.append(Concern(Word.LOOK, Trouble.NOISE, names, words, joined_by))
    return found


def _are_noisy_together(one: ChannelHealth, other: ChannelHealth) -> bool:
    return (
        one.measured_in == other.measured_in
        and one.noisy_from_s <= other.noisy_from_s + other.noisy_s
        and other.noisy_from_s <= one.noisy_from_s + one.noisy_s
    )


def _noise_ratios(channels: Sequence[ChannelHealth]) -> dict[str, float]:
    """Return the noise of channels that are much noisier than all other units.

    By name, over the largest noise in the other units.
    """
    ratios = {}
    for quantity in dict.fromkeys(one.measured_in for one in channels):
        half = [one for one in channels if one.measured_in == quantity]
        noise = np.array(
            [
                math.nan if one.own_noise_rad_s is None else one.own_noise_rad_s
                for one in half
            ]
        )
        units: dict[str, list[int]] = {}
        for i, one in enumerate(half):
            units.setdefault(one.unit or one.name, []).append(i)
        for i, beside in much_noisier(noise, list(units.values())):
            ratios[half[i].name] = float(noise[i]) / beside
    return ratios
