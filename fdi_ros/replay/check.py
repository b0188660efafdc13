# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay must show to pass: ``fdi replay --check 'delay<1 isolated false=0'``, or ``'imu_2.y faulty'``."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.episodes import MOST_TOLD, episode_words
from fdi_ros.replay.summary import Judgement, Outcome
from fdi_ros.replay.words import MOSTLY_JUDGED, unchecked_words

_COMPARED: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "=": operator.eq,
    ">": operator.gt,
    ">=": operator.ge,
}
_TERM = re.compile(r"([^<>=]*)(<=|>=|<|>|=)?(.*)", re.DOTALL)
_FORMS = {
    # Every fault is detected; it is, within so many seconds; it is named by itself, or so within so many seconds.
    "detected": ("",),
    "delay": ("<", "<="),
    "isolated": ("", "<", "<="),
    # Number of declarations that no injected fault explains; number of episodes in which a fault was declared, injected
    # or not; share of the samples that was judged; number of channels that end STALE or UNCHECKED.
    "false": ("<", "<=", "="),
    "declared": ("<", "<=", "="),
    "judged": (">", ">="),
    "unchecked": ("<", "<=", "="),
}
"""How each quantity may be compared with a number; empty: it may stand without one."""
CHANNEL_STATES = ("faulty", "ambiguous", "stale", "ok")
"""What a channel may be asked to have been: declared by itself, in a set, silent; or none of these."""


@dataclass(frozen=True)
class Condition:
    """One condition, as it was written."""

    text: str
    name: str  # of a quantity, or of a state of channels
    sign: str = ""
    bound: float = math.nan
    channels: tuple[str, ...] = ()  # that are asked for: one, or those of a unit; empty: it is about a quantity

    def reasons(self, judgement: Judgement) -> list[str]:
        """Return why it does not hold, one line per reason; empty: it does."""
        if self.channels:
            return [f"{name}: {why}" for name in self.channels if (why := self._of_channel(name, judgement))]
        if self.name in _MEASURES:
            value, words = _MEASURES[self.name](judgement)
            return [] if self._holds(value) else [words]
        if judgement.scores.faults:
            return [why for fault in judgement.scores.faults if (why := self._of_fault(fault))]
        told = judgement.story.declared
        return [episode_words(one) for one in told if one.state != "FAULTY"] if told else ["nothing was declared"]

    def _holds(self, value: float) -> bool:
        return not self.sign or _COMPARED[self.sign](value, self.bound)

    def _of_fault(self, fault: Outcome) -> str:
        """Say why an injected fault does not fulfil it, or nothing."""
        named, when, done = f"{fault.kind} on {fault.channel}", fault.delay_s, "detected"
        if when is None:
            missed = "declared before it began: nothing was left to detect" if fault.declared_before else "not detected"
            return f"{named}: {missed}"
        if self.name == "isolated":
            when, done = fault.isolation_delay_s, "isolated"
        if when is None:
            return f"{named}: detected, not isolated; declared: {', '.join(fault.declared_channels)}"
        return "" if self._holds(when) else f"{named}: {done} after {when:.3f} s"

    def _of_channel(self, channel: str, judgement: Judgement) -> str:
        """Say what was declared of a channel where that is not what was asked for; otherwise nothing."""
        episodes = judgement.story.episodes
        told = {one.state: one for one in episodes if channel in one.channels}
        if self.name == "ambiguous":
            told |= {step.state: one for one in episodes for step in one.steps if channel in step.channels}
        if not told if self.name == "ok" else self.name.upper() in told:
            return ""
        return "; ".join(dict.fromkeys(map(episode_words, told.values()))) or "nothing was declared of it"


_IMPLIED = (
    Condition(f"judged>={MOSTLY_JUDGED:g}", "judged", ">=", MOSTLY_JUDGED),
    Condition("unchecked=0", "unchecked", "=", 0.0),
)
"""What must hold where nothing is said of it."""


def failures(required: Sequence[Condition], judgement: Judgement) -> list[str]:
    """Return why what a monitor made of a recording does not pass, one line per reason; empty: it passes.

    What was mostly not judged does not pass unless the conditions say what is enough, nor do channels that end
    unchecked unless they say how many may.
    """
    named = {one.name for one in required}
    implied = [one for one in _IMPLIED if required and one.name not in named]
    return [f"{one.text}: {why}" for one in (*required, *implied) for why in one.reasons(judgement)]


def _false(judgement: Judgement) -> tuple[float, str]:
    declared = judgement.scores.declared
    told = "; ".join(f"{one.channel} {one.state} at {one.at_s:.3f} s" for one in declared[:5])
    which = "declarations that no injected fault explains" if judgement.scores.faults else "declarations, of channels"
    return len(declared), f"{len(declared)} {which}{f': {told}' if told else ''}"


def _declared(judgement: Judgement) -> tuple[float, str]:
    told = judgement.story.declared
    count = len(told) + judgement.story.more
    words = "; ".join(map(episode_words, told[:MOST_TOLD]))
    return count, f"{count} episode{'s' if count != 1 else ''}{f': {words}' if words else ''}"


def _judged(judgement: Judgement) -> tuple[float, str]:
    judged, samples = judgement.scores.samples_judged, judgement.scores.samples
    share = judged / max(1, samples)
    return share, f"{judged} of {samples} samples were judged, {share:.4f}"


def _unchecked(judgement: Judgement) -> tuple[float, str]:
    lost, total = judgement.unchecked_channels, len(judgement.monitor.channels)
    return len(lost), f"{len(lost)} of {total} channels end unchecked{': ' if lost else ''}{unchecked_words(lost)}"


_MEASURES: dict[str, Callable[[Judgement], tuple[float, str]]] = {
    "false": _false,
    "declared": _declared,
    "judged": _judged,
    "unchecked": _unchecked,
}
"""Value of a quantity of the whole recording, and how it is said; the others are of each injected fault."""


# As it is written -----------------------------------------------------------------------------------------------------


def parse_check(text: str, faults: int, geometry: Geometry | None = None) -> list[Condition]:
    """Read conditions separated by blanks or commas, ``delay<1 isolated false=0``; all must hold.

    ``faults``: how many are injected. ``geometry``: of the monitor, whose channels and units may be asked for.
    `ConfigError` names the part that is wrong and what is allowed.
    """
    parts = re.sub(r"\s*(<=|>=|<|>|=)\s*", r"\1", text).replace(",", " ").split()
    if not parts:
        raise ConfigError(f"--check is empty, expected conditions on: {', '.join(_FORMS)}")
    found: list[Condition] = []
    while parts:
        part = parts.pop(0)
        if parts and parts[0].lower() in CHANNEL_STATES:
            found.append(_on_channel(part, parts.pop(0).lower(), geometry))
            continue
        condition = _on_quantity(part)
        if not faults and condition.name not in _MEASURES and part != "isolated":
            raise ConfigError(
                f"--check: {part!r} is about injected faults, and none is given by --fault; of a recording as it is ask"
                " declared=0, isolated, or CHANNEL faulty"
            )
        found.append(condition)
    return found


def _on_channel(name: str, state: str, geometry: Geometry | None) -> Condition:
    names = geometry.channel_names if geometry else ()
    meant = tuple(one for one in names if one == name or one.startswith(f"{name}."))
    if not meant:
        raise ConfigError(f"--check: {f'{name} {state}'!r} names no channel, expected one of: {', '.join(names)}")
    return Condition(f"{name} {state}", state, channels=meant)


def _on_quantity(part: str) -> Condition:
    match = _TERM.fullmatch(part)
    assert match is not None
    name, sign, number = match[1], match[2] or "", match[3]
    if name not in _FORMS:
        raise ConfigError(f"--check: {part!r} begins with {name!r}, expected one of: {', '.join(_FORMS)}")
    if sign not in _FORMS[name]:
        expected = " or ".join(f"{name}{form}NUMBER" if form else name for form in _FORMS[name])
        what = f"is compared by {sign!r}" if sign else "has no bound"
        raise ConfigError(f"--check: {part!r} {what}, expected {expected}")
    if not sign:
        return Condition(part, name)
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not 0 <= bound < math.inf:
        raise ConfigError(f"--check: {part!r} has the bound {number!r}, expected a number from 0 on")
    # No quantity is below 0, no share above 1, no count a fraction.
    most = 1.0 if name == "judged" else math.inf
    if (sign, bound) in (("<", 0.0), (">", most)) or bound > most or (sign == "=" and bound % 1 != 0):
        raise ConfigError(f"--check: {part!r} can never hold")
    return Condition(part, name, sign, bound)
