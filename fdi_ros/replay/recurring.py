# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets that come and go are one fault: of a loose unit, or of one with a bad contact.

The error of a unit that oscillates in its mounting changes its sign, so evidence for a
single channel does not last. The monitor declares a set of the unit, withdraws it, and
declares it again, for as long as the unit is loose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from fdi_ros.replay.episodes import MOST_STEPS, Episode, Step, episode_words

RECURS_WITHIN = 2.0
"""Longest time between two sets of one fault, s: some swings of a loose unit."""
LEAST_SETS = 3
"""Number of sets that are told as one. Two may be two faults."""
EXPLAINS = 0.9
"""Share of the time of all sets for which a unit must have been in them to explain them.
As evidence fades, a set may be one of healthy channels for some samples."""


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


def _recurs(run: Sequence[Episode], one: Episode, unit_of: Mapping[str, str]) -> bool:
    """Whether an episode continues a run of sets that the same units explain."""
    last = run[-1]
    return (
        (last.state, one.state) == ("AMBIGUOUS", "AMBIGUOUS")
        and last.stretch == one.stretch
        and 0.0 <= one.start_s - last.end_s <= RECURS_WITHIN
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
    if len(run) < LEAST_SETS or not own:
        return run
    widest = max(own, key=lambda step: len(step.channels))
    longest = max(run, key=lambda one: one.end_s - one.since_s)
    steps = [step for one in run for step in one.steps]
    last_alarms = [one.evidence.last_alarm_s for one in run]
    ratios = [one.evidence.ratio for one in run]
    whole = replace(
        longest,
        channels=widest.channels,
        who=widest.who,
        start_s=run[0].start_s,
        since_s=run[0].start_s,
        end_s=run[-1].end_s,
        stands=run[-1].stands,
        steps=(*steps[: MOST_STEPS - 1], steps[-1]),
        candidates=tuple(
            one for one in longest.candidates if one.channel in widest.channels
        ),
        evidence=replace(
            run[0].evidence,
            ratio=max((one for one in ratios if one is not None), default=None),
            alarms=sum(one.evidence.alarms for one in run),
            last_alarm_s=max(
                (one for one in last_alarms if one is not None), default=None
            ),
        ),
        sets=len(run),
        longest_s=longest.end_s - longest.since_s,
    )
    return [replace(whole, words=episode_words(whole))]


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
        if unit and seconds >= EXPLAINS * total
    )


def _lengths(one: Episode) -> Iterator[tuple[Step, float]]:
    """Yield the steps of an episode with their lengths, s."""
    for step, after in pairwise(one.steps):
        yield step, after.at_s - step.at_s
    yield one.steps[-1], one.end_s - one.steps[-1].at_s
