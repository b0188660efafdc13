# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Events in a recording, as records and in words: stretches between gaps, and one episode per fault.

Each stretch is judged separately: declarations and suspicions of the stretch before are cleared
(``Pipeline.reset``), as an operator does between two flights. Biases are kept, because the sensors
are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fdi_ros.monitor.soundness import WHOLE
from fdi_ros.replay.warming import Warming
from fdi_ros.report.layout import FORCES, RADIANS, Unit
from fdi_ros.system.text import figures, listed, percent, plus_minus


class EpisodeTimes(NamedTuple):
    """Times that cut a stream into stretches and episodes, s."""

    #: gap between two stretches. A shorter hole is within a stretch: messages were
    #: lost
    stretch_gap: float = WHOLE.pause
    #: longest time without samples over which faults are injected and curves are
    #: drawn
    longest_hole: float = 1.0
    #: a fault that stands for less is reported with its duration
    brief: float = 1.0
    #: largest time between the first signs of a fault of a unit in its gyros and in
    #: its accelerometers
    across_halves: float = 5.0
    #: time between the first sign and the declaration that is reported. Words have
    #: tenths
    least_before: float = 0.05


EPISODE_TIMES = EpisodeTimes()


def pieces(
    stamp: NDArray[np.int64], longest: float = EPISODE_TIMES.longest_hole
) -> list[slice]:
    """Cut stamps (N,), ns, at intervals longer than ``longest``, s. Return slices of rows."""
    edges = [
        0,
        *(np.flatnonzero(np.diff(stamp) > longest * 1e9) + 1).tolist(),
        len(stamp),
    ]
    return [slice(begin, end) for begin, end in pairwise(edges) if end > begin]


class EpisodeRoom(NamedTuple):
    """How many episodes, steps and channels are described."""

    #: largest number of steps of an episode. The last step is always kept
    steps: int = 20
    #: episodes in the summary. The tables have all
    episodes: int = 5
    #: largest set that is described channel by channel
    channels: int = 3


ROOM = EpisodeRoom()

DECLARED = ("FAULTY", "AMBIGUOUS")
"""States of an episode with a declared fault. The other state, STALE, means no data."""
Course = Literal[
    "steady", "growing", "shrinking", "varying", "noisy", "proportional", "gone"
]


@dataclass(frozen=True)
class Size:
    """Error of one channel while it was declared, if no other channel was wrong."""

    rad_s: float
    """Signed error, rad/s. Root mean square if the error varies or is noise."""
    std_rad_s: float
    """Standard error of `rad_s`, from noise and from unknown scale factors and biases, rad/s."""
    course: Course
    """Course over time. The size of a growing or shrinking error is the one at the declaration.
    ``proportional``: to the rate along the axis. ``gone``: the error ended before the recording."""
    last_rad_s: float
    """Error in the last batch, rad/s."""
    slope_rad_s2: float | None = None
    """Slope of a growing or shrinking error, rad/s^2. None: another course."""
    share_of_rate: float | None = None
    """Scale error, as a share of the rate. None: another course than ``proportional``."""
    gone_s: float | None = None
    """Time at which the error ended, s from the first message. None: it did not, or the
    course is neither ``gone`` nor ``proportional``."""


@dataclass(frozen=True)
class Step:
    """State of an episode from some time on."""

    at_s: float
    """Begin of the step, s from the first message."""
    state: str
    """FAULTY: all channels are faulty. AMBIGUOUS: one of them is. STALE: they deliver no data."""
    channels: tuple[str, ...]
    """Names of the channels."""
    who: str
    """The channels in words."""


@dataclass(frozen=True)
class Candidate:
    """A channel whose error would explain the evidence."""

    channel: str
    """Name of the channel."""
    axis: str
    """Its axis in the body frame: x, -y, or a direction."""
    size: Size | None
    """Size of the error. None: the other channels do not determine it."""


@dataclass(frozen=True)
class Apart:
    """Difference of the only two channels that measure one axis."""

    channels: tuple[str, ...]
    """Names of the two channels."""
    who: str
    """The two channels in words."""
    size: Size
    """Difference of the two."""


@dataclass(frozen=True)
class RateMeanwhile:
    """The fused rate during an episode."""

    published: float
    """Share of the samples with a rate."""
    std_before_rad_s: float | None
    """Root of the trace of the covariance half a second before the episode, rad/s. None: no rate."""
    std_rad_s: float | None
    """The same on average during the episode, rad/s."""
    level_rad_s: float | None
    """Largest protection level of an axis, rad/s. None: a sample had no level."""


@dataclass(frozen=True)
class Evidence:
    """Evidence for a declaration."""

    reason: str
    """Reason in words."""
    ratio: float | None
    """Largest statistic, as a multiple of its threshold. None: no sample was judged."""
    alarms: int
    """Number of samples with an alarm."""
    last_alarm_s: float | None
    """Time of the last alarm, s from the first message."""


@dataclass(frozen=True)
class Episode:
    """One fault, from its first declaration on. Times are in s from the first message."""

    stretch: int
    """Number of its stretch, from 1."""
    state: str
    """Last state: FAULTY, AMBIGUOUS or STALE."""
    channels: tuple[str, ...]
    """All channels that are FAULTY or STALE, or the candidates if the state is AMBIGUOUS."""
    who: str
    """The channels in words."""
    start_s: float
    """Time of the first declaration, s."""
    since_s: float
    """Time since which the episode has had these channels and this state, s."""
    end_s: float
    """Time at which the last declaration was withdrawn, or end of the stretch, s."""
    stands: bool
    """Whether a declaration stood at the end of the stretch."""
    steps: tuple[Step, ...]
    """All steps, the last one included."""
    candidates: tuple[Candidate, ...]
    """The channels with the sizes of their errors."""
    apart: Apart | None
    """If AMBIGUOUS: two channels that alone measure an axis and certainly differ."""
    evidence: Evidence
    """Evidence for the declaration."""
    rate: RateMeanwhile
    """The fused rate during the episode."""
    words: str = ""
    """The episode in one sentence."""
    wrong_to_s: float | None = None
    """Time of the last wrong value, s. The monitor withdraws a declaration later. None: not known."""
    measured_in: str = RADIANS.name
    """Unit of sizes and standard deviations: rad/s, or m/s^2 for accelerometers."""
    injected: tuple[str, ...] = ()
    """Injected faults that explain the episode."""
    sets: int = 1
    """Number of sets that came and went, and are one fault of the units in them."""
    longest_s: float | None = None
    """Length of the longest of these sets, s. None: there is only one, and no noise follows it."""
    noisy_from_s: float | None = None
    """Begin of the noise of the whole unit that belongs to the fault, s. None: no such noise."""
    halves: tuple[Episode, ...] = ()
    """Episodes of gyros and of accelerometers that are one fault of their unit. Empty: a fault of one
    kind of sensor. The halves have the candidates."""
    warming: tuple[Warming, ...] = ()
    """Channels whose errors follow the temperature of their unit. It explains the fault and changes
    no declaration."""
    warming_words: str = ""
    """The same in sentences. Empty: no error follows a temperature, or the log has none."""

    @property
    def duration_s(self) -> float:
        """Time from the first declaration to the end, s."""
        return round(self.end_s - self.start_s, 9)

    @property
    def declares(self) -> bool:
        """Whether a fault was declared. Otherwise the channels only delivered no data."""
        return self.state in DECLARED

    @property
    def is_brief(self) -> bool:
        """Whether it is a set that ended within `EPISODE_TIMES.brief`, or sets that all did."""
        if self.halves:
            return all(half.is_brief for half in self.halves)
        if self.longest_s is not None:
            return self.longest_s < EPISODE_TIMES.brief
        length = self.end_s - self.since_s
        return (
            self.state == "AMBIGUOUS"
            and not self.stands
            and length < EPISODE_TIMES.brief
        )

    @property
    def ever(self) -> frozenset[str]:
        """Channels of all steps."""
        return frozenset(name for step in self.steps for name in step.channels)


@dataclass(frozen=True)
class Stretch:
    """A part of a recording without a long gap, which is judged separately."""

    start_s: float
    """Time of the first sample, s from the first message."""
    end_s: float
    """Time of the last sample, s from the first message."""
    samples: int
    """Number of samples."""
    judged: int
    """Number of judged samples."""
    watched_s: float
    """Judged time without a standing declaration, s."""


@dataclass(frozen=True)
class Story:
    """Stretches and episodes of a recording."""

    stretches: tuple[Stretch, ...]
    """The stretches in the order of time."""
    episodes: tuple[Episode, ...]
    """The episodes in the order of time, at most the first 1000."""
    more: int = 0
    """Number of further episodes."""

    @property
    def declared(self) -> list[Episode]:
        """Episodes in which a fault was declared."""
        return [one for one in self.episodes if one.declares]

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Begin and end of the gaps between the stretches, s from the first message."""
        return [
            (a.end_s, b.start_s)
            for a, b in zip(self.stretches, self.stretches[1:], strict=False)
        ]


NOTHING_HAPPENED = Story((), ())
"""Story of a recording without samples."""


def join_halves(
    episodes: Sequence[Episode], unit_of: Mapping[str, str]
) -> list[Episode]:
    """Join episodes of the gyros and of the accelerometers of a unit that begin together.

    A unit that is loose, frozen, turned, silent or set to a wrong range shows in both, with
    two channels of each at least. Of two units neither may be the loose one for sure:
    sets that come and go are joined where they are of the same units. ``unit_of``: unit of
    each channel.
    """
    joined = []
    left = list(episodes)
    while left:
        first = left[0]
        units = {unit_of[name] for name in first.channels}
        parts = [
            one
            for one in left
            if all(units)
            and (len(units) == 1 or one.sets > 1 < first.sets)
            and _is_of_unit(one, first, unit_of, units)
        ]
        recurs = any(one.sets > 1 for one in parts)
        shown = {one.measured_in for one in parts if _shows_unit(one, recurs)}
        if len(shown) < len(HALVES):
            parts = [first]
        left = [one for one in left if one not in parts]
        joined.append(first if len(parts) == 1 else _whole(parts, sorted(units)))
    return joined


def _shows_unit(one: Episode, recurs: bool) -> bool:
    """Whether an episode shows a fault of a whole unit, and not of one channel.

    ``recurs``: beside it, sets of the unit come and go. Then one that was a set at first
    is one more of these.
    """
    is_set = recurs and one.state == "AMBIGUOUS" and len(one.ever) > 1
    return len(one.channels) > 1 or is_set


def _is_of_unit(
    one: Episode, first: Episode, unit_of: Mapping[str, str], units: set[str]
) -> bool:
    """Whether an episode belongs to the same fault of the unit as the first one."""
    return (
        {unit_of[name] for name in one.channels} == units
        and (one.stretch, one.declares) == (first.stretch, first.declares)
        and one.start_s <= min(first.end_s, first.start_s + EPISODE_TIMES.across_halves)
    )


def _whole(parts: Sequence[Episode], units: Sequence[str]) -> Episode:
    """Return the episode of a unit, or of one of some, that gyros and accelerometers show."""
    unit = listed(units, "or")
    by_half = [[one for one in parts if one.measured_in == name] for name in HALVES]
    channels = dict.fromkeys(
        name for half in by_half for one in half for name in one.channels
    )
    steps = [step for one in parts for step in one.steps]
    whole = replace(
        parts[0],
        channels=tuple(channels),
        who=unit,
        start_s=min(one.start_s for one in parts),
        since_s=max(min(one.start_s for one in half) for half in by_half),
        end_s=max(one.end_s for one in parts),
        stands=any(one.stands for one in parts),
        steps=tuple(sorted(steps, key=lambda step: step.at_s)),
        candidates=(),
        apart=None,
    )
    if whole.declares:
        named = any(one.state == "FAULTY" for one in parts)
        whole = replace(
            whole,
            state="FAULTY" if named else "AMBIGUOUS",
            who=f"{unit} ({' and '.join(HALVES.values())})",
            halves=tuple(parts),
        )
    return replace(whole, words=episode_words(whole))


# In words


HALVES = {RADIANS.name: "gyros", FORCES.name: "accelerometers"}
"""Kinds of sensors of a unit, by the unit of their figures."""
TOO_SMALL = "too small to measure"
"""Words for a size below its standard error."""


def size_words(size: Size | None, unit: Unit = RADIANS) -> str:
    """Return the size of an error with its standard error and course. Empty: not known."""
    if size is None:
        return ""
    value = size.rad_s * unit.factor
    std = size.std_rad_s * unit.factor
    figure = f"{plus_minus(abs(value), std)} {unit.name}"
    if size.course == "proportional":
        share = size.share_of_rate or 0.0
        of = true_quantity(unit)
        until = "" if size.gone_s is None else f", until {size.gone_s:.3f} s"
        if shows_nothing(share):
            return f"does not follow the {of}, off by {figure} rms{until}"
        if is_factor(share):
            return (
                f"{figures(1.0 + share, 2)} times the {of}, off by {figure} rms{until}"
            )
        return f"{figures(100.0 * share, 2, '+')} % of the {of}, {figure} rms{until}"
    if size.course == "noisy":
        return f"noise of {figure}"
    if size.course == "varying":
        return f"varying, {figure} rms"
    sign = "-" if value < 0 else "+"
    figure = f"{sign}{figure}" if abs(value) > std else TOO_SMALL
    if size.course == "gone":
        return f"{figure}, until {size.gone_s:.3f} s"
    if size.course == "steady" or is_too_small(size):
        return figure
    last = figures(size.last_rad_s * unit.factor, 3, "+")
    return f"{figure}, {course_word(size)} to {last} {unit.name}"


def is_too_small(size: Size) -> bool:
    """Whether an error stays below its standard error."""
    if size.course not in ("steady", "growing", "shrinking"):
        return False
    last = 0.0 if size.course == "steady" else abs(size.last_rad_s)
    return max(abs(size.rad_s), last) <= size.std_rad_s


def course_word(size: Size) -> str:
    """Return how a drifting error moves: ``growing``, ``shrinking``, or ``changing`` its sign."""
    grows = abs(size.last_rad_s) > abs(size.rad_s)
    keeps = size.rad_s * size.last_rad_s > 0.0 and grows == (size.course == "growing")
    return size.course if keeps else "changing"


def is_factor(share: float) -> bool:
    """Whether a scale error is so large that words give the factor, not the percentage."""
    return not -1.2 <= share <= 0.9


def shows_nothing(share: float) -> bool:
    """Whether a scale error leaves nothing of the rate, as with swapped axes or without a signal."""
    return -1.2 <= share <= -0.8


def true_quantity(unit: Unit) -> str:
    """Return what sensors with figures in a unit measure."""
    return "specific force" if unit == FORCES else "rate"


class _Measured(Protocol):
    """A record with figures in a unit."""

    @property
    def measured_in(self) -> str:
        """Name of the unit."""


def unit_for(one: _Measured, unit: Unit) -> Unit:
    """Return the unit for figures of an episode or channel, given the unit of rates."""
    return unit if one.measured_in == RADIANS.name else FORCES


def episode_words(one: Episode, unit: Unit = RADIANS) -> str:
    """Describe an episode in one sentence, without a full stop."""
    if one.halves:
        parts = "; ".join(episode_words(half, unit) for half in one.halves)
        return f"{one.who} {one.state} from {one.since_s:.3f} s: {parts}"
    unit = unit_for(one, unit)
    until = "" if one.stands else f" to {one.end_s:.3f} s"
    if one.sets > 1:
        until += f", {one.sets} times"
    if one.noisy_from_s is not None:
        until += f", noisy from {one.noisy_from_s:.3f} s on"
    about = _about(one, unit)
    before = _before(one)
    if not before and one.since_s - one.start_s >= EPISODE_TIMES.least_before:
        before = f"suspected from {one.start_s:.3f} s"
    if one.apart is not None:
        where = (
            ""
            if one.apart.channels == one.channels
            else f"seen on {one.apart.who.removesuffix(',')}: "
        )
        about = f", {where}{about}"
    elif about:
        about = f" ({about})"
    earlier = f"; before that {before}" if before else ""
    return f"{one.who} {one.state} from {one.since_s:.3f} s{until}{about}{earlier}"


def warming_words(one: Episode, unit: Unit = RADIANS) -> str:
    """Return sentences on errors that follow the temperature of their unit. Empty: none does."""
    if one.halves:
        return " ".join(
            filter(None, (warming_words(half, unit) for half in one.halves))
        )
    unit = unit_for(one, unit)
    kinds = dict.fromkeys((each.unit, each.certain) for each in one.warming)
    sentences = []
    for who, certain in kinds:
        alike = [
            each for each in one.warming if (each.unit, each.certain) == (who, certain)
        ]
        names = listed([each.channel for each in alike])
        several = len(alike) > 1
        if one.state == "AMBIGUOUS":
            are = "are" if several else "is"
            errors = (
                f"If {names} {are} faulty, {'their errors' if several else 'its error'}"
            )
        else:
            errors = f"The {'errors' if several else 'error'} of {names}"
        slopes = listed(
            [figures(abs(each.slope_per_c) * unit.factor, 2) for each in alike]
        )
        change = alike[0].range_c
        size = f"({slopes} {unit.name} per °C over {figures(abs(change), 2)} °C)"
        if certain:
            verb = "follow" if several else "follows"
            cause = "cooling" if change < 0.0 else "warming"
            sentences.append(
                f"{errors} {verb} the temperature of {who} {size}, so the cause is {cause}."
            )
        else:
            verb = "change" if several else "changes"
            sentences.append(
                f"{errors} {verb} with the temperature of {who} {size}. The cause may be heat or"
                " a steady drift: this recording cannot show which."
            )
    return " ".join(sentences)


def _about(one: Episode, unit: Unit) -> str:
    if one.state == "STALE":
        return one.evidence.reason
    if one.apart is not None:
        # The sign of a difference of two suspects has no meaning.
        apart = replace(
            one.apart.size,
            rad_s=abs(one.apart.size.rad_s),
            last_rad_s=abs(one.apart.size.last_rad_s),
        )
        words = size_words(apart, unit).removeprefix("+")
        if words.endswith(" rms"):
            return f"{words} apart"
        return words.replace(unit.name, f"{unit.name} apart", 1)
    sizes = [
        (candidate.channel, size_words(candidate.size, unit))
        for candidate in one.candidates
        if candidate.size
    ]
    disagrees = (
        one.evidence.reason.startswith(("disagrees", "has drifted"))
        or not one.evidence.reason
    )
    if one.state == "FAULTY":
        size = "; ".join(
            words if len(one.channels) == 1 else f"{name} {words}"
            for name, words in sizes
        )
        return "; ".join(
            part
            for part in (
                "" if disagrees else one.evidence.reason,
                size if disagrees else "",
            )
            if part
        )
    if len(one.channels) <= ROOM.channels:
        return "; ".join(f"if it is {name}: {words}" for name, words in sizes)
    known = [
        abs(candidate.size.rad_s)
        for candidate in one.candidates
        if candidate.size is not None
    ]
    span = (
        f"{_figure(min(known), unit)} to {_figure(max(known), unit)} {unit.name}"
        if known
        else ""
    )
    return f"{span}, depending on the channel" if span else ""


def _before(one: Episode) -> str:
    """Return the candidates of earlier steps: those of the first, and of the last if few and others."""
    if one.sets > 1 or one.noisy_from_s is not None:
        return ""
    # A channel that was the only candidate, but not yet confirmed, is no step of its own.
    earlier = [step for step in one.steps[:-1] if step.channels != one.channels]
    chosen = earlier[:1]
    for step in earlier[1:][-1:]:
        is_small = len(step.channels) <= 1 + ROOM.channels
        if is_small and step.who != chosen[0].who:
            chosen.append(step)
    return ", ".join(f"{step.who} from {step.at_s:.3f} s" for step in chosen)


def detail_words(
    one: Episode, unit: Unit = RADIANS, scored: bool = False
) -> list[tuple[str, str]]:
    """Return the details of an episode as titles and words.

    ``scored``: faults were injected, and the lines name those that explain the episode.
    """
    if one.halves:
        return [
            (f"{HALVES[half.measured_in]}: {title}", words)
            for half in one.halves
            for title, words in detail_words(
                replace(half, injected=one.injected), unit, scored
            )
        ]
    unit = unit_for(one, unit)
    injected = (
        [("injected faults", ", ".join(one.injected) or "nothing")] if scored else []
    )
    lines = [
        (
            "lasted",
            f"{_seconds(one.duration_s)}, from {one.start_s:.1f} s"
            f" to {'the end' if one.stands else f'{one.end_s:.1f} s'}",
        )
    ]
    if one.declares:
        axes = dict.fromkeys(candidate.axis for candidate in one.candidates)
        if 0 < len(axes) <= ROOM.channels:
            lines.append(("axis", f"{', '.join(axes)} of the body"))
        growing = [
            words for candidate in one.candidates if (words := _growth(candidate, unit))
        ]
        if growing and len(one.channels) <= ROOM.channels:
            lines.append(("size", "; ".join(growing)))
        lines.append(("evidence", _evidence(one)))
        if rivals := _rivals(one):
            lines.append(("alternative", rivals))
        if heat := warming_words(one, unit):
            words = heat[0].lower() + heat[1:].removesuffix(".")
            lines.append(("temperature", words))
    what = "rate" if one.measured_in == RADIANS.name else "specific force"
    return [*lines, (f"fused {what}", _rate(one, unit)), *injected]


def _growth(one: Candidate, unit: Unit) -> str:
    """Describe the growth of an error. Empty: the error neither grows nor shrinks."""
    size = one.size
    if size is None or not size.slope_rad_s2 or is_too_small(size):
        return ""
    first, last, slope = (
        figures(value * unit.factor, 3, "+")
        for value in (size.rad_s, size.last_rad_s, size.slope_rad_s2)
    )
    span = f"from {first} to {last} {unit.name}"
    if size.slope_rad_s2 * (size.last_rad_s - size.rad_s) <= 0.0:
        # It went there and back, and the slope has the other sign.
        return f"{one.channel} {course_word(size)} {span}"
    return (
        f"{one.channel} {course_word(size)} by {slope} {unit.name} per second, {span}"
    )


def _evidence(one: Episode) -> str:
    """Describe the evidence for a declaration."""
    words = [one.evidence.reason] if one.evidence.reason else []
    # Below the threshold the reason is another one, such as values that come and go.
    if one.evidence.ratio is not None and one.evidence.ratio >= 1.0:
        words.append(
            f"statistic {one.evidence.ratio:.2f} times its threshold when declared"
        )
    if (
        one.state == "AMBIGUOUS"
        and one.evidence.last_alarm_s is not None
        and one.evidence.last_alarm_s < one.end_s
    ):
        words.append(f"last alarm at {one.evidence.last_alarm_s:.3f} s")
    return ", ".join(words)


def _rivals(one: Episode) -> str:
    """Name other channels that would explain the evidence. Empty: the first line has them."""
    if one.state == "FAULTY":
        return (
            "no other single channel explains the evidence"
            if len(one.channels) == 1
            else "no single channel explains the evidence"
        )
    if len(one.channels) > ROOM.channels:
        return f"an error of any of {', '.join(one.channels)}"
    return ""


def _rate(one: Episode, unit: Unit) -> str:
    """Describe the fused rate during an episode."""
    rate = one.rate
    if rate.published == 0.0:
        return "not published"
    share = (
        "published throughout"
        if rate.published == 1.0
        else f"published in {percent(rate.published)} of samples"
    )
    words = [share]
    if rate.std_rad_s is not None:
        before = (
            ""
            if rate.std_before_rad_s is None
            else f" ({_figure(rate.std_before_rad_s, unit)} before the fault)"
        )
        words.append(
            f"mean standard deviation {_figure(rate.std_rad_s, unit)} {unit.name}{before}"
        )
    level = (
        ""
        if rate.level_rad_s is None
        else f"protection level up to {_figure(rate.level_rad_s, unit)} {unit.name}"
    )
    return ", ".join([*words, level or "no protection level at times"])


def stretch_words(story: Story) -> list[str]:
    """Describe the stretches. Empty: the recording has only one."""
    if len(story.stretches) < 2:
        return []
    lines = []
    for number, one in enumerate(story.stretches, 1):
        own = sum(episode.stretch == number for episode in story.declared)
        share = f"{percent(one.judged / max(1, one.samples))} judged"
        count = f"{own} episode{'s' if own != 1 else ''}" if own else "nothing declared"
        lines.append(
            f"stretch {number}: {one.start_s:.3f} s to {one.end_s:.3f} s, {share}, {count}"
        )
    return lines


def _figure(value: float, unit: Unit) -> str:
    return figures(value * unit.factor)


def _seconds(value: float) -> str:
    return f"{1000 * value:.0f} ms" if value < 1 else f"{value:.1f} s"
