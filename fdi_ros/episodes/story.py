# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What happened in a recording, as values: stretches between gaps, and in each the episodes, one per fault told.

Each stretch is judged for itself: what was declared or suspected before is forgotten (``Pipeline.reset``), as an
operator does between two flights. Biases stay: the sensors are the same, and a fault that is still there is to be seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fdi_ros.episodes.size import Size
from fdi_ros.model.samples import Block

GAP = 10.0
"""Samples further apart than this are of two stretches, s. Shorter holes are part of one: messages were lost."""
HOLE = 1.0
"""A fault is not injected where samples are missing for longer than this while it is watched, s."""


class Stretches:
    """Cuts the blocks of a stream where a new stretch begins."""

    def __init__(self) -> None:
        self._last: int | None = None

    def cut(self, block: Block) -> Iterator[tuple[bool, Block]]:
        """Yield the parts of the next block, and of each whether a new stretch begins with it; never the first."""
        if not len(block):
            yield False, block
            return
        before = block.stamp[:1] if self._last is None else np.array([self._last])
        far = np.diff(np.concatenate([before, block.stamp])) > GAP * 1e9
        self._last = int(block.stamp[-1])
        edges = [0, *np.flatnonzero(far).tolist(), len(block)]
        for begin, end in pairwise(edges):
            if end > begin:
                yield bool(far[begin]), block[begin:end]


def pieces(stamp: NDArray[np.int64], longest: float = HOLE) -> list[slice]:
    """Return the rows of stamps (N,), ns, in pieces without an interval longer than this, s."""
    cuts = (np.flatnonzero(np.diff(stamp) > longest * 1e9) + 1).tolist()
    edges = [0, *cuts, len(stamp)]
    return [slice(begin, end) for begin, end in pairwise(edges) if end > begin]


DECLARED = ("FAULTY", "AMBIGUOUS")
"""States of an episode in which a fault was declared; in one that is STALE channels gave nothing."""


@dataclass(frozen=True)
class Step:
    """Who was declared how from a time on, within an episode."""

    at_s: float
    """s from the first message."""
    state: str
    """FAULTY: every one of the channels; AMBIGUOUS: one of them; STALE: they give nothing."""
    channels: tuple[str, ...]
    who: str
    """The channels in words."""


@dataclass(frozen=True)
class Candidate:
    """A channel that would explain what was seen, and how large its error then was."""

    channel: str
    axis: str
    """Of the body: x, -y, or a direction."""
    size: Size | None
    """None: the others do not tell."""


@dataclass(frozen=True)
class Apart:
    """Two channels that alone measure one axis, and by how much they differ."""

    channels: tuple[str, ...]
    who: str
    """The two in words."""
    size: Size


@dataclass(frozen=True)
class RateMeanwhile:
    """What the fused rate did during an episode."""

    published: float
    """Share of the samples with a rate."""
    std_before_rad_s: float | None
    """Root of the trace of its covariance half a second before; None: there was no rate."""
    std_rad_s: float | None
    """The same on average during the episode."""
    level_rad_s: float | None
    """Largest protection level of an axis meanwhile; None: there was a sample without one."""


@dataclass(frozen=True)
class Evidence:
    """What the declaration rests on."""

    reason: str
    ratio: float | None
    """Largest statistic, as a share of its threshold; None: no sample was judged."""
    alarms: int
    """Samples with an alarm."""
    last_alarm_s: float | None
    """Last sample with an alarm, s from the first message."""


@dataclass(frozen=True)
class Episode:
    """A fault as the monitor told of it, from its first declaration on; times in s from the first message."""

    stretch: int
    """Number of the stretch it lies in, from 1."""
    state: str
    """What it came to: FAULTY, AMBIGUOUS or STALE."""
    channels: tuple[str, ...]
    """All that are FAULTY or STALE; AMBIGUOUS: of which one is, as far as the evidence went."""
    who: str
    """The channels in words."""
    start_s: float
    since_s: float
    """Since when it has been these channels, in this state."""
    end_s: float
    """When nothing of it stood any more, or the end of the stretch."""
    stands: bool
    """It stood at the end of the stretch."""
    steps: tuple[Step, ...]
    """How it came to that, the last one included."""
    candidates: tuple[Candidate, ...]
    """What explains it: the channels above, and how large their errors were; one by one."""
    apart: Apart | None
    """AMBIGUOUS, where two channels alone measure an axis: the two that surely differ, and by how much."""
    evidence: Evidence
    rate: RateMeanwhile
    words: str = ""
    """The whole in one sentence."""
    injected: tuple[str, ...] = ()
    """Injected faults that explain it."""

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

    start_s: float
    """s from the first message."""
    end_s: float
    samples: int
    judged: int
    """Samples that were judged."""
    watched_s: float
    """Time that was judged while nothing stood declared, s."""


@dataclass(frozen=True)
class Story:
    """All that happened in a recording."""

    stretches: tuple[Stretch, ...]
    episodes: tuple[Episode, ...]
    """In the order of time; the first ones where there are very many."""
    more: int = 0
    """Episodes beyond these."""

    @property
    def declared(self) -> list[Episode]:
        """Episodes in which a fault was declared."""
        return [one for one in self.episodes if one.declares]

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Begin and end of what lies between the stretches, s from the first message."""
        return [(a.end_s, b.start_s) for a, b in zip(self.stretches, self.stretches[1:], strict=False)]


NOTHING_HAPPENED = Story((), ())
"""Of a recording without samples."""


@dataclass
class Shared:
    """One thing that happened, as each monitor told of it."""

    told: dict[str, Episode] = field(default_factory=dict)
    """By monitor; who is not in it said nothing of it."""

    @property
    def start_s(self) -> float:
        """Of the first declaration by any of them, s from the first message."""
        return min(one.start_s for one in self.told.values())

    def is_about(self, one: Episode) -> bool:
        """Whether an episode of another monitor may be this: the same stretch, and a channel in common."""
        return any(one.stretch == known.stretch and not one.ever.isdisjoint(known.ever) for known in self.told.values())


def shared_episodes(stories: Mapping[str, Story]) -> list[Shared]:
    """Put together what several monitors declared, in the order of time.

    Each episode joins the first thing that happened before it, that is about a channel of its own and of which its
    monitor has not told yet.
    """
    found: list[Shared] = []
    episodes = [(one.start_s, one, name) for name, story in stories.items() for one in story.declared]
    for _, one, name in sorted(episodes, key=lambda entry: entry[0]):
        place = next((shared for shared in found if name not in shared.told and shared.is_about(one)), None)
        if place is None:
            place = Shared()
            found.append(place)
        place.told[name] = one
    return sorted(found, key=lambda shared: shared.start_s)


def brief(one: Episode | None) -> str:
    """Say in a few words what a monitor declared: who, how and when."""
    if one is None:
        return "-"
    who = one.who if one.state == "FAULTY" else one.who.removesuffix(",")
    return f"{who} {one.state} {one.since_s:.3f} s"
