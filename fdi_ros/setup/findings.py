# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One table of what was found in a recording: of it come the verdict, the lines for people and the figures in JSON.

And what a recording is fit for: gyros enough, in rad/s, stamped by one clock, each a sensor of its own. These are the
findings of ``fdi inspect``, and the refusals that inspection, set-up, calibration, replay and fleet share.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi_ros.compiling.compiled import MAX_CHANNELS
from fdi_ros.config.config import Config, is_plain_name
from fdi_ros.errors import BagError
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.noise import noisier_words
from fdi_ros.monitor.diagnostics import DIAGNOSTICS
from fdi_ros.monitor.output import OUTPUTS
from fdi_ros.report.layout import RADIANS, Severity, Unit, Verdict, first_of
from fdi_ros.setup.agreement import LEAST_ROTATION
from fdi_ros.setup.inspect import BELIEVED, FASTEST, TopicReport, inspect, troubles
from fdi_ros.setup.noise import LARGEST_BIAS, LENGTH
from fdi_ros.sources import SOURCES
from fdi_ros.system.text import LINE, shown


class Role(str, Enum):
    """What a finding is to the reader; the value is its list in JSON."""

    FOUND = "found"  # what the settings are from
    UNKNOWN = "not_found"  # what the recording does not show, what is taken instead, and how to get it
    WARNING = "warnings"  # what to look at before the settings are trusted
    WORTH = "worth"  # what it is good for: the verdict where nothing is wrong


class Finding(NamedTuple):
    """One thing that was found."""

    role: Role
    what: str  # the quantity or the trouble, in a word or two
    words: str  # the whole of it in one line
    who: Sequence[str] = ()  # channels, units or topics it is about; none: all
    value: float | None = None  # of the quantity, SI; of several channels the worst
    error: float | None = None  # standard error of the value
    bound: float | None = None  # that the value keeps or breaks
    headline: str = ""  # how the verdict begins where this decides it, one of `HEADLINES`; empty: it does not


HEADLINES = {  # of verdicts, the first that is there decides
    "NEEDS": Severity.BAD,
    "NEEDS A LOOK": Severity.BAD,
    "DO NOT USE": Severity.BAD,
    "NO BETTER THAN BEFORE": Severity.UNKNOWN,
    "USABLE, NOT CALIBRATED": Severity.UNKNOWN,
    "USABLE, BUT LOOK": Severity.UNKNOWN,
    "READY, BUT LOOK": Severity.UNKNOWN,
    "USABLE": Severity.GOOD,
    "READY": Severity.GOOD,
}


def lines_of(findings: Iterable[Finding], role: Role) -> list[str]:
    """Return the lines of one kind."""
    return [shown(one.words, LINE) for one in findings if one.role is role]


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict: by the first headline that a finding has, with all that it is of."""
    words: dict[str, list[str]] = {}
    for one in findings:
        words.setdefault(one.headline, []).append(one.words)
    headline = next(headline for headline in HEADLINES if headline in words)
    between = " " if headline == "NEEDS" else ": "
    return Verdict(HEADLINES[headline], f"{headline}{between}{'; '.join(words[headline])}")


def findings_figures(findings: Sequence[Finding]) -> dict[str, object]:
    """Return verdict, lines and table, for programs."""
    first = verdict_of(findings)
    return {
        "verdict": {"severity": first.severity.value, "words": first.words},
        **{role.value: lines_of(findings, role) for role in Role if role is not Role.WORTH},
        "findings": [one._asdict() for one in findings],
    }


# What a recording is fit for ------------------------------------------------------------------------------------------


_CLOCKS = 1.0  # s by which clocks differ: less may be the time that messages take
_OF_A_MONITOR = {topic.name.rpartition("/")[2] for topic in (*(output.topic for output in OUTPUTS), DIAGNOSTICS)}
_PREFERRED = sorted(SOURCES.values(), key=lambda kind: not kind.stamped)  # kinds of input, first those with stamps
NEEDED = ", or ".join(
    f"two {kind.type.rpartition('/')[2]} topics"
    if kind.stamped
    else f"one array of {kind.value_counts.start} to {kind.value_counts.stop - 1} values"
    for kind in _PREFERRED
)
_NAMED = 8  # topics that are named with what is wrong with them


def candidates(reports: Sequence[TopicReport]) -> list[TopicReport]:
    """Return the topics a config is made for: up to four units, else the first array that fits.

    What a monitor itself has published is no sensor: the fused rate must not be its own witness.
    """
    possible = [report for report in reports if not _unusable(report)]
    for kind in _PREFERRED:
        alike = [report for report in possible if report.kind is kind]
        if len(alike) >= kind.topic_counts.start:
            return alike[: kind.topic_counts.stop - 1]
    return []


def clocks_apart(reports: Sequence[TopicReport], beyond: float = _CLOCKS) -> str:
    """Say which units are stamped by clocks so many s and more from the first one's; empty: none is."""
    first = next((report for report in reports if math.isfinite(report.ahead)), None)
    off = [] if first is None else [(shown(report.topic.name), report.ahead - first.ahead) for report in reports]
    words = [f"{name} {abs(v):.6g} s {'ahead' if v > 0 else 'behind'}" for name, v in off if abs(v) > beyond]
    if first is None or not words:
        return ""
    return (
        f"stamps are of other clocks than those of {shown(first.topic.name)}: {', '.join(words)}; no instants can be"
        " compared: let the clocks be one (PTP, chrony), or stamp on arrival"
    )


def _unusable(report: TopicReport) -> str:
    """Say why a topic cannot be used for gyros; empty: it can."""
    kind, received = report.kind, report.received
    if kind is None:
        return "its type carries no gyros"
    # The first that holds is the reason.
    reasons = {
        "no messages": not received,
        "a monitor has published it": report.topic.name.rpartition("/")[2] in _OF_A_MONITOR,
        "no name that ROS allows": not is_plain_name(report.topic.name),
        f"{report.announced} values, not {MIN_CHANNELS} to {MAX_CHANNELS}": not report.channels and not kind.stamped,
        f"all {received} messages are malformed, or have stamps before 1970": report.malformed == received,
        f"no message in which all values are finite and below {BELIEVED:g} rad/s": not report.complete,
        "a single message": received == 1,
        "its times of recording do not increase": not report.rate,
        f"it {_copied(report)}: {_NO_REDUNDANCY}": bool(report.copy_of),
    }
    return next((words for words, holds in reasons.items() if holds), "")


def needs(reports: Sequence[TopicReport]) -> str:
    """Say what a recording needs before a config can be made of it; empty: nothing.

    That is gyros in rad/s, or else what is wrong with each topic that could do.
    """
    if chosen := candidates(reports):
        return in_degrees(chosen)
    why = [(shown(report.topic.name), _unusable(report)) for report in reports if report.kind is not None]
    good = [name for name, words in why if not words]
    bad = [f"{name}: {words}" for name, words in why if words]
    usable = [f"usable: only {', '.join(good)}"] if good else []
    return "; ".join([NEEDED, *usable, *([first_of(bad, _NAMED, "; ", "; and")] if bad else [])])


def recording_findings(reports: Sequence[TopicReport], refused: str = "", unit: Unit = RADIANS) -> Iterator[Finding]:
    """Say what a recording is fit for; refused: why no config can be made of it, where it needs nothing."""
    chosen = candidates(reports)
    lacking, clocks = needs(reports) or refused, clocks_apart(chosen)
    if lacking or clocks:
        words = lacking or f"one clock: {clocks}"
        yield Finding(Role.WARNING, "needs", words, headline="NEEDS")
        return
    if copies := copy_words(reports):
        words = f"{copies}; the copy is left out"
        yield Finding(Role.WARNING, "copy", words, headline="NEEDS A LOOK")
    units = len(chosen) > 1
    names = [f"{shown(one.topic.name)} {place}" for one in chosen for place in one.places]
    groups = np.split(np.arange(len(names)), np.cumsum([one.channels for one in chosen])[:-1] if units else len(names))
    words = f"{len(names)} channels in {f'{len(chosen)} units' if units else 'one array'}"
    words += f" at {max(one.rate for one in chosen):.3g} Hz"
    noise = np.concatenate([one.segments.noise().moving for one in chosen])
    if noisy := noisier_words(names, noise, [group.tolist() for group in groups], unit.name, unit.factor):
        yield Finding(Role.WARNING, "noise", f"{noisy}; {words}", headline="READY, BUT LOOK")
    yield Finding(Role.WORTH, "ready", words, headline="READY")
    yield from topic_findings(chosen, unit)


def topic_findings(chosen: Sequence[TopicReport], unit: Unit = RADIANS) -> Iterator[Finding]:
    """Say what is wrong with the messages of each topic."""
    for one in chosen:
        words = [f"{one.gaps} gaps of up to {one.longest:.2g} s"] if one.gaps else []
        if words := words + troubles(one, unit):
            yield Finding(Role.WARNING, "messages", f"{one.topic.name}: {', '.join(words)}", (one.topic.name,))


def copy_words(reports: Sequence[TopicReport]) -> str:
    """Say which topics give the values of others; empty: none does."""
    copies = [f"{shown(one.topic.name)} {_copied(one)}" for one in reports if one.copy_of]
    return f"{' and '.join(copies)}: {_NO_REDUNDANCY}" if copies else ""


_NO_REDUNDANCY = "one sensor on two topics is no redundancy"


def _copied(report: TopicReport) -> str:
    return f"gives the values of {shown(report.copy_of)}"


# Degrees a second -----------------------------------------------------------------------------------------------------


DEGREES = math.degrees(1.0)
NEAR = 0.2  # a factor this close, relative, to that of a degree may be it: scale factors and vibration differ by less
QUANTILES = (0.5, 0.7, 0.9, 0.97, 0.99)  # of the rates of a unit, that are compared with those of another
FEWEST_QUANTILES = 2  # that must show motion
FAST_SHARE, FAST_TIME, FAST_RANGE = 0.01, 0.5, 2.0
"""Share of the time, or s, beyond every gyro's range: less is a shock or damage. What is deg/s exceeds it by no more
than so many times the factor of a degree."""
STILL, NOISIEST = 0.3, 0.02  # share of a recording that lies still; noise there, rad/s, that no gyro at rest has


def in_degrees(chosen: Sequence[TopicReport], largest_rate: float = FASTEST) -> str:
    """Say which topics, of one body, are in deg/s, and what shows it; empty: nothing does.

    Gyros in rad/s have a range of `largest_rate`.
    """
    chosen = [one for one in chosen if one.complete]
    # The size of the rate: a bias is no rotation.
    apart = [one.segments.means - np.median(one.segments.means, axis=0) for one in chosen]
    rates = [np.quantile(np.linalg.norm(each, axis=1), QUANTILES) for each in apart]
    for (fast_one, fast), (slow_one, slow) in itertools.product(zip(chosen, rates, strict=True), repeat=2):
        moving = (slow > LEAST_ROTATION) & np.isfinite(fast + slow)
        factors = fast[moving] / slow[moving]
        if moving.sum() >= FEWEST_QUANTILES and (np.abs(factors / DEGREES - 1.0) < NEAR).all():
            times = f"{float(np.median(factors)):.3g} times the rotation of {shown(slow_one.topic.name)}"
            return f"rad/s: {shown(fast_one.topic.name)} is in deg/s, it shows {times}"
    if chosen and all(_is_beyond(one, largest_rate) for one in chosen):
        largest = max(one.largest for one in chosen)
        why = f"{largest:.3g} rad/s would be {largest / 2 / math.pi:.2g} turns a second"
    elif chosen and all(map(_no_gyro_at_rest, chosen)):
        noise = max(float(one.segments.noise().quiet.max()) for one in chosen)
        why = f"no gyro at rest has a bias and noise of {noise:.2g} rad/s"
    else:
        return ""
    names = " and ".join(shown(one.topic.name) for one in chosen)
    return f"rad/s: {names} {'is' if len(chosen) == 1 else 'are'} in deg/s, {why}"


def _is_beyond(report: TopicReport, largest_rate: float) -> bool:
    """Whether rates, less than a shock or damage makes, are beyond the range of gyros for long."""
    largest = np.abs(report.segments.means).max(axis=1)
    beyond = largest > largest_rate
    lasting = beyond & (largest < FAST_RANGE * DEGREES * largest_rate)
    seconds = report.segments.every * LENGTH / REST_BLOCKS * float(lasting.sum())
    return bool(beyond.mean() > FAST_SHARE) or seconds > FAST_TIME


def _no_gyro_at_rest(report: TopicReport) -> bool:
    """Whether it lies still, and with more noise and bias than any gyro in rad/s has."""
    noise, segments = report.segments.noise(largest_bias=FASTEST), report.segments.all_segments()
    if noise.share >= 1.0 - STILL or not (report.segments.noise().quiet > NOISIEST).all():
        return False
    still = [one.means.mean(axis=0) for one, lies in zip(segments, noise.rest, strict=True) if lies]
    return bool(np.abs(np.median(still, axis=0)).max() > LARGEST_BIAS)


def refuse_degrees(bag: Path, config: Config) -> list[TopicReport]:
    """Refuse a recording whose gyros, of this config, are in deg/s; return what was seen of their topics.

    `BagError` if it cannot be read, or says which topic is and what shows it.
    """
    chosen = [one for one in inspect(bag, config.topics)[0] if one.channels]
    if words := in_degrees(chosen, max(FASTEST, *config.health.max_rate)):
        raise BagError(f"{bag} needs {words}; mend the driver")
    return chosen
