# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What happened in a recording, as values and in words: stretches between gaps, in each the episodes, one per fault.

Each stretch is judged for itself: what was declared or suspected before is forgotten (``Pipeline.reset``), as an
operator does between two flights. Biases stay: the sensors are the same, and a fault that is still there is to be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fdi_ros.report.layout import FORCES, RADIANS, Unit
from fdi_ros.system.text import plus_minus

GAP = 10.0
"""Samples further apart than this are of two stretches, s. Shorter holes are part of one: messages were lost."""
HOLE = 1.0  # no fault is injected into a longer time without a sample, and no curve is drawn over it, s


def pieces(stamp: NDArray[np.int64], longest: float = HOLE) -> list[slice]:
    """Return the rows of stamps (N,), ns, in pieces without an interval longer than this, s."""
    edges = [
        0,
        *(np.flatnonzero(np.diff(stamp) > longest * 1e9) + 1).tolist(),
        len(stamp),
    ]
    return [slice(begin, end) for begin, end in pairwise(edges) if end > begin]


DECLARED = ("FAULTY", "AMBIGUOUS")
"""States of an episode in which a fault was declared; in one that is STALE channels gave nothing."""
Course = Literal[
    "steady", "growing", "shrinking", "varying", "noisy", "proportional", "gone"
]


@dataclass(frozen=True)
class Size:
    """The error of one channel while it stood declared, if it alone was wrong."""

    rad_s: float  # with its sign; of what varies or is noise, root mean square
    std_rad_s: float  # standard error of that: by chance, and by the scale factors and biases that are not known
    course: Course
    """steady; growing, shrinking (then the size is that at the declaration); varying; noisy; proportional to the rate
    along the axis; gone before the end."""
    last_rad_s: float  # in the last batch
    slope_rad_s2: float | None = None  # of what grows or shrinks
    share_of_rate: float | None = (
        None  # of what is proportional to the rate: an error of the scale factor
    )
    gone_s: float | None = (
        None  # since when it has stayed away, s from the first message
    )


@dataclass(frozen=True)
class Step:
    """Who was declared how from a time on, within an episode."""

    at_s: float  # s from the first message
    state: str  # FAULTY: every one of the channels; AMBIGUOUS: one of them; STALE: they give nothing.
    channels: tuple[str, ...]
    who: str  # the channels in words


@dataclass(frozen=True)
class Candidate:
    """A channel that would explain what was seen, and how large its error then was."""

    channel: str
    axis: str  # of the body: x, -y, or a direction
    size: Size | None  # none: the others do not tell


@dataclass(frozen=True)
class Apart:
    """Two channels that alone measure one axis, and by how much they differ."""

    channels: tuple[str, ...]
    who: str  # the two in words
    size: Size


@dataclass(frozen=True)
class RateMeanwhile:
    """What the fused rate did during an episode."""

    published: float  # share of the samples with a rate
    std_before_rad_s: (
        float | None
    )  # root of the trace of its covariance half a second before; None: there was no rate.
    std_rad_s: float | None  # the same on average during the episode
    level_rad_s: (
        float | None
    )  # largest protection level of an axis meanwhile; None: there was a sample without one.


@dataclass(frozen=True)
class Evidence:
    """What the declaration rests on."""

    reason: str
    ratio: (
        float | None
    )  # largest statistic, as a share of its threshold; None: no sample was judged.
    alarms: int  # samples with an alarm
    last_alarm_s: float | None  # last sample with an alarm, s from the first message


@dataclass(frozen=True)
class Episode:
    """A fault as the monitor told of it, from its first declaration on; times in s from the first message."""

    stretch: int  # number of the stretch it lies in, from 1
    state: str  # what it came to: FAULTY, AMBIGUOUS or STALE
    channels: tuple[
        str, ...
    ]  # all that are FAULTY or STALE; AMBIGUOUS: of which one is, as far as the evidence went.
    who: str  # the channels in words
    start_s: float
    since_s: float  # since when it has been these channels, in this state
    end_s: float  # when nothing of it stood any more, or the end of the stretch
    stands: bool  # it stood at the end of the stretch
    steps: tuple[Step, ...]  # how it came to that, the last one included
    candidates: tuple[Candidate, ...]
    """What explains it: the channels above, and how large their errors were; one by one."""
    apart: Apart | None
    """AMBIGUOUS, where two channels alone measure an axis: the two that surely differ, and by how much."""
    evidence: Evidence
    rate: RateMeanwhile
    words: str = ""  # the whole in one sentence
    measured_in: str = RADIANS.name
    """rad/s, or m/s^2 of accelerometers: then sizes and standard deviations are of the specific force."""
    injected: tuple[str, ...] = ()  # injected faults that explain it

    @property
    def duration_s(self) -> float:
        """From the first declaration to the end."""
        return round(self.end_s - self.start_s, 9)

    @property
    def declares(self) -> bool:
        """Whether a fault was declared; otherwise channels only gave nothing."""
        return self.state in DECLARED

    @property
    def ever(self) -> frozenset[str]:
        """Every channel that it was about at some time."""
        return frozenset(name for step in self.steps for name in step.channels)


@dataclass(frozen=True)
class Stretch:
    """A part of a recording without a long gap, judged as a recording of its own."""

    start_s: float  # s from the first message
    end_s: float
    samples: int
    judged: int  # samples that were judged
    watched_s: float  # time that was judged while nothing stood declared, s


@dataclass(frozen=True)
class Story:
    """All that happened in a recording."""

    stretches: tuple[Stretch, ...]
    episodes: tuple[
        Episode, ...
    ]  # in the order of time; the first ones where there are very many
    more: int = 0  # episodes beyond these

    @property
    def declared(self) -> list[Episode]:
        """Episodes in which a fault was declared."""
        return [one for one in self.episodes if one.declares]

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Begin and end of what lies between the stretches, s from the first message."""
        return [
            (a.end_s, b.start_s)
            for a, b in zip(self.stretches, self.stretches[1:], strict=False)
        ]


NOTHING_HAPPENED = Story((), ())  # of a recording without samples


# In words -------------------------------------------------------------------------------------------------------------


MOST_TOLD = 5  # episodes told of at the top; all are in the tables
TOO_SMALL = "too small to measure"  # a size that is below its standard error
FEW_CHANNELS = 3  # sets up to this size are told channel by channel


def size_words(size: Size | None, unit: Unit = RADIANS) -> str:
    """Say how large an error was, with its sign, how sure that is, and what it did; empty: not known."""
    if size is None:
        return ""
    value, std = size.rad_s * unit.factor, size.std_rad_s * unit.factor
    figure = f"{plus_minus(abs(value), std)} {unit.name}"
    if size.course == "proportional":
        # Two digits, and never -1e+02.
        share = float(f"{100 * (size.share_of_rate or 0.0):.2g}")
        of = "specific force" if unit == FORCES else "rate"
        return f"{share:+g} % of the {of}, {figure} rms"
    if size.course == "noisy":
        return f"noise of {figure}"
    if size.course == "varying":
        return f"varying, {figure} rms"
    figure = f"{'-' if value < 0 else '+'}{figure}" if abs(value) > std else TOO_SMALL
    if size.course == "gone":
        return f"{figure}, until {size.gone_s:.3f} s"
    if size.course == "growing":
        return f"{figure}, growing to {size.last_rad_s * unit.factor:+.3g} {unit.name}"
    return figure if size.course == "steady" else f"{figure}, {size.course}"


class _Measured(Protocol):
    """Something with figures in a unit."""

    @property
    def measured_in(self) -> str:
        """Name of the unit."""


def unit_for(one: _Measured, unit: Unit) -> Unit:
    """Return the unit for figures of an episode or a channel; ``unit``: that of rates."""
    return unit if one.measured_in == RADIANS.name else FORCES


def episode_words(one: Episode, unit: Unit = RADIANS) -> str:
    """Tell of an episode in one sentence, without a full stop."""
    unit = unit_for(one, unit)
    until = "" if one.stands else f" to {one.end_s:.3f} s"
    about, before = _about(one, unit), _before(one)
    if one.apart is not None:
        where = (
            ""
            if one.apart.channels == one.channels
            else f"seen on {one.apart.who.removesuffix(',')}: "
        )
        about = f", {where}{about}"
    elif about:
        about = f" ({about})"
    return f"{one.who} {one.state} from {one.since_s:.3f} s{until}{about}{f'; before that {before}' if before else ''}"


def _about(one: Episode, unit: Unit) -> str:
    if one.state == "STALE":
        return one.evidence.reason
    if one.apart is not None:
        # Which of both reads more is no matter where one of them is wrong.
        apart = replace(
            one.apart.size,
            rad_s=abs(one.apart.size.rad_s),
            last_rad_s=abs(one.apart.size.last_rad_s),
        )
        return (
            size_words(apart, unit)
            .removeprefix("+")
            .replace(unit.name, f"{unit.name} apart", 1)
        )
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
    if len(one.channels) <= FEW_CHANNELS:
        return "; ".join(f"{words} if it is {name}" for name, words in sizes)
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
    # A channel that was the only candidate, but not yet confirmed, is no step of its own.
    earlier = [step for step in one.steps[:-1] if step.channels != one.channels]
    chosen = earlier[:1]
    for step in earlier[1:][-1:]:
        if len(step.channels) <= 1 + FEW_CHANNELS and step.who != chosen[0].who:
            chosen.append(step)
    return ", ".join(f"{step.who} from {step.at_s:.3f} s" for step in chosen)


def detail_words(
    one: Episode, unit: Unit = RADIANS, scored: bool = False
) -> list[tuple[str, str]]:
    """Tell the rest of an episode, each line under its title; scored: faults were injected."""
    unit = unit_for(one, unit)
    injected = (
        [("injected faults", ", ".join(one.injected) or "nothing")] if scored else []
    )
    lines = [
        ("lasted", f"{_seconds(one.duration_s)}{', to the end' if one.stands else ''}")
    ]
    if one.declares:
        axes = dict.fromkeys(candidate.axis for candidate in one.candidates)
        if 0 < len(axes) <= FEW_CHANNELS:
            lines.append(("axis", f"{', '.join(axes)} of the body"))
        growing = [
            words for candidate in one.candidates if (words := _growth(candidate, unit))
        ]
        if growing and len(one.channels) <= FEW_CHANNELS:
            lines.append(("size", "; ".join(growing)))
        lines += [
            ("evidence", _evidence(one)),
            ("alternative", _rivals(one, unit)),
        ]
    what = "rate" if one.measured_in == RADIANS.name else "specific force"
    return [*lines, (f"fused {what}", _rate(one, unit)), *injected]


def _growth(one: Candidate, unit: Unit) -> str:
    """Say how an error went on that grows or shrinks; nothing of others."""
    size = one.size
    if size is None or not size.slope_rad_s2:
        return ""
    first, last, slope = (
        f"{value * unit.factor:+.3g}"
        for value in (size.rad_s, size.last_rad_s, size.slope_rad_s2)
    )
    return f"{one.channel} {size.course} by {slope} {unit.name} per second, from {first} to {last} {unit.name}"


def _evidence(one: Episode) -> str:
    """Say what the declaration rests on."""
    words = [one.evidence.reason] if one.evidence.reason else []
    if one.evidence.ratio is not None:
        words.append(f"statistic {one.evidence.ratio:.3g} times its threshold")
    if (
        one.state == "AMBIGUOUS"
        and one.evidence.last_alarm_s is not None
        and one.evidence.last_alarm_s < one.end_s
    ):
        words.append(f"last alarm at {one.evidence.last_alarm_s:.3f} s")
    return ", ".join(words)


def _rivals(one: Episode, unit: Unit) -> str:
    """Say which other channels would explain it as well."""
    if one.state == "FAULTY":
        return (
            "no other single channel explains the evidence"
            if len(one.channels) == 1
            else "no single channel explains the evidence"
        )
    if len(one.channels) > FEW_CHANNELS:
        return f"an error of any of {', '.join(one.channels)}"
    sizes = [
        (candidate.channel, size_words(candidate.size, unit))
        for candidate in one.candidates
    ]
    return "; or ".join(
        f"{name} wrong by {words}" if words else name for name, words in sizes
    )


def _rate(one: Episode, unit: Unit) -> str:
    """Say what the fused rate did."""
    rate = one.rate
    if rate.published == 0.0:
        return "not published"
    share = (
        "published throughout"
        if rate.published == 1.0
        else f"published in {100 * rate.published:.3g} % of samples"
    )
    words = [share]
    if rate.std_rad_s is not None:
        before = (
            ""
            if rate.std_before_rad_s is None
            else f" ({_figure(rate.std_before_rad_s, unit)} before)"
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
    """Tell of the stretches where there are several: each is judged for itself."""
    if len(story.stretches) < 2:
        return []
    lines = []
    for number, one in enumerate(story.stretches, 1):
        own = sum(episode.stretch == number for episode in story.declared)
        share = f"{100 * one.judged / max(1, one.samples):.3g} % judged"
        count = f"{own} episode{'s' if own != 1 else ''}" if own else "nothing declared"
        lines.append(
            f"stretch {number}: {one.start_s:.3f} s to {one.end_s:.3f} s, {share}, {count}"
        )
    return lines


def _figure(value: float, unit: Unit) -> str:
    return f"{value * unit.factor:.3g}"


def _seconds(value: float) -> str:
    return f"{1000 * value:.0f} ms" if value < 1 else f"{value:.1f} s"
