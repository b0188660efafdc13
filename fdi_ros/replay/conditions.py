# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The language of ``fdi replay --check``: conditions that a replay must fulfil to pass.

Examples: ``'delay<1 isolated false=0'`` and ``'imu_2.y faulty'``.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fdi_ros.errors import ConfigError
from fdi_ros.monitor.soundness import WHOLE
from fdi_ros.replay.episodes import ROOM, episode_words
from fdi_ros.replay.outcomes import Outcome
from fdi_ros.replay.summary import Judgement
from fdi_ros.replay.words import unchecked_words
from fdi_ros.system.text import did_you_mean

_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "=": operator.eq,
    ">": operator.gt,
    ">=": operator.ge,
}
_TERM = re.compile(r"([^<>=]*)(<=|>=|<|>|=)?(.*)", re.DOTALL)
_AT_MOST = ("<", "<=")
_COUNT = (*_AT_MOST, "=")
FAULT_QUANTITIES = {"detected": ("",), "delay": _AT_MOST, "isolated": ("", *_AT_MOST)}
"""Quantities of every injected fault, and the comparisons each allows. An empty comparison
stands for no bound. ``delay`` and ``isolated`` are in seconds from the start of the fault."""
RECORDING_QUANTITIES = {
    "false": _COUNT,
    "declared": _COUNT,
    "judged": (">", ">="),
    "unchecked": _COUNT,
}
"""Quantities of the whole recording, and the comparisons each allows.

``false``: declarations without an injected fault that explains them. ``declared``: episodes
with a declaration, injected or not. ``judged``: share of the samples that was judged.
``unchecked``: channels that end STALE or UNCHECKED.
"""
_QUANTITIES = FAULT_QUANTITIES | RECORDING_QUANTITIES
CHANNEL_STATES = ("faulty", "ambiguous", "stale", "ok")
"""States to ask for: declared alone, declared in a set, silent, none of these."""
_DEFAULTS = (f"judged>={WHOLE.judged:g}", "unchecked=0")
"""Conditions that hold for a quantity that the user does not mention."""


@dataclass(frozen=True)
class Condition:
    """One condition on a replay."""

    text: str
    """The condition as the user wrote it."""
    name: str
    """Name of a quantity, or a state of channels."""
    sign: str = ""
    """Comparison with the bound. Empty for a quantity without a bound."""
    bound: float = math.nan
    """Number on the right-hand side."""
    channels: tuple[str, ...] = ()
    """Channels whose state is asked for. Empty: the condition is about a quantity."""

    def reasons(self, judgement: Judgement) -> list[str]:
        """Return one line for each reason why the condition fails. Empty if it holds."""
        if self.channels:
            return [
                f"{name}: {why}"
                for name in self.channels
                if (why := self._of_channel(name, judgement))
            ]
        if self.name in RECORDING_QUANTITIES:
            value, words = _measure(self.name, judgement)
            return [] if self._holds(value) else [words]
        if judgement.scores.faults:
            return [
                why
                for fault in judgement.scores.faults
                if (why := self._of_fault(fault))
            ]
        told = judgement.story.declared
        return (
            [episode_words(one) for one in told if one.state != "FAULTY"]
            if told
            else ["nothing was declared"]
        )

    def _holds(self, value: float) -> bool:
        return not self.sign or _COMPARISONS[self.sign](value, self.bound)

    def _of_fault(self, fault: Outcome) -> str:
        """Return why an injected fault fails the condition. Empty if it holds."""
        name = f"{fault.kind} on {fault.channel}"
        if fault.delay_s is None:
            if fault.declared_before:
                return (
                    f"{name}: its channel was already declared before the fault began"
                )
            return f"{name}: not detected"
        isolation = self.name == "isolated"
        delay = fault.isolation_delay_s if isolation else fault.delay_s
        if delay is None:
            declared = ", ".join(fault.declared_channels)
            return f"{name}: detected, not isolated; declared: {declared}"
        if self._holds(delay):
            return ""
        return f"{name}: {'isolated' if isolation else 'detected'} after {delay:.3f} s"

    def _of_channel(self, channel: str, judgement: Judgement) -> str:
        """Return what was declared of a channel if the condition fails. Empty if it holds."""
        episodes = judgement.story.episodes
        by_state = {one.state: one for one in episodes if channel in one.channels}
        if self.name == "ambiguous":
            for one in episodes:
                for step in one.steps:
                    if channel in step.channels:
                        by_state[step.state] = one
        met = not by_state if self.name == "ok" else self.name.upper() in by_state
        if met:
            return ""
        words = dict.fromkeys(map(episode_words, by_state.values()))
        return "; ".join(words) or "nothing was declared"


def _measure(name: str, judgement: Judgement) -> tuple[float, str]:
    """Return the value of a quantity of the recording, and a sentence with it."""
    scores = judgement.scores
    story = judgement.story
    if name == "judged":
        share = scores.samples_judged / max(1, scores.samples)
        return (
            share,
            f"{scores.samples_judged} of {scores.samples} samples were judged, {share:.4f}",
        )
    if name == "unchecked":
        lost = judgement.unchecked_channels
        total = len(judgement.monitor.channels)
        return (
            len(lost),
            f"{len(lost)} of {total} channels end unchecked{': ' if lost else ''}{unchecked_words(lost)}",
        )
    if name == "declared":
        count = len(story.declared) + story.more
        listed = [episode_words(one) for one in story.declared[: ROOM.episodes]]
        what = f"episode{'s' if count != 1 else ''}"
    else:
        count = len(scores.declared)
        listed = [
            f"{one.channel} {one.state} at {one.at_s:.3f} s"
            for one in scores.declared[: ROOM.episodes]
        ]
        what = "declarations" + (
            " without an injected fault that explains them" if scores.faults else ""
        )
    return count, f"{count} {what}{': ' if listed else ''}{'; '.join(listed)}"


def failures(required: Sequence[Condition], judgement: Judgement) -> list[str]:
    """Return one line for each reason why a replay does not pass. Empty if it passes.

    A recording must be judged for at least half of its samples, and no channel may end
    unchecked, unless a condition sets another bound.
    """
    if not required:
        return []
    named = {one.name for one in required}
    defaults = [one for one in map(_on_quantity, _DEFAULTS) if one.name not in named]
    return [
        f"{one.text}: {why}"
        for one in (*required, *defaults)
        for why in one.reasons(judgement)
    ]


def parse_check(text: str, faults: int, names: Sequence[str] = ()) -> list[Condition]:
    """Read conditions separated by blanks or commas. All must hold.

    Parameters
    ----------
    text
        The conditions: ``delay<1 isolated false=0``.
    faults
        Number of injected faults.
    names
        Names of the channels that a condition may name, alone or by their unit.

    Returns
    -------
    The conditions in order. `ConfigError` quotes the wrong part and what is allowed.
    """
    parts = re.sub(r"\s*(<=|>=|<|>|=)\s*", r"\1", text).replace(",", " ").split()
    if not parts:
        raise ConfigError(
            f"--check is empty, expected conditions on: {', '.join(_QUANTITIES)}"
        )
    found: list[Condition] = []
    while parts:
        part = parts.pop(0)
        if parts and parts[0].lower() in CHANNEL_STATES:
            text = f"{part} {parts[0].lower()}"
            meant = _channels_meant(part, names)
            if not meant:
                is_force = "accel" in part
                offered = [one for one in names if (".accel" in one) == is_force]
                hint = did_you_mean(part, offered or names)
                raise ConfigError(f"--check: {text!r} names no channel, {hint}")
            found.append(Condition(text, parts.pop(0).lower(), channels=meant))
            continue
        condition = _on_quantity(part)
        if not faults and condition.name in FAULT_QUANTITIES and part != "isolated":
            raise ConfigError(
                f"--check: {part!r} is about injected faults, and --fault gives none; without faults"
                " use declared=0, isolated, or CHANNEL faulty"
            )
        found.append(condition)
    return found


def _channels_meant(part: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return a channel, or those of a unit, as in a fault: its gyros, or its accelerometers."""
    forces = f"{part}_" if part.endswith(".accel") else ""
    return tuple(
        name
        for name in names
        if name == part
        or (forces and name.startswith(forces))
        or (name.startswith(f"{part}.") and not name.startswith(f"{part}.accel_"))
    )


def _on_quantity(part: str) -> Condition:
    match = _TERM.fullmatch(part)
    assert match is not None
    name = match[1]
    sign = match[2] or ""
    number = match[3]
    if name not in _QUANTITIES:
        raise ConfigError(
            f"--check: unknown condition {part!r}, {did_you_mean(name, tuple(_QUANTITIES))};"
            " or a channel and its state: 'imu_2.y faulty'"
        )
    if sign not in _QUANTITIES[name]:
        expected = " or ".join(
            f"{name}{form}NUMBER" if form else name for form in _QUANTITIES[name]
        )
        raise ConfigError(f"--check: expected {expected}, not {part!r}")
    if not sign:
        return Condition(part, name)
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not 0 <= bound < math.inf:
        raise ConfigError(
            f"--check: {part!r} has the bound {number!r}, expected a number from 0 on"
        )
    # Quantities are at least 0, the share at most 1, and counts are whole.
    most = 1.0 if name == "judged" else math.inf
    if (
        (sign, bound) in (("<", 0.0), (">", most))
        or bound > most
        or (sign == "=" and bound % 1 != 0)
    ):
        raise ConfigError(f"--check: {part!r} can never hold")
    return Condition(part, name, sign, bound)
