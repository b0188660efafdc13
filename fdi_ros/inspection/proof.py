# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings proved on what they were not made from: what is declared there, and which biases are isolated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.model.block import Block
from fdi_ros.scoring import Outcome
from fdi_ros.sweep.plan import Plan, parse_swept
from fdi_ros.sweep.sweep import MonitorResult, Sound, Subject, monitor_of, sweep, watch_sound

SIZES = (0.03, 0.1, 0.3)
"""Biases tried, rad/s."""
WITHIN, TIMES = 4.0, 2
"""s in which they are to be isolated, and how often each is tried."""
WORSE = 0.08
"""Less in the share of biases isolated is chance, and so is one bias."""
KEPT, LEAST_KEPT, MOST_KEPT = 0.25, 8.0, 120.0
"""Part of a recording that is kept aside, and its bounds, s."""
GAP = 3.0
"""Intervals longer than this many usual ones are gaps."""
LEAST_LEFT = 20.0
"""s that must be left to calibrate on."""


@dataclass(frozen=True)
class Tried:
    """One config on the recording of a proof."""

    channels: tuple[str, ...]
    sound: Sound | None
    """As it is; None: the monitor judges nothing."""
    note: str
    isolated: dict[float, tuple[int, int]]
    """By size, rad/s: biases isolated, and all that were tried; empty: it is too short for any."""

    @property
    def declared(self) -> tuple[str, ...]:
        """Channels declared, without a fault, and when first."""
        first: dict[str, float] = {}
        for at, event in self.sound.declared if self.sound is not None else ():
            first.setdefault(self.channels[event.channel], at)
        return tuple(f"{name} at {at:.1f} s" for name, at in first.items())

    @property
    def words(self) -> str:
        """In a sentence."""
        if self.sound is None:
            return f"judges NOTHING: {self.note}"
        names = self.declared
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        what = f"declares {', '.join(names[:3])}{more}" if names else "declares nothing"
        sizes = [f"{size:g} rad/s {good / all_of:.0%}" for size, (good, all_of) in self.isolated.items() if all_of]
        shares = f"; of biases isolates in {WITHIN:g} s: {', '.join(sizes)}" if sizes else ""
        return f"{what}{shares}"


@dataclass(frozen=True)
class Proof:
    """What a recording, or a part of one, says of the settings."""

    source: str
    """Which, in words."""
    apart: bool
    """Whether it was not used for the settings."""
    seconds: float
    before: Tried
    after: Tried

    @property
    def worse(self) -> str:
        """Which biases the settings before isolate clearly more often; empty: none."""
        words = []
        for size, (good, all_of) in self.after.isolated.items():
            before, of = self.before.isolated.get(size, (0, 0))
            if of and all_of and before / of - good / all_of > max(WORSE, 1.5 / all_of):
                words.append(f"{size:g} rad/s {before / of:.0%} against {good / all_of:.0%}")
        return ", ".join(words)


def kept_from(block: Block) -> tuple[float, float]:
    """Time from which a recording is kept aside, s from its first sample, and how much that is, gaps not counted.

    Zero: it is too short for that.
    """
    if len(block) < 2:
        return 0.0, 0.0
    steps = np.diff(block.stamp) * 1e-9
    lasts = np.cumsum(np.minimum(steps, GAP * np.median(steps)))
    kept = float(np.clip(KEPT * lasts[-1], LEAST_KEPT, MOST_KEPT))
    if lasts[-1] - kept < LEAST_LEFT:
        return 0.0, 0.0
    return float(np.cumsum(steps)[np.searchsorted(lasts, lasts[-1] - kept)]), kept


def prove(path: Path, start: float, end: float, source: str, apart: bool, before: Config, after: Config) -> Proof:
    """Replay a part of a recording, from and to s, with the settings before and after."""
    faults = tuple(one for size in SIZES for one in parse_swept(f"kind=bias size={size:g}"))
    plan = Plan(faults, TIMES, WITHIN)
    tried = [_tried(path, start, end, config, plan) for config in (before, after)]
    seconds = max((one.sound.duration for one in tried if one.sound is not None), default=0.0)
    return Proof(source, apart, seconds, *tried)


def _tried(path: Path, start: float, end: float, config: Config, plan: Plan) -> Tried:
    # Delays are taken off as it is read.
    block = read_block(path, config, start, end)
    try:
        (one,) = sweep([Subject("settings", config, block)], plan)
        return Tried(one.channels, one.sound, one.refused, _isolated(one))
    except FdiError as error:
        pipeline = monitor_of(config)
        pipeline.restart()
        sound = watch_sound(pipeline, block)
        return Tried(pipeline.channel_names, sound if sound.judged else None, sound.note or str(error), {})


def _isolated(one: MonitorResult) -> dict[float, tuple[int, int]]:
    found = {}
    for size in SIZES:
        outcomes = [t.scored.outcome for t in one.trials if t.swept.size == size]
        # Where a channel stands declared without a fault, nothing is tried, and nothing would be found.
        missed = len(one.skipped) * len(one.used)
        found[size] = (sum(o is Outcome.ISOLATED for o in outcomes), len(outcomes) + missed)
    return found
