# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fitness of a recording: enough gyros, in rad/s, on one clock, each an own sensor."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.compiling.compiled import MAX_CHANNELS
from fdi_ros.config.config import PARAMETERS, SAMPLES, Config, is_plain_name
from fdi_ros.core.sources import SOURCES
from fdi_ros.errors import BagError
from fdi_ros.inspection.degrees import in_degrees
from fdi_ros.inspection.findings import Finding, Role
from fdi_ros.inspection.gravity import in_gravity
from fdi_ros.inspection.topics import (
    BELIEVED,
    TopicReport,
    burst_words,
    inspect,
    troubles,
)
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.noise import much_noisier, noisier_words
from fdi_ros.model.samples import LARGEST_GYRO_RANGE
from fdi_ros.monitor.inputs import is_of_a_monitor
from fdi_ros.monitor.soundness import REPORTED, WHOLE, Trouble, trouble_of_unused
from fdi_ros.report.layout import RADIANS, Unit
from fdi_ros.system.text import LINE, figures, first_of, listed, percent, shown

#: a year, s
YEAR = 31_557_600.0
#: clocks this far apart have other origins, s
YEARS = 3.0 * YEAR
#: default of imus.timeout and of health.stale_timeout, s
DEFAULT_TIMEOUT = float(PARAMETERS["imus.timeout"].default)
#: kinds of input, first those with stamps
_PREFERRED = sorted(SOURCES.values(), key=lambda kind: not kind.stamped)


class _DoubtfulShares(NamedTuple):
    """Shares of what a unit sends from which on it is doubtful."""

    #: largest share of messages recorded before the one ahead of them: a clock is
    #: set seldom
    disordered: float = 0.1
    #: share of stamps that do not increase: not a message that came twice
    stamps: float = 0.01
    #: share of the values of a gyro that are repeated for long
    frozen: float = 0.1
    #: the same share from which on most of what a unit sends measures nothing
    mostly_frozen: float = 0.5
    #: share of stamps that do not increase, above which none shows when a message
    #: was measured
    old_stamps: float = 0.9
    #: gain of stamps over the times of recording that no transport explains, s
    jump: float = 1.0
    #: factor between the intervals of stamps and of messages that no slow
    #: simulation explains
    pace: float = 50.0


DOUBTFUL = _DoubtfulShares()

NEEDED = ", or ".join(
    f"two {kind.type.rpartition('/')[2]} topics"
    if kind.stamped
    else f"one array of {kind.value_counts.start} to {kind.value_counts.stop - 1} values"
    for kind in _PREFERRED
)


def candidates(reports: Sequence[TopicReport]) -> list[TopicReport]:
    """Return the topics for a config: up to four units, or else the first suitable array."""
    possible = [report for report in reports if not _unusable(report)]
    for kind in _PREFERRED:
        alike = [report for report in possible if report.kind is kind]
        # Stamps in bursts spoil every sample that is formed at them.
        steady = [report for report in alike if report.burst == 1]
        for usable in (steady, alike):
            if len(usable) >= kind.topic_counts.start:
                return usable[: kind.topic_counts.stop - 1]
    return []


#: Name under which all accelerometers are left out.
ALL_ACCELERATIONS = "the acceleration of all units"


def left_out(reports: Sequence[TopicReport]) -> list[tuple[str, str]]:
    """Return each topic of gyros that `candidates` leaves out, and why.

    Accelerations in g or mg are left out altogether: those of the units could not be compared.
    """
    chosen = candidates(reports)
    found = []
    if why := in_gravity(chosen):
        found.append((ALL_ACCELERATIONS, why))
    for report in reports:
        if report in chosen or not chosen or report.kind is not chosen[0].kind:
            continue
        if is_of_a_monitor(report.topic.name):
            continue
        why = _unusable(report)
        if not why and report.burst > 1:
            why = burst_words(report)
        most = f"a config has at most {len(chosen)} units"
        found.append((report.topic.name, why or most))
    return found


def clocks_apart(reports: Sequence[TopicReport], beyond: float = 1.0) -> str:
    """Name the units whose clocks differ from the first by more than a limit, s.

    Differences below 1 s may be the transport time of messages. Empty if no clock
    differs.
    """
    first = next((report for report in reports if math.isfinite(report.ahead)), None)
    off = (
        []
        if first is None
        else [
            (shown(report.topic.name), report.ahead - first.ahead) for report in reports
        ]
    )
    far = [(name, ahead) for name, ahead in off if abs(ahead) > beyond]
    words = [f"{name} {_apart_words(ahead)}" for name, ahead in far]
    if first is None or not words:
        return ""
    return (
        f"stamps are of other clocks than those of {shown(first.topic.name)}: {', '.join(words)}; no instants can be"
        " compared: synchronise the clocks (PTP, chrony), or stamp on arrival"
    )


def _apart_words(ahead: float) -> str:
    """Return how far a clock is from another one, s. Years are no error of a clock."""
    side = "ahead" if ahead > 0.0 else "behind"
    if abs(ahead) < YEARS:
        return f"{figures(abs(ahead), 6)} s {side}"
    why = "the others count" if ahead > 0.0 else "it counts"
    return f"{abs(ahead) / YEAR:.0f} years {side} ({why} since boot, not since 1970)"


def no_common_time(reports: Sequence[TopicReport]) -> str:
    """Name the units whose stamps do not overlap with those of the first, may be empty."""
    stamped = [(one.topic.name, one.stamps) for one in reports]
    spans = [(name, *stamps) for name, stamps in stamped if stamps is not None]
    if not spans:
        return ""
    if set_back := [one for one in spans if one[2] < one[1]]:
        names = listed([shown(name) for name, _, _ in set_back])
        longest = max(first - last for _, first, last in set_back) * 1e-9
        return (
            f"the last stamps of {names} are up to {figures(longest)} s before the first: a clock was"
            " set while they were recorded, or the file is not in the order of time"
        )
    _, origin, end = spans[0]
    apart = [one for one in spans if one[1] > end or one[2] < origin]
    if not apart:
        return ""
    seconds = [
        (shown(name), (first - origin) * 1e-9, (last - origin) * 1e-9)
        for name, first, last in (spans[0], *apart)
    ]
    words = [
        f"{name} from {figures(first, 6)} to {figures(last, 6)} s"
        for name, first, last in seconds
    ]
    return (
        f"no common time, by the stamps of their samples: {', '.join(words)};"
        " synchronise the clocks, or give all stamps the same origin"
    )


def not_waited_for(reports: Sequence[TopicReport], timeout: float) -> str:
    """Name the units whose stamps arrive too late or too early to be aligned, may be empty.

    ``timeout``: time for which a silent unit is waited for, s.
    """
    first = reports[0]
    wait = max(timeout, SAMPLES.least_wait * max(one.interval for one in reports))
    words = [
        f"{shown(one.topic.name)} {_apart_words(one.ahead - first.ahead)}"
        for one in reports
        if abs(one.ahead - first.ahead) > 1.1 * wait
    ]
    if not words:
        return ""
    return (
        f"when messages arrive, stamps differ from those of {shown(first.topic.name)}:"
        f" {', '.join(words)}; a unit is waited for {figures(wait)} s (imus.timeout)."
        " Synchronise the clocks, or raise imus.timeout if messages take so long"
    )


def one_clock(reports: Sequence[TopicReport], timeout: float = DEFAULT_TIMEOUT) -> str:
    """Return why the stamps of these topics cannot be compared, empty if they can.

    ``timeout``: time for which a silent unit is waited for, s.
    """
    stamped = [one for one in reports if one.kind is not None and one.kind.stamped]
    if len(stamped) < 2:
        return ""
    return (
        clocks_apart(stamped)
        or no_common_time(stamped)
        or not_waited_for(stamped, timeout)
    )


def refuse_unfit(bag: Path, config: Config) -> list[TopicReport]:
    """Return the reports on the topics of a config.

    `BagError` if a topic is in deg/s, stamps are of several clocks, or reading fails.
    """
    chosen = [one for one in inspect(bag, config.topics).reports if one.channels]
    if words := in_degrees(chosen, max(LARGEST_GYRO_RANGE, *config.health.max_rate)):
        raise BagError(f"{bag} needs {words}; mend the driver")
    is_judged = config.accelerometers.enabled != "off"
    if is_judged and (words := in_gravity(chosen)):
        raise BagError(
            f"{bag} needs m/s^2: {words}; mend the driver, or set accelerometers.enabled to off"
        )
    if words := one_clock(chosen, config.imus.timeout):
        raise BagError(f"{bag} needs one clock: {words}")
    return chosen


def not_configured(bag: Path, config: Config) -> list[str]:
    """Return a line for each topic that carries gyros and is not in a config."""
    configured = {name.lstrip("/") for name in config.topics}
    with Recording(bag) as recording:
        return [
            f"{shown(topic.name)} carries gyros and is not in the config: it was not judged"
            for topic in recording.topics
            if topic.type == SOURCES[config.input].type
            and topic.name.lstrip("/") not in configured
            and not is_of_a_monitor(topic.name)
        ]


def _unusable(report: TopicReport) -> str:
    """Return why a topic cannot serve as gyros, empty if it can."""
    kind = report.kind
    received = report.received
    if kind is None:
        return "its type carries no gyros"
    # The first that holds is the reason.
    encoding = report.topic.encoding
    reasons = {
        f"its messages are encoded as {shown(encoding) or 'nothing known'}, not as cdr": encoding
        != "cdr",
        "no messages": not received,
        # The fused rate must not be its own witness.
        "a monitor has published it": is_of_a_monitor(report.topic.name),
        "no name that ROS allows": not is_plain_name(report.topic.name),
        f"{report.announced} values, not {MIN_CHANNELS} to {MAX_CHANNELS}": not report.channels
        and not kind.stamped,
        f"all {received} messages are malformed, or have stamps before 1970": report.malformed
        == received,
        f"no message in which all values are finite and below {figures(BELIEVED)} rad/s": not report.complete,
        "its messages are not in the order of time: sort the file": report.disordered
        > DOUBTFUL.disordered * received,
        "a single message": received == 1,
        "its times of recording do not increase": not report.rate,
        f"its stamps do not increase in {percent(report.backward / max(1, received))} of its messages": report.backward
        > DOUBTFUL.old_stamps * received,
        _pace_words(report): bool(_pace_words(report)),
        f"it {report.copied}: {_NO_REDUNDANCY}": bool(report.copy_of),
    }
    return next((words for words, holds in reasons.items() if holds), "")


def _pace_words(report: TopicReport) -> str:
    """Return by which factor stamps pass too fast or too slowly. Empty: they keep pace.

    The clock of a simulation may be some times slower or faster than that of the recorder.
    """
    step = report.stamp_interval
    if not step or not report.interval:
        return ""
    factor = report.interval / step
    if 1.0 / DOUBTFUL.pace <= factor <= DOUBTFUL.pace:
        return ""
    times, side = (
        (factor, "closer together") if factor > 1.0 else (1.0 / factor, "farther apart")
    )
    return (
        f"its stamps are about {float(f'{times:.1g}'):.0f} times {side} than its messages: they are not in"
        " seconds and nanoseconds"
    )


def _in_bursts(chosen: Sequence[TopicReport]) -> str:
    """Name the units whose stamps do not show when they measured, may be empty."""
    some = [one for one in chosen if one.kind is not None and one.kind.stamped]
    some = [one for one in some if one.burst > 1]
    if not some:
        return ""
    names = listed([shown(one.topic.name) for one in some])
    return (
        f"two units with stamps of the time of measurement: those of {names} come in bursts"
        f" of about {max(one.burst for one in some)}; stamp each sample when it is measured"
    )


def needs(reports: Sequence[TopicReport]) -> str:
    """Return the needs of a recording, with the trouble of each topic.

    Empty if a config can be made.
    """
    if chosen := candidates(reports):
        return in_degrees(chosen) or _in_bursts(chosen)
    why = [
        (shown(report.topic.name), _unusable(report))
        for report in reports
        if report.kind is not None
    ]
    good = [name for name, words in why if not words]
    bad = [f"{name}: {words}" for name, words in why if words]
    usable = [f"usable: only {', '.join(good)}"] if good else []
    if not why:
        there = [
            f"{shown(one.topic.name)} ({shown(one.topic.type) or 'no type'},"
            f" {shown(one.topic.encoding) or 'no encoding'})"
            for one in reports
        ]
        usable = [f"it has {first_of(there, 4)}" if there else "it has no topic"]
    return "; ".join(
        [NEEDED, *usable, *([first_of(bad, 8, "; ", "; and")] if bad else [])]
    )


def recording_findings(
    reports: Sequence[TopicReport],
    refused: str = "",
    unit: Unit = RADIANS,
    unread: Sequence[tuple[str, str]] = (),
) -> Iterator[Finding]:
    """Yield the findings on a recording.

    ``refused``: reason why no config can be made, where the recording needs nothing.
    ``unread``: gyros that cannot be read as such, and why.
    """
    chosen = candidates(reports)
    lacking = needs(reports) or refused
    clocks = one_clock(chosen)
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
    for topic, words in unused_topics(reports, unread):
        yield _look("left out", words, trouble_of_unused(words), (topic,))
    yield from message_findings(chosen)
    yield from bad_values(chosen)
    units = len(chosen) > 1
    names = [
        f"{shown(one.topic.name)} {place}" for one in chosen for place in one.places
    ]
    groups = [
        group.tolist()
        for group in np.split(
            np.arange(len(names)),
            np.cumsum([one.channels for one in chosen])[:-1] if units else len(names),
        )
    ]
    words = (
        f"{len(names)} channels in {f'{len(chosen)} units' if units else 'one array'}"
    )
    words += f" at {figures(max(one.rate for one in chosen))} Hz can be judged"
    noise = np.concatenate([one.segments.noise().moving for one in chosen])
    if noisy := much_noisier(noise, groups):
        channels = [names[i] for i, _ in noisy]
        who = dict.fromkeys(name.partition(" ")[0] for name in channels)
        more = noisier_words(names, noise, groups, unit.name, unit.factor)
        yield _look("noise", f"{more} from sample to sample", Trouble.NOISE, list(who))
    yield Finding(Role.WORTH, "ready", words, headline="READY")
    yield from topic_findings(chosen, unit)


def incomplete_findings(
    reports: Sequence[TopicReport],
    incomplete: str = "",
    headline: str = "READY, BUT LOOK",
) -> Iterator[Finding]:
    """Yield a finding on a recording that lacks messages of all units.

    ``incomplete``: damage, as it continues ``the recording``. A longer hole in a whole
    recording is a pause between two flights.
    """
    chosen = candidates(reports)
    if needs(reports) or one_clock(chosen):
        return
    usual = max((one.interval for one in chosen), default=0.0)
    gap = min((one.longest for one in chosen), default=0.0)
    is_hole = gap >= max(REPORTED.missing_s, WHOLE.intervals * usual)
    is_hole &= bool(incomplete) or gap < WHOLE.pause
    words = [incomplete] if incomplete else []
    if is_hole:
        words.append(f"lacks up to {figures(gap, 2)} s of all units at once")
    if words:
        trouble = Trouble.DAMAGE if incomplete else Trouble.HOLE
        sentence = f"the recording {' and '.join(words)}"
        yield _look("damage", sentence, trouble, (), headline)


def short_findings(reports: Sequence[TopicReport], learned: float) -> Iterator[Finding]:
    """Yield a finding on a recording of which too little is left to judge.

    ``learned``: time in which the monitor learns the biases, s.
    """
    chosen = candidates(reports)
    if needs(reports) or one_clock(chosen):
        return
    seconds = min((1e-9 * (one.last - one.first) for one in chosen), default=0.0)
    if seconds * (1.0 - WHOLE.judged) < learned:
        words = (
            f"the recording lasts {figures(seconds, 2)} s, and the monitor learns the biases for"
            f" {figures(learned)} s of them"
        )
        yield _look("short", words, Trouble.SHORT, ())


def unused_topics(
    reports: Sequence[TopicReport], unread: Sequence[tuple[str, str]] = ()
) -> list[tuple[str, str]]:
    """Return each gyro that is left out, copies aside, and a sentence with the reason.

    ``unread``: gyros that cannot be read as such, and why.
    """
    return [
        (topic, f"{shown(topic, LINE)} is left out: {why}")
        for topic, why in (*left_out(reports), *unread)
        if _NO_REDUNDANCY not in why
    ]


def message_findings(
    chosen: Sequence[TopicReport], headline: str = "READY, BUT LOOK"
) -> Iterator[Finding]:
    """Yield units that lack messages, and those with stamps that are not of their measurement."""
    for topic, words in _slow_topics(chosen):
        yield _look("delivered", words, Trouble.DELIVERY, (topic,), headline)
    if set_back := [one for one in chosen if one.set_back > DEFAULT_TIMEOUT]:
        names = [one.topic.name for one in set_back]
        size = figures(max(one.set_back for one in set_back))
        words = f"the stamps of {listed(list(map(shown, names)))} go back by up to {size} s: a clock was set"
        yield _look("clock", words, Trouble.CLOCK, names, headline)
    leads = [_gained(one) for one in chosen]
    for one, gained in zip(chosen, leads, strict=True):
        # Where all gained alike, it is the clock of all, or that of the recorder.
        is_alone = max(leads) - min(leads) > DOUBTFUL.jump
        if is_alone and abs(gained) > DOUBTFUL.jump and one.set_back <= DEFAULT_TIMEOUT:
            side = "more" if gained > 0.0 else "less"
            words = (
                f"the stamps of {shown(one.topic.name)} advance by {figures(abs(gained), 3)} s {side}"
                " than the time of recording: a clock was set"
            )
            yield _look("stamps", words, Trouble.STAMPS, (one.topic.name,), headline)
    for one in chosen:
        if one.backward >= DOUBTFUL.stamps * one.received:
            words = (
                f"{shown(one.topic.name)} repeats old stamps in"
                f" {percent(one.backward / one.received)} of its messages: these are not used"
            )
            yield _look("stamps", words, Trouble.STAMPS, (one.topic.name,), headline)


def _gained(one: TopicReport) -> float:
    """Return by how much the stamps of a topic advanced more than its times of recording, s."""
    if one.stamps is None:
        return 0.0
    first, last = one.stamps
    return 1e-9 * ((last - first) - (one.last - one.first))


def _slow_topics(chosen: Sequence[TopicReport]) -> Iterator[tuple[str, str]]:
    """Yield the topics that lack messages, compared with the best one, and how many."""
    times = [one.received * one.interval for one in chosen]
    for one, time in zip(chosen, times, strict=True):
        if time < REPORTED.delivered * max(times):
            share = time / max(times)
            name = one.topic.name
            yield name, f"{shown(name)} delivered {percent(share)} of its messages"


def bad_values(
    chosen: Sequence[TopicReport], headline: str = "READY, BUT LOOK"
) -> Iterator[Finding]:
    """Yield channels with spikes, and gyros at the end of their range or with old values."""
    saturated = [
        f"{shown(one.topic.name)} {place}"
        for one in chosen
        for place, count in zip(one.places, one.values.saturated, strict=True)
        if count
    ]
    if saturated:
        seconds = max(
            float(one.values.saturated.max()) * one.interval for one in chosen
        )
        words = f"{listed(saturated)} reached the end of the range for {figures(seconds, 2)} s"
        units = dict.fromkeys(name.partition(" ")[0] for name in saturated)
        yield _look("end of range", words, Trouble.END_OF_RANGE, list(units), headline)
    for one in chosen:
        name = one.topic.name
        if spiky := _spike_words(one):
            words = f"{shown(name)} has spikes: {listed(spiky)}"
            yield _look("spikes", words, Trouble.SPIKES, (name,), headline)
    for one in chosen:
        lacks = one.not_finite / max(1, one.received)
        lacking = np.flatnonzero(lacks > 1.0 - REPORTED.delivered)
        if len(lacking):
            name = shown(one.topic.name)
            places = listed([one.places[i] for i in lacking.tolist()])
            words = f"{name} gave no finite value in {percent(float(lacks.max()))} of the messages: {places}"
            who = (one.topic.name,)
            yield _look("not finite", words, Trouble.INPUT, who, headline)
    frozen = {one.topic.name: _repeating(one) for one in chosen if _repeating(one)}
    if frozen and not saturated:
        names = [name for some in frozen.values() for name in some]
        most = [float(one.repeats.count.max()) / one.received for one in chosen]
        share = max(most)
        verb = "repeats" if len(names) == 1 else "repeat"
        words = f"{listed(names)} {verb} one value for long, in {percent(share)} of the messages"
        yield _look("frozen", words, Trouble.REPEATS, list(frozen), headline)


def _repeating(one: TopicReport) -> list[str]:
    """Return the channels that repeat one value in many messages, or the topic for all."""
    name = shown(one.topic.name)
    much = one.repeats.count >= DOUBTFUL.frozen * one.received
    if much.all():
        return [name]
    places = np.array(one.places)[much].tolist()
    return [f"{name} {place}" for place in places]


def _spike_words(one: TopicReport) -> list[str]:
    """Return the number of spikes of each channel that has at least `REPORTED.spikes`."""
    halves = (("", one.segments.spikes), ("accelerometer ", one.forces.spikes))
    return [
        f"{count} in {half}{place}"
        for half, counts in halves
        for place, count in zip(one.places, counts.tolist(), strict=True)
        if count >= REPORTED.spikes
    ]


def frozen_words(chosen: Sequence[TopicReport]) -> str:
    """Name the units that mostly repeat one value while another one does not, may be empty.

    At rest, coarse values repeat too, but then in all units.
    """
    shares = {
        shown(one.topic.name): float(one.repeats.count.min()) / one.received
        for one in chosen
    }
    frozen = [name for name, share in shares.items() if share >= DOUBTFUL.mostly_frozen]
    if not frozen or min(shares.values()) >= DOUBTFUL.frozen:
        return ""
    share = max(shares[name] for name in frozen)
    verb = "repeats" if len(frozen) == 1 else "repeat"
    return (
        f"{listed(frozen)} {verb} one value for long, in {percent(share)} of the messages, and the other"
        " units do not"
    )


def _look(
    what: str,
    words: str,
    trouble: Trouble,
    who: Sequence[str],
    headline: str = "READY, BUT LOOK",
) -> Finding:
    """Return a finding that asks for a look at a recording that can be judged."""
    advice = trouble.advice(who)
    return Finding(Role.WARNING, what, words, who, headline=headline, advice=advice)


def topic_findings(
    chosen: Sequence[TopicReport], unit: Unit = RADIANS
) -> Iterator[Finding]:
    """Yield the troubles in the messages of each topic."""
    for one in chosen:
        words = (
            [f"{one.gaps} gaps of up to {figures(one.longest, 2)} s"]
            if one.gaps
            else []
        )
        if words := words + troubles(one, unit):
            yield Finding(
                Role.WARNING,
                "messages",
                f"{one.topic.name}: {', '.join(words)}",
                (one.topic.name,),
            )


_NO_REDUNDANCY = "one sensor on two topics is no redundancy"


def copy_words(reports: Sequence[TopicReport]) -> str:
    """Name the topics that repeat the values of others, may be empty."""
    copying = [one for one in reports if one.copy_of]
    copies = [f"{shown(one.topic.name)} {one.copied}" for one in copying]
    return f"{' and '.join(copies)}: {_NO_REDUNDANCY}" if copies else ""
