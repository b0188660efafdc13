# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay must show to pass: ``fdi replay --check 'delay<1 isolated false=0'``, or ``'imu_2.y faulty'``."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fdi_ros.episodes.words import MOST_TOLD, episode_words
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.summary import FaultResult, Summary
from fdi_ros.replay.text import MOSTLY_JUDGED, unchecked_words

_BELOW = {"<": operator.lt, "<=": operator.le}
_ABOVE = {">": operator.gt, ">=": operator.ge}
_COUNT: dict[str, Callable[[float, float], bool]] = {**_BELOW, "=": operator.eq}
_TERM = re.compile(r"([^<>=]*)(<=|>=|<|>|=)?(.*)", re.DOTALL)


def _false_declarations(summary: Summary) -> tuple[float, str]:
    declared = summary.scores.declared
    told = "; ".join(f"{one.channel} {one.state} at {one.at_s:.3f} s" for one in declared[:5])
    which = "declarations that no injected fault explains" if summary.scores.faults else "declarations, of channels"
    return len(declared), f"{len(declared)} {which}{f': {told}' if told else ''}"


def _episodes(summary: Summary) -> tuple[float, str]:
    told = summary.story.declared
    count = len(told) + summary.story.more
    words = "; ".join(episode_words(one) for one in told[:MOST_TOLD])
    return count, f"{count} episode{'s' if count != 1 else ''}{f': {words}' if words else ''}"


def _judged_share(summary: Summary) -> tuple[float, str]:
    judged, samples = summary.scores.samples_judged, summary.scores.samples
    share = judged / max(1, samples)
    return share, f"{judged} of {samples} samples were judged, {share:.4f}"


def _unchecked(summary: Summary) -> tuple[float, str]:
    lost, total = summary.unchecked_channels, len(summary.monitor.channels)
    return len(lost), f"{len(lost)} of {total} channels end unchecked{': ' if lost else ''}{unchecked_words(lost)}"


class Quantity(NamedTuple):
    """Something that a check can ask for."""

    compared: Mapping[str, Callable[[float, float], bool]]
    alone: bool
    """It may stand without a number."""
    measure: Callable[[Summary], tuple[float, str]] | None
    """Its value and how it is said; None: it is of each injected fault."""


QUANTITIES = {
    # Every fault is detected; it is, within so many seconds; it is named by itself, or so within so many seconds.
    "detected": Quantity({}, True, None),
    "delay": Quantity(_BELOW, False, None),
    "isolated": Quantity(_BELOW, True, None),
    # Number of declarations that no injected fault explains; share of the samples that was judged; number of channels
    # that end STALE or UNCHECKED.
    "false": Quantity(_COUNT, False, _false_declarations),
    # Number of episodes in which a fault was declared, injected or not.
    "declared": Quantity(_COUNT, False, _episodes),
    "judged": Quantity(_ABOVE, False, _judged_share),
    "unchecked": Quantity(_COUNT, False, _unchecked),
}
"""Every quantity by name."""


CHANNEL_STATES = ("faulty", "ambiguous", "stale", "ok")
"""What a channel may be asked to have been: declared by itself, in a set, silent; or none of these."""


@dataclass(frozen=True)
class ChannelRequirement:
    """A condition on a channel of a recording, whether a fault was injected or not."""

    text: str
    channels: tuple[str, ...]
    """One, or those of a unit."""
    state: str

    def failures(self, summary: Summary) -> list[str]:
        """Return why a replay does not fulfil it, one line per channel."""
        lines = []
        for name in self.channels:
            episodes = summary.story.episodes
            told = {one.state: one for one in episodes if name in one.channels}
            if self.state == "ambiguous":
                told |= {step.state: one for one in episodes for step in one.steps if name in step.channels}
            if not told if self.state == "ok" else self.state.upper() in told:
                continue
            words = (
                "; ".join(dict.fromkeys(episode_words(one) for one in told.values())) or "nothing was declared of it"
            )
            lines.append(f"{self.text}: {name}: {words}")
        return lines


@dataclass(frozen=True)
class Requirement:
    """One condition, as it was written."""

    text: str
    name: str
    compare: Callable[[float, float], bool] | None = None
    bound: float = 0.0

    def failures(self, summary: Summary) -> list[str]:
        """Return why the summary of a replay does not fulfil it, one line per reason."""
        measure = QUANTITIES[self.name].measure
        if measure is None and not summary.scores.faults:
            told = summary.story.declared
            short = [f"{self.text}: {episode_words(one)}" for one in told if one.state != "FAULTY"]
            return short if told else [f"{self.text}: nothing was declared"]
        if measure is None:
            return [f"{self.text}: {why}" for fault in summary.scores.faults if (why := self._of_fault(fault))]
        value, words = measure(summary)
        return [f"{self.text}: {words}"] if self.compare and not self.compare(value, self.bound) else []

    def _of_fault(self, fault: FaultResult) -> str:
        """Say why a fault does not fulfil it, or nothing."""
        named, when = f"{fault.kind} on {fault.channel}", fault.delay_s
        if when is None:
            missed = "declared before it began: nothing was left to detect" if fault.declared_before else "not detected"
            return f"{named}: {missed}"
        done = "detected"
        if self.name == "isolated":
            done, when = "isolated", fault.isolation_delay_s
        if when is None:
            return f"{named}: detected, not isolated; declared: {', '.join(fault.declared_channels)}"
        if self.compare is None or self.compare(when, self.bound):
            return ""
        return f"{named}: {done} after {when:.3f} s"


Condition = Requirement | ChannelRequirement
"""One that must hold."""
_IMPLIED = (
    Requirement(f"judged>={MOSTLY_JUDGED:g}", "judged", operator.ge, MOSTLY_JUDGED),
    Requirement("unchecked=0", "unchecked", operator.eq, 0.0),
)
"""What must hold where the requirements say nothing of it."""


def parse_check(text: str, faults: int, geometry: Geometry | None = None) -> list[Condition]:
    """Read conditions separated by blanks or commas; all must hold.

    Parameters
    ----------
    text
        ``delay<1 isolated false=0``.
    faults
        Number of faults that are injected.
    geometry
        Of the monitor: its channels and units may be asked for.

    Raises
    ------
    ConfigError
        Naming the part that is wrong and what is allowed.
    """
    parts = re.sub(r"\s*(<=|>=|<|>|=)\s*", r"\1", text).replace(",", " ").split()
    if not parts:
        raise ConfigError(f"--check is empty, expected conditions on: {', '.join(QUANTITIES)}")
    found: list[Condition] = []
    while parts:
        part = parts.pop(0)
        if parts and parts[0].lower() in CHANNEL_STATES:
            found.append(_of_channel(part, parts.pop(0).lower(), geometry))
            continue
        requirement = _parsed(part)
        of_faults = QUANTITIES[requirement.name].measure is None
        if of_faults and not faults and (requirement.name != "isolated" or requirement.compare):
            raise ConfigError(
                f"--check: {part!r} is about injected faults, and none is given by --fault; of a recording as it is ask"
                " declared=0, isolated, or CHANNEL faulty"
            )
        found.append(requirement)
    return found


def _of_channel(name: str, state: str, geometry: Geometry | None) -> ChannelRequirement:
    names = geometry.channel_names if geometry else ()
    own = tuple(one for one in names if one == name or one.startswith(f"{name}."))
    if not own:
        raise ConfigError(f"--check: {f'{name} {state}'!r} names no channel, expected one of: {', '.join(names)}")
    return ChannelRequirement(f"{name} {state}", own, state)


def _parsed(part: str) -> Requirement:
    match = _TERM.fullmatch(part)
    assert match is not None
    name, sign, number = match.groups()
    if name not in QUANTITIES:
        raise ConfigError(f"--check: {part!r} begins with {name!r}, expected one of: {', '.join(QUANTITIES)}")
    quantity = QUANTITIES[name]
    if sign is None:
        if quantity.alone:
            return Requirement(part, name)
        raise ConfigError(f"--check: {part!r} has no bound, expected {_forms(name)}")
    if sign not in quantity.compared:
        raise ConfigError(f"--check: {part!r} is compared by {sign!r}, expected {_forms(name)}")
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not 0 <= bound < math.inf:
        raise ConfigError(f"--check: {part!r} has the bound {number!r}, expected a number from 0 on")
    if _never(name, sign, bound):
        raise ConfigError(f"--check: {part!r} can never hold")
    return Requirement(part, name, quantity.compared[sign], bound)


def _never(name: str, sign: str, bound: float) -> bool:
    """Whether no replay can fulfil a condition: no quantity is below 0, no share above 1, no count a fraction."""
    if name == "judged":
        return bound > 1 or (sign == ">" and bound == 1)
    return (sign == "<" and bound == 0) or (sign == "=" and bound % 1 != 0)


def _forms(name: str) -> str:
    quantity = QUANTITIES[name]
    forms = [name] if quantity.alone else []
    return " or ".join([*forms, *(f"{name}{sign}NUMBER" for sign in quantity.compared)])


def failures(requirements: Sequence[Condition], summary: Summary) -> list[str]:
    """Return why the summary of a replay does not pass, one line per reason; empty: it passes.

    What was mostly not judged does not pass unless the requirements say what is enough, nor do channels that end
    unchecked unless they say how many may.
    """
    named = {requirement.name for requirement in requirements if isinstance(requirement, Requirement)}
    asked = [*requirements, *(one for one in _IMPLIED if requirements and one.name not in named)]
    return [line for requirement in asked for line in requirement.failures(summary)]
