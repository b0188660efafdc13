# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets that come and go are one fault: of a loose unit, or of one with a bad contact.

The error of a unit that oscillates in its mounting changes its sign, so evidence for a
single channel does not last. The monitor declares a set of the unit, withdraws it, and
declares it again, for as long as the unit is loose. Once the oscillation is learned as
noise, no set is declared any more: the noise of the unit is the rest of that fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

from fdi_ros.monitor.soundness import REPORTED
from fdi_ros.replay.episodes import (
    EPISODE_TIMES,
    ROOM,
    Episode,
    Step,
    Stretch,
    episode_words,
)


class _LooseUnit(NamedTuple):
    """Which sets of channels show one loose unit."""

    #: longest time between two sets, s: some swings of a loose unit
    within: float = 2.0
    #: number of sets that are reported as one. Two may be two faults
    sets: int = 3
    #: share of the time of all sets for which a unit must have been in them to
    #: explain them. As evidence fades, a set may be one of healthy channels for
    #: some samples
    share: float = 0.9
    #: noise that ends this close to the end of a stretch, s, lasts to its end.
    #: Noise of a line falls below its limit for moments
    lasts: float = 1.0
    #: number of channels of a unit whose noise is that of the unit. One is a noisy
    #: channel
    channels: int = 2


_LOOSE = _LooseUnit()


@dataclass(frozen=True)
class NoisyTime:
    """A time in which a channel was much noisier than before, and than the other units."""

    channel: str
    """Name of the channel."""
    measured_in: str
    """Unit of its figures: rad/s of a gyro, m/s^2 of an accelerometer."""
    since_s: float
    """Begin, s from the first message."""
    until_s: float
    """End, s from the first message."""


def join_recurring(
    episodes: Sequence[Episode], unit_of: Mapping[str, str]
) -> list[Episode]:
    """Join the sets of a unit that come and go, those of gyros and of accelerometers apart.

    ``unit_of``: unit of each channel. The episodes are in the order of their starts.
    """
    joined: list[Episode] = []
    for half in dict.fromkeys(one.measured_in for one in episodes):
        run: list[Episode] = []
        for one in episodes:
            if one.measured_in != half:
                continue
            if run and not _recurs(run, one, unit_of):
                joined += _told(run, unit_of)
                run = []
            run.append(one)
        joined += _told(run, unit_of)
    return sorted(joined, key=lambda one: (one.start_s, one.since_s))


def join_noise(
    episodes: Sequence[Episode],
    noisy: Sequence[NoisyTime],
    stretches: Sequence[Stretch],
    unit_of: Mapping[str, str],
) -> list[Episode]:
    """Join sets of a unit with its noise that follows, and with sets in that time.

    Evidence does not separate two parallel units, but noise that the other units do not
    show is of one unit. ``unit_of``: unit of each channel. The episodes are in the order
    of their starts.
    """
    joined: list[Episode] = []
    left = list(episodes)
    while left:
        one = left.pop(0)
        has_stretch = one.stretch <= len(stretches)
        end = stretches[one.stretch - 1].end_s if has_stretch else 0.0
        times = _noise_after(one, noisy, unit_of)
        if not times:
            joined.append(one)
            continue
        run = [one]
        until = min(max(time.until_s for time in times), end)
        for later in list(left):
            if later.measured_in == one.measured_in and _is_inside(
                later, until, run, times[0].channel, unit_of
            ):
                run.append(later)
                left.remove(later)
        joined.append(_noisy_unit(run, times, until, end, unit_of))
    return joined


def with_all_candidates(
    one: Episode, who_of: Callable[[Sequence[str]], str]
) -> Episode:
    """Return a set that was withdrawn with all channels that it may have been of.

    As evidence fades, a set shrinks. A step that lasted for less than `EPISODE_TIMES.brief` before the
    end clears no channel of the steps before it, and names none. ``who_of`` returns the
    words for a set of channels.
    """
    if one.state != "AMBIGUOUS" or one.stands or one.longest_s is not None:
        return one
    if one.halves:
        return one
    lengths = list(_lengths(one))
    lasted = [
        k for k, (_, seconds) in enumerate(lengths) if seconds >= EPISODE_TIMES.brief
    ]
    begin = lasted[-1] if lasted else 0
    channels = {name for step in one.steps[begin:] for name in step.channels}
    if channels == set(one.channels):
        return one
    since = one.steps[begin].at_s
    ordered = tuple(sorted(channels))
    step = Step(since, one.state, ordered, who_of(ordered))
    whole = replace(
        one,
        channels=ordered,
        who=step.who,
        since_s=since,
        steps=(*one.steps[:begin], step),
        candidates=(),
        apart=None,
    )
    return replace(whole, words=episode_words(whole))


def _noise_after(
    one: Episode, noisy: Sequence[NoisyTime], unit_of: Mapping[str, str]
) -> list[NoisyTime]:
    """Return the noise of the one unit behind an episode that begins in it or soon after."""
    if one.state != "AMBIGUOUS":
        return []
    after = [
        time
        for time in noisy
        if time.measured_in == one.measured_in
        and time.until_s - time.since_s >= REPORTED.noisy_s
        and one.start_s <= time.since_s <= one.end_s + _LOOSE.within
    ]
    by_unit: dict[str, list[NoisyTime]] = {}
    for time in after:
        by_unit.setdefault(unit_of[time.channel], []).append(time)
    if len(by_unit) != 1:
        return []
    (unit,) = by_unit
    channels = {time.channel for time in after}
    if len(channels) < _LOOSE.channels or unit not in _units_behind([one], unit_of):
        return []
    return after


def _is_inside(
    later: Episode,
    until: float,
    run: Sequence[Episode],
    noisy: str,
    unit_of: Mapping[str, str],
) -> bool:
    """Whether a later set may be of the unit with a noisy channel, until a time, s."""
    return (
        later.state == "AMBIGUOUS"
        and later.stretch == run[0].stretch
        and later.start_s <= until + _LOOSE.within
        and unit_of[noisy] in _units_behind([later], unit_of)
    )


def _noisy_unit(
    run: Sequence[Episode],
    times: Sequence[NoisyTime],
    until: float,
    end: float,
    unit_of: Mapping[str, str],
) -> Episode:
    """Return the episode of a unit whose sets, in a run, passed into its noise.

    The noise lasts until a time, s, in a stretch with that end, s.
    """
    unit = unit_of[times[0].channel]
    shown = {time.channel for time in times}
    in_sets = {name for one in run for name in one.channels}
    shown |= {name for name in in_sets if unit_of[name] == unit}
    whole = _whole(run)
    last = max(until, run[-1].end_s)
    whole = replace(
        whole,
        channels=tuple(name for name in unit_of if name in shown),
        who=unit,
        end_s=last,
        stands=run[-1].stands or end - last < _LOOSE.lasts,
        candidates=tuple(one for one in whole.candidates if one.channel in shown),
        apart=None,
        noisy_from_s=min(time.since_s for time in times),
    )
    return replace(whole, words=episode_words(whole))


def _recurs(run: Sequence[Episode], one: Episode, unit_of: Mapping[str, str]) -> bool:
    """Whether an episode continues a run of sets that the same units explain."""
    last = run[-1]
    return (
        (last.state, one.state) == ("AMBIGUOUS", "AMBIGUOUS")
        and last.stretch == one.stretch
        and 0.0 <= one.start_s - last.end_s <= _LOOSE.within
        and bool(_units_behind(run, unit_of) & _units_behind([one], unit_of))
    )


def _told(run: Sequence[Episode], unit_of: Mapping[str, str]) -> Sequence[Episode]:
    """Return a run of sets as one episode, or as they are if they are few."""
    units = _units_behind(run, unit_of)
    own = [
        step
        for one in run
        for step in one.steps
        if {unit_of[name] for name in step.channels} <= units
    ]
    if len(run) < _LOOSE.sets or not own:
        return run
    widest = max(own, key=lambda step: len(step.channels))
    whole = _whole(run)
    whole = replace(
        whole,
        channels=widest.channels,
        who=widest.who,
        candidates=tuple(
            one for one in whole.candidates if one.channel in widest.channels
        ),
    )
    return [replace(whole, words=episode_words(whole))]


def _whole(run: Sequence[Episode]) -> Episode:
    """Return the longest set of a run with times, steps and evidence of all of them."""
    longest = max(run, key=_longest)
    steps = tuple(step for one in run for step in one.steps)
    if len(steps) > ROOM.steps:
        steps = (*steps[: ROOM.steps - 1], steps[-1])
    last_alarms = [one.evidence.last_alarm_s for one in run]
    ratios = [one.evidence.ratio for one in run]
    return replace(
        longest,
        start_s=run[0].start_s,
        since_s=run[0].start_s,
        end_s=run[-1].end_s,
        stands=run[-1].stands,
        steps=steps,
        evidence=replace(
            run[0].evidence,
            ratio=max((one for one in ratios if one is not None), default=None),
            alarms=sum(one.evidence.alarms for one in run),
            last_alarm_s=max(
                (one for one in last_alarms if one is not None), default=None
            ),
        ),
        sets=sum(one.sets for one in run),
        longest_s=_longest(longest),
    )


def _longest(one: Episode) -> float:
    """Return the length of an episode, or of the longest set in it, s."""
    return one.end_s - one.since_s if one.longest_s is None else one.longest_s


def _units_behind(
    episodes: Sequence[Episode], unit_of: Mapping[str, str]
) -> frozenset[str]:
    """Return the units that were in the sets for nearly all of their time, if any."""
    total = 0.0
    by_unit: dict[str, float] = {}
    for one in episodes:
        for step, seconds in _lengths(one):
            total += seconds
            for unit in {unit_of[name] for name in step.channels}:
                by_unit[unit] = by_unit.get(unit, 0.0) + seconds
    return frozenset(
        unit
        for unit, seconds in by_unit.items()
        if unit and seconds >= _LOOSE.share * total
    )


def _lengths(one: Episode) -> Iterator[tuple[Step, float]]:
    """Yield the steps of an episode with their lengths, s."""
    for step, after in pairwise(one.steps):
        yield step, after.at_s - step.at_s
    yield one.steps[-1], one.end_s - one.steps[-1].at_s
