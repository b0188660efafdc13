# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a recording is fit for (gyros enough, in rad/s, of one clock, each by itself), and a config to start from.

These are the findings of ``fdi inspect``, and refusals that inspection, set-up, calibration, replay and fleet share.
All that is found stands in one table: of it come the verdict, the lines for people and the figures in JSON.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.compiling.compiled import MAX_CHANNELS
from fdi_ros.config.config import (
    MIN_LEARNED,
    PARAMETERS,
    Config,
    is_plain_name,
    parameter_file,
)
from fdi_ros.core.alignment import MAX_BRIDGE
from fdi_ros.core.sources import SOURCES, input_of
from fdi_ros.errors import BagError
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.noise import noisier_words
from fdi_ros.monitor.diagnostics import DIAGNOSTICS
from fdi_ros.monitor.output import OUTPUTS
from fdi_ros.report.layout import DEGREES, RADIANS, Severity, Unit, Verdict, first_of
from fdi_ros.setup.agreement import (
    LEAST_ROTATION,
    LEAST_WINDOWS,
    SHARED,
    SQUARE,
    angle_of,
    find_turn,
)
from fdi_ros.setup.blocks import WINDOW
from fdi_ros.setup.inspect import BELIEVED, FASTEST, GAP, TopicReport, inspect, troubles
from fdi_ros.setup.noise import LARGEST_BIAS, LENGTH
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
    return Verdict(
        HEADLINES[headline], f"{headline}{between}{'; '.join(words[headline])}"
    )


def findings_figures(findings: Sequence[Finding]) -> dict[str, object]:
    """Return verdict, lines and table, for programs."""
    first = verdict_of(findings)
    return {
        "verdict": {"severity": first.severity.value, "words": first.words},
        **{
            role.value: lines_of(findings, role)
            for role in Role
            if role is not Role.WORTH
        },
        "findings": [one._asdict() for one in findings],
    }


# What a recording is fit for ------------------------------------------------------------------------------------------


_OF_A_MONITOR = {
    topic.name.rpartition("/")[2]
    for topic in (*(output.topic for output in OUTPUTS), DIAGNOSTICS)
}
_PREFERRED = sorted(
    SOURCES.values(), key=lambda kind: not kind.stamped
)  # kinds of input, first those with stamps
NEEDED = ", or ".join(
    f"two {kind.type.rpartition('/')[2]} topics"
    if kind.stamped
    else f"one array of {kind.value_counts.start} to {kind.value_counts.stop - 1} values"
    for kind in _PREFERRED
)


def candidates(reports: Sequence[TopicReport]) -> list[TopicReport]:
    """Return the topics a config is made for: up to four units, else the first array that fits."""
    possible = [report for report in reports if not _unusable(report)]
    for kind in _PREFERRED:
        alike = [report for report in possible if report.kind is kind]
        if len(alike) >= kind.topic_counts.start:
            return alike[: kind.topic_counts.stop - 1]
    return []


def clocks_apart(reports: Sequence[TopicReport], beyond: float = 1.0) -> str:
    """Say which units are stamped by clocks more than so many s off the first one's; empty: none is.

    Less than 1 s may be the time that messages take.
    """
    first = next((report for report in reports if math.isfinite(report.ahead)), None)
    off = (
        []
        if first is None
        else [
            (shown(report.topic.name), report.ahead - first.ahead) for report in reports
        ]
    )
    words = [
        f"{name} {abs(v):.6g} s {'ahead' if v > 0 else 'behind'}"
        for name, v in off
        if abs(v) > beyond
    ]
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
        # The fused rate must not be its own witness.
        "a monitor has published it": report.topic.name.rpartition("/")[2]
        in _OF_A_MONITOR,
        "no name that ROS allows": not is_plain_name(report.topic.name),
        f"{report.announced} values, not {MIN_CHANNELS} to {MAX_CHANNELS}": not report.channels
        and not kind.stamped,
        f"all {received} messages are malformed, or have stamps before 1970": report.malformed
        == received,
        f"no message in which all values are finite and below {BELIEVED:g} rad/s": not report.complete,
        "a single message": received == 1,
        "its times of recording do not increase": not report.rate,
        f"it {report.copied}: {_NO_REDUNDANCY}": bool(report.copy_of),
    }
    return next((words for words, holds in reasons.items() if holds), "")


def needs(reports: Sequence[TopicReport]) -> str:
    """Say what a recording needs, and what is wrong with each topic that could do; empty: a config can be made."""
    if chosen := candidates(reports):
        return in_degrees(chosen)
    why = [
        (shown(report.topic.name), _unusable(report))
        for report in reports
        if report.kind is not None
    ]
    good = [name for name, words in why if not words]
    bad = [f"{name}: {words}" for name, words in why if words]
    usable = [f"usable: only {', '.join(good)}"] if good else []
    return "; ".join(
        [NEEDED, *usable, *([first_of(bad, 8, "; ", "; and")] if bad else [])]
    )


def recording_findings(
    reports: Sequence[TopicReport], refused: str = "", unit: Unit = RADIANS
) -> Iterator[Finding]:
    """Say what a recording is fit for; refused: why no config can be made of it, where it needs nothing."""
    chosen = candidates(reports)
    lacking, clocks = needs(reports) or refused, clocks_apart(chosen)
    if lacking or clocks:
        words = lacking or f"one clock: {clocks}"
        yield Finding(Role.WARNING, "needs", words, headline="NEEDS")
        return
    if copies := copy_words(reports):
        yield Finding(
            Role.WARNING,
            "copy",
            f"{copies}; the copy is left out",
            headline="NEEDS A LOOK",
        )
    units = len(chosen) > 1
    names = [
        f"{shown(one.topic.name)} {place}" for one in chosen for place in one.places
    ]
    groups = np.split(
        np.arange(len(names)),
        np.cumsum([one.channels for one in chosen])[:-1] if units else len(names),
    )
    words = (
        f"{len(names)} channels in {f'{len(chosen)} units' if units else 'one array'}"
    )
    words += f" at {max(one.rate for one in chosen):.3g} Hz"
    noise = np.concatenate([one.segments.noise().moving for one in chosen])
    if noisy := noisier_words(
        names, noise, [group.tolist() for group in groups], unit.name, unit.factor
    ):
        yield Finding(
            Role.WARNING, "noise", f"{noisy}; {words}", headline="READY, BUT LOOK"
        )
    yield Finding(Role.WORTH, "ready", words, headline="READY")
    yield from topic_findings(chosen, unit)


def topic_findings(
    chosen: Sequence[TopicReport], unit: Unit = RADIANS
) -> Iterator[Finding]:
    """Say what is wrong with the messages of each topic."""
    for one in chosen:
        words = [f"{one.gaps} gaps of up to {one.longest:.2g} s"] if one.gaps else []
        if words := words + troubles(one, unit):
            yield Finding(
                Role.WARNING,
                "messages",
                f"{one.topic.name}: {', '.join(words)}",
                (one.topic.name,),
            )


_NO_REDUNDANCY = "one sensor on two topics is no redundancy"


def copy_words(reports: Sequence[TopicReport]) -> str:
    """Say which topics give the values of others; empty: none does."""
    copies = [f"{shown(one.topic.name)} {one.copied}" for one in reports if one.copy_of]
    return f"{' and '.join(copies)}: {_NO_REDUNDANCY}" if copies else ""


# Degrees a second -----------------------------------------------------------------------------------------------------


NEAR = 0.2  # a factor this close, relative, to that of a degree may be it: scale factors and vibration differ by less
QUANTILES = (
    0.5,
    0.7,
    0.9,
    0.97,
    0.99,
)  # of the rates of a unit, that are compared with those of another
FAST_SHARE, FAST_TIME = (
    0.01,
    0.5,
)  # share of the time, or s, beyond every gyro's range: less is a shock or damage
STILL, NOISIEST = (
    0.3,
    0.02,
)  # share of a recording that lies still; noise there, rad/s, that no gyro at rest has


def in_degrees(chosen: Sequence[TopicReport], largest_rate: float = FASTEST) -> str:
    """Say which topics, of one body, are in deg/s, and what shows it, of gyros of a range; empty: nothing does."""
    chosen = [one for one in chosen if one.complete]
    # The size of the rate: a bias is no rotation.
    apart = [
        one.segments.means - np.median(one.segments.means, axis=0) for one in chosen
    ]
    rates = [np.quantile(np.linalg.norm(each, axis=1), QUANTILES) for each in apart]
    for (fast_one, fast), (slow_one, slow) in itertools.product(
        zip(chosen, rates, strict=True), repeat=2
    ):
        moving = (slow > LEAST_ROTATION) & np.isfinite(fast + slow)
        factors = fast[moving] / slow[moving]
        if moving.sum() > 1 and (np.abs(factors / DEGREES.factor - 1.0) < NEAR).all():
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
    """Whether rates are beyond the range of gyros for long."""
    largest = np.abs(report.segments.means).max(axis=1)
    beyond = largest > largest_rate
    # Of what is deg/s no gyro shows more than twice its range.
    lasting = beyond & (largest < 2.0 * DEGREES.factor * largest_rate)
    seconds = report.segments.every * LENGTH / REST_BLOCKS * float(lasting.sum())
    return bool(beyond.mean() > FAST_SHARE) or seconds > FAST_TIME


def _no_gyro_at_rest(report: TopicReport) -> bool:
    """Whether it lies still, and with more noise and bias than any gyro in rad/s has."""
    noise, segments = (
        report.segments.noise(largest_bias=FASTEST),
        report.segments.all_segments(),
    )
    if (
        noise.share >= 1.0 - STILL
        or not (report.segments.noise().quiet > NOISIEST).all()
    ):
        return False
    still = [
        one.means.mean(axis=0)
        for one, lies in zip(segments, noise.rest, strict=True)
        if lies
    ]
    return bool(np.abs(np.median(still, axis=0)).max() > LARGEST_BIAS)


def refuse_degrees(bag: Path, config: Config) -> list[TopicReport]:
    """Return what was seen of the topics of a config; `BagError` if one is in deg/s, or the recording is damaged."""
    chosen = [one for one in inspect(bag, config.topics)[0] if one.channels]
    if words := in_degrees(chosen, max(FASTEST, *config.health.max_rate)):
        raise BagError(f"{bag} needs {words}; mend the driver")
    return chosen


# A config to start from -----------------------------------------------------------------------------------------------


_NUMBERED = re.compile(
    r"/imu_[0-9]{1,3}"
)  # topics of flight logs, which name units as a config does
_REST = 3.0  # time at the start over which the bias could be learned, s
_TIMEOUT = float(
    PARAMETERS["imus.timeout"].default
)  # s; that of health.stale_timeout is the same
_BRIDGED = (
    1.1 / MAX_BRIDGE
)  # message intervals in a timeout: so that alignment draws a line from one to the next


@dataclass(frozen=True)
class StartingConfig:
    """A config to start from."""

    bag: str  # name of the recording
    parameters: dict[str, Any]  # ``{"section.field": value}``
    remarks: dict[str, str]  # how they were found, by parameter
    look: str = ""  # what a person is to look at before they are used; empty: nothing

    @property
    def text(self) -> str:
        """The parameter file."""
        origin = f"made by fdi inspect from {self.bag}, to start from. Noise and rates are measured, mounts are not."
        return parameter_file(self.parameters, origin, self.remarks)


def starting_config_of(path: Path, refused: str) -> StartingConfig:
    """Return the config that ``fdi inspect`` writes; `BagError` in these words where there are no gyros in rad/s."""
    reports, _ = inspect(path)
    if words := needs(reports):
        raise BagError(f"{refused}: needs {words}")
    return replace(starting_config(candidates(reports), path), look=copy_words(reports))


def assumed_config(path: Path) -> tuple[Config, str]:
    """Return settings to judge a recording by that came without any, and one line that says what they assume.

    `BagError` if the recording shows no gyros, or they are not mounted alike: then axes have to be given.
    """
    refused = f"{shown(path.name)}: no config given, and none can be assumed"
    found = starting_config_of(path, refused)
    config = Config.from_parameters(found.parameters)
    if not config.imus.topics:
        raise BagError(
            f"{refused}: the axes of an array of channels are in no message; --config says them"
        )
    if turned := _turned_units(path, config):
        raise BagError(
            f"{refused}: {turned}. `fdi setup` finds how they are mounted; --config takes what it writes"
        )
    low, high = min(config.noise.noise_std), max(config.noise.noise_std)
    copies = f"{found.look}, the second is left out; " if found.look else ""
    return config, (
        f"{copies}{', '.join(config.imus.names)} mounted alike, {config.sample_rate:g} Hz,"
        f" noise {low:.2g} to {high:.2g} rad/s,"
        f" scale factors within {100 * config.noise.scale_std[0]:g} %; `fdi setup` measures all of it"
    )


def _turned_units(path: Path, config: Config) -> str:
    """Say which units measure the motion of the first one along other axes; empty: none that the motion shows."""
    size, names = max(1, round(WINDOW * config.sample_rate)), config.imus.names
    with Recording(path) as recording:
        means = [
            block.z[: len(block) // size * size]
            .reshape(-1, size, 3 * len(names))
            .mean(axis=1)
            for block in Samples(recording, config).blocks()
        ]
    slow = np.concatenate([np.zeros((0, 3 * len(names))), *means])
    slow = slow[np.isfinite(slow).all(axis=1)]
    if len(slow) < LEAST_WINDOWS:
        return ""
    first, *others = np.split(slow - np.median(slow, axis=0), len(names), axis=1)
    turned = []
    for name, rate in zip(names[1:], others, strict=True):
        rotation = find_turn(first, rate)[0]
        # A fault stays, whatever the rotation.
        explained = np.std(rate @ rotation.T - first) < (1.0 - SHARED) * np.std(
            rate - first
        )
        if explained and angle_of(rotation) > SQUARE:
            turned.append(
                f"{name} is turned by {math.degrees(angle_of(rotation)):.0f} deg against {names[0]}"
            )
    return ", ".join(turned)


def starting_config(chosen: Sequence[TopicReport], bag: Path) -> StartingConfig:
    """Make a config to start from, of the topics of gyros in a recording."""
    kind = chosen[0].kind
    assert kind is not None
    rate, largest = (
        max(report.rate for report in chosen),
        max(report.largest for report in chosen),
    )
    at_rest = rate * _REST >= MIN_LEARNED and all(map(_starts_at_rest, chosen))
    largest_rate = _rounded_up(
        max(*PARAMETERS["health.max_rate"].default, 1.001 * largest)
    )
    # Values of parameters, and remarks on them.
    known: dict[str, tuple[Any, str]] = {
        "input": (input_of(kind), ""),
        "sample_rate": (float(f"{rate:.4g}"), ""),
        "noise.noise_std": _noise_setting(chosen),
        "noise.scale_std": (
            [0.01],
            "a guess, for scale factors and axes that are not calibrated",
        ),
        "noise.timing_std": ([float(f"{0.05 / chosen[0].rate:.2g}")], "a guess"),
        "bias.startup_bias_duration": (
            _REST if at_rest else 0.0,
            f"the recording is {'' if at_rest else 'not '}at rest at the start",
        ),
        "detector.name": (PARAMETERS["detector.name"].default, ""),
        "detector.false_alarms_per_hour": (0.001, ""),
        "health.max_rate": (
            [largest_rate],
            "NOT KNOWN: put in what the data sheet says",
        ),
    }
    topics = [report.topic.name for report in chosen]
    if kind.stamped:
        words = (
            "identity, NOT MEASURED: `fdi setup` finds how the units are turned against each other, from turns about"
            " all axes. With two parallel units a fault is detected and not isolated; turned against each other, or"
            " three of them, isolate it"
        )
        numbered = all(_NUMBERED.fullmatch(topic) for topic in topics)
        names = [
            topic[1:] if numbered else f"imu_{k + 1}" for k, topic in enumerate(topics)
        ]
        known["imus.topics"], known["imus.names"] = (topics, ""), (names, "")
        known["imus.mounts"] = np.tile(np.eye(3).ravel(), len(chosen)).tolist(), words
        known["imus.max_skew"] = _rounded_up(0.2 / rate), ""
        if numbered:
            words = "of a flight log: so that a later fault of the flight is named as the first was, once that has gone"
            known["decision.latch"] = False, words
        if timeout := _longer(chosen, _BRIDGED, 10.0):
            slowest, none = (
                min(report.rate for report in chosen),
                "none would be aligned between two",
            )
            words = f"messages come at {slowest:.3g} Hz: with the default {_TIMEOUT:g} s {none}"
            known["imus.timeout"] = timeout, words
    else:
        words = (
            "a guess, NOT MEASURED: give axes, or a preset. `fdi calibrate` finds all axes from turns about all axes,"
            " but for those of three reference channels: these must be right"
        )
        known["channels.topic"], known["geometry.preset"] = (
            (topics[0], ""),
            ("cone", words),
        )
        known["geometry.cone_channels"] = chosen[0].channels, ""
    if silent := _longer(chosen, GAP, 60.0):
        known["health.stale_timeout"] = silent, f"the default is {_TIMEOUT:g} s"
    parameters = {name: value for name, (value, _) in known.items()}
    return StartingConfig(
        shown(bag.name),
        parameters,
        {name: words for name, (_, words) in known.items() if words},
    )


def _noise_setting(chosen: Sequence[TopicReport]) -> tuple[list[float], str]:
    """Noise for the config, and what it is of: a recording that mostly moves is to be judged in motion."""
    noise = [report.segments.noise() for report in chosen]
    share, levels = (
        min(one.share for one in noise),
        np.concatenate([one.moving for one in noise]),
    )
    words = f"in motion ({share:.0%} of the recording), vibration included"
    if not (share > 0.5 and np.isfinite(levels).all() and (levels > 0).all()):
        quiet = np.concatenate([one.quiet for one in noise])
        usable = np.isfinite(quiet) & (quiet > 0)
        if not usable.any():
            return [0.0025], "a guess: the recording is too short to tell"
        # A value that never changes shows no noise: that of the noisiest is taken for it.
        levels = np.where(usable, quiet, quiet[usable].max())
        words = "when quietest; in motion vibration, and axes that are not quite as given, add"
    return [_rounded_up(value) for value in levels.tolist()], words


def _longer(chosen: Sequence[TopicReport], intervals: float, most: float) -> float:
    """Find a time of silence, s, that this many intervals, and nearly all gaps, stay below; 0: the default does."""
    nearly_all = [
        float(np.quantile(np.concatenate(one.intervals), 0.999))
        for one in chosen
        if one.intervals
    ]
    needed = max([*(intervals * report.interval for report in chosen), *nearly_all])
    return min(_rounded_up(needed), most) if needed > _TIMEOUT else 0.0


def _starts_at_rest(report: TopicReport) -> bool:
    """Whether nothing moves over the time in which biases could be learned."""
    segments = zip(
        report.segments.all_segments(), report.segments.noise().rest, strict=True
    )
    begin = [
        rest for segment, rest in segments if segment.first - report.first < _REST * 1e9
    ]
    return bool(begin) and all(begin)


def _rounded_up(value: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.2g}")
