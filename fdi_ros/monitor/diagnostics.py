# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics: level, words and figures for the monitor, each channel and each input."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from fdi_ros.core.messages import LAST_STAMP
from fdi_ros.core.sources import source_of
from fdi_ros.core.states import ChannelState, Reason
from fdi_ros.model.quantity import FORCE
from fdi_ros.monitor.output import Topic
from fdi_ros.monitor.soundness import (
    DECLARED,
    REPORTED,
    Concern,
    Trouble,
    Word,
    live_word,
    units_in_both_halves,
)
from fdi_ros.monitor.status import CERTAIN_SIGMAS
from fdi_ros.system.text import figures, first_of, percent, plus_minus, shown

if TYPE_CHECKING:
    from fdi_ros.monitor.status import ChannelStatus, Status, UnitStatus

Values = tuple[tuple[str, str], ...]

PREFIX = "fdi_node: "
"""Default prefix of all names. A node uses its full name instead."""
MONITOR_LINE = "monitor"
"""Name of the line about the monitor as a whole, after the prefix."""
INPUT = "input "
"""Begin of the names of input topics, after the prefix."""
FAR_FROM_NOW = 1.0
"""Difference of stamps and clock from which on the stamps belong to another clock, s."""
OLD = 86400.0
"""Delay behind the clock from which on stamps probably belong to a recording, s."""
OLD_WORDS = " (of a recording? then use_sim_time, and a player that gives the clock)"
LEAST_DELAY = 0.001
"""Smallest delay that is reported, s. Drivers often differ by less, which makes an error of
0.01 rad/s at an angular acceleration of 10 rad/s^2."""
NEARLY = 0.8
"""Share of ``bias.max_drift`` from which on a drift is reported. Above 1 it is a fault."""


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class StatusLine(NamedTuple):
    """One diagnostic_msgs/DiagnosticStatus."""

    #: severity
    level: Level
    #: of the channel, the input or the monitor
    name: str
    #: state in words
    message: str
    #: of the unit or the vehicle, may be empty
    hardware_id: str = ""
    #: pairs of key and value
    values: tuple[tuple[str, str], ...] = ()

    def value(self, key: str) -> str:
        """Return a value by its key, empty if the key is missing."""
        return dict(self.values).get(key, "")

    def number(self, key: str) -> float:
        """Return a value as a number, NaN if the text is none."""
        return parse_number(self.value(key))


def parse_number(text: str) -> float:
    """Return the number in a text, NaN if the text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


@dataclass(frozen=True)
class InputStatus:
    """Present state of one input topic."""

    name: str
    """Name of the input."""
    topic: str
    """Its topic."""
    received: int
    """Number of received messages."""
    rate: float
    """Recent messages per second, Hz."""
    silent: float | None
    """Time since the last message, s. None: no message yet."""
    live: bool
    """Whether the input delivers, by the stamps of the other inputs and by the clock."""
    arrives: bool = False
    """Whether messages arrive, usable or not."""
    lag: float = 0.0
    """Delay of its stamps behind those of the other inputs, s."""
    max_lag: float = math.inf
    """Largest lag of messages that belong to one instant, s."""
    offset: float | None = None
    """Clock of the monitor minus the last stamp, s. None: messages without stamps."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Messages that were not used as they came, by kind."""
    recent: Mapping[str, int] = field(default_factory=dict)
    """The same since the last regular report."""
    error: str = ""
    """Why the last malformed message was refused."""
    unstamped: bool = False
    """Whether its headers have no stamp."""
    parted: bool = False
    """Whether its clock drifted away from the clock of the only other live input."""
    frame: str = ""
    """frame_id of its first message."""
    frame_now: str = ""
    """frame_id of its last message."""
    sources: str = ""
    """Fault of its publishers: a second publisher, or a second input on the topic."""


_LEVELS = {
    ChannelState.OK: Level.OK,
    ChannelState.AMBIGUOUS: Level.ERROR,
    ChannelState.FAULTY: Level.ERROR,
    ChannelState.STALE: Level.STALE,
}
"""Level by state. Other states are a warning."""
_TIMES = (
    ("ms", 1e-3, 0.1, 1),
    ("s", 1, 600, 1),
    ("min", 60, 36_000, 0),
    ("h", 3600, 172_800, 0),
    ("days", 86_400, 63_072_000, 0),
    ("years", 31_557_600, math.inf, 0),
)
"""Units of time: name, length in s, upper end of use in s, number of decimals."""
UNUSED_COUNTERS = {
    "malformed": "malformed messages",
    "duplicate": "repeated stamps",
    "backward": "stamps going back",
    "ahead": "stamps ahead of the clock, refused",
    "jumped": "stamps far ahead of all others, refused",
    "late": "messages too late for their sample",
}
"""Counters of messages that were not used as they came, with words for each."""


def describe(
    status: Status,
    prefix: str = PREFIX,
    *,
    inputs: Sequence[InputStatus] = (),
    figures: Sequence[tuple[str, str]] = (),
    silent: float | None = None,
    since: Sequence[int] | None = None,
    warning: str = "",
    concerns: Sequence[Concern] = (),
) -> list[StatusLine]:
    """Describe a monitor: first as a whole, then each channel and each input topic.

    Parameters
    ----------
    status
        The monitor after its last sample.
    prefix
        Prefix of all names.
    inputs
        Its input topics.
    figures
        More keys and values for the line about the monitor.
    silent
        Time without samples, s, which makes all lines STALE. None: samples arrive.
    since
        Stamps of the messages that changed the states of the channels, ns. None: the stamps of
        the samples.
    warning
        Further faults of the monitor, in words. Empty: none.
    concerns
        Reasons not to call channels or units healthy, as `RecentHealth` gives them.
    """
    worse = _find_worse(status)
    level, message = _whole_message(status, worse, concerns)
    for channel in status.channels:
        if about := _words_about(channel.name, concerns):
            worse[channel.name] = [*worse.get(channel.name, ()), *about]
    if warning:
        level = max(level, Level.WARN)
        message = f"{message}; {warning}"
    word = live_word(status, concerns)
    named = any(one.state in DECLARED for one in status.channels)
    if silent is not None and not named:
        # A fault that was declared does not end with the samples.
        word = Word.CANNOT_TELL
    values = (("verdict", word.value), *_whole_values(status), *figures)
    rows = [(MONITOR_LINE, level, message, values)]
    for k, channel in enumerate(status.channels):
        values = _channel_values(
            channel, status, k, since[k] if since else channel.since
        )
        rows.append((channel.name, *_channel_message(channel, status, worse), values))
    if silent is not None:
        words = (
            f"no sample for {_seconds(silent)}" if status.samples else "no sample yet"
        )
        words += f"; {warning}" if warning else ""
        rows = [(name, Level.STALE, words, values) for name, _, _, values in rows]
    rows += [_input_row(line, concerns) for line in inputs]
    hardware = status.config.hardware_id
    return [
        StatusLine(level, prefix + name, message, hardware, values)
        for name, level, message, values in rows
    ]


def _input_row(
    line: InputStatus, concerns: Sequence[Concern]
) -> tuple[str, Level, str, Values]:
    """Return the line about an input topic."""
    about = _words_about_input(line.name, concerns)
    level, message = _input_message(line, about)
    return f"{INPUT}{line.name}", level, message, _input_values(line)


def _words_about_input(name: str, concerns: Sequence[Concern]) -> list[str]:
    """Return the concerns about a unit without the warnings of its own input."""
    others = [one for one in concerns if one.trouble is not Trouble.INPUT]
    return _words_about(name, others)


def _words_about(name: str, concerns: Sequence[Concern]) -> list[str]:
    """Return the concerns about a channel or unit, in words."""
    return [one.words for one in concerns if name in one.who]


def degraded(status: Status) -> dict[str, str]:
    """Return a sentence for each channel and unit that is degraded but in use, by name."""
    units = {unit.name for unit in status.units}
    return {
        name: f"{name}{' as a whole' if name in units else ''}: {'; '.join(words)}"
        for name, words in _find_worse(status).items()
    }


def _find_worse(status: Status) -> dict[str, list[str]]:
    """Return the degradations of channels and units, without their names.

    Channels and units without degradation have no entry.
    """
    found = {
        one.name: _channel_worse(one, status)
        for one in status.channels
        if not one.is_left_out
    }
    for unit in status.units:
        if abs(unit.delay) > max(CERTAIN_SIGMAS * unit.delay_std, LEAST_DELAY):
            side = "late" if unit.delay > 0 else "early"
            off = "; the monitor corrects this" if unit.taken_off else ""
            size = f"{1e3 * abs(unit.delay):.1f} +- {1e3 * unit.delay_std:.1f} ms"
            found[unit.name] = [
                f"its stamps are {size} {side} against {unit.against}'s{off}"
            ]
    return {name: words for name, words in found.items() if words}


def _channel_worse(channel: ChannelStatus, status: Status) -> list[str]:
    words = []
    bias = status.config.bias
    unit = channel.unit
    own = bias.max_drift
    section = "bias"
    if unit == FORCE.unit:
        own = status.config.accelerometers.max_drift
        section = "accelerometers"
    if abs(channel.drift) > NEARLY * own > 0:
        limit = f"a fault beyond {own:g} ({section}.max_drift)"
        words.append(f"bias has drifted by {_figure(channel.drift)} {unit}, {limit}")
    if status.has_implausible_start_bias(channel):
        words.append(
            f"bias of {_figure(channel.start_bias)} {unit} at the start, far above {section}.turn_on_std"
            f" ({status.turn_on_std(channel):g}): perhaps a fault from before the start"
        )
    return words


def _whole_message(
    status: Status, worse: Mapping[str, Sequence[str]], concerns: Sequence[Concern]
) -> tuple[Level, str]:
    total = len(status.channels)
    doubtful = {name for one in concerns for name in one.who}
    for unit in status.units:
        if unit.name in doubtful:
            doubtful.update(unit.channels)
    healthy = {
        channel.name
        for channel in status.channels
        if channel.state == ChannelState.OK
        and channel.name not in doubtful
        and not status.has_implausible_start_bias(channel)
    }
    about = [channel.name for channel in status.channels if channel.name in worse]
    alive = sum(not channel.is_left_out for channel in status.channels)
    # That all faults are detected, and none isolated, needs no list of all channels.
    alike = len(status.can_detect) == alive and not status.can_isolate
    words = [
        "" if alike else status.note,
        *_format_units(status, worse),
        f"degraded: {', '.join(about)}" if about else "",
        first_of(list(map(str, concerns)), REPORTED.concerns, "; ") if concerns else "",
    ]
    count = _healthy_words(status, healthy)
    note = "".join(f"; {one}" for one in words if one)
    if not status.has_rate:
        return Level.ERROR, f"no fused rate: {_why_no_rate(status)}{count}{note}"
    troubles = (
        worse or concerns or status.copies or any(unit.frozen for unit in status.units)
    )
    complete = (
        len(healthy) == total and len(status.can_isolate) == total and not troubles
    )
    level = (
        Level.ERROR if not status.can_detect else Level.OK if complete else Level.WARN
    )
    return level, f"{count}; {_reach(status)}{note}"


def _healthy_words(status: Status, healthy: Set[str]) -> str:
    """Return the number of healthy channels, separately for gyros and accelerometers."""

    def counted(some: Sequence[ChannelStatus], called: str) -> str:
        count = sum(channel.name in healthy for channel in some)
        return f"{count} of {len(some)} {called}"

    gyros = [one for one in status.channels if one.unit != FORCE.unit]
    others = status.channels[len(gyros) :]
    if not others:
        return f"{counted(gyros, 'channels')} healthy"
    return f"{counted(gyros, 'gyros')} and {counted(others, 'accelerometers')} healthy"


def _format_units(status: Status, worse: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the faults of whole units in words.

    The last late unit is followed by the setting that corrects delays.
    """
    late = [unit for unit in status.units if unit.name in worse]
    words = [
        f"{first} and {second} give the same values: one sensor, no redundancy; the second is left out;"
        " check topics and remappings"
        for first, second in status.copies
    ]
    words += [_format_frozen(unit) for unit in status.units if unit.frozen]
    slow = [(unit.name, "; ".join(worse[unit.name])) for unit in late]
    words += [f"{name} as a whole: {why}" for name, why in slow]
    set_now = source_of(status.config).delays
    if late and len(set_now) == len(status.units):
        delays = [
            round(before + (unit.delay if unit in late else 0.0), 5)
            for before, unit in zip(set_now, status.units, strict=True)
        ]
        words[-1] += f" (to correct it from the start: imus.delays: {delays})"
    faulty = {
        channel.name
        for channel in status.channels
        if channel.state == ChannelState.FAULTY
    }
    wholly = {unit.name for unit in status.units if faulty.issuperset(unit.channels)}
    both = set(units_in_both_halves(status.channels)) - wholly
    words += [
        f"{unit.name} as a whole is faulty"
        for unit in status.units
        if unit.name in wholly
    ]
    words += [
        f"{unit.name} (gyros and accelerometers) is faulty, as a whole or in part"
        for unit in status.units
        if unit.name in both
    ]
    groups = dict.fromkeys(
        channel.group for channel in status.channels if channel.group
    )
    sets = (_format_unit_set(group, status, both) for group in groups)
    words += filter(None, sets)
    return words if status.apart is None else [*words, str(status.apart)]


def _format_frozen(unit: UnitStatus) -> str:
    return f"{unit.name} frozen: all values have repeated for {_seconds(unit.frozen)} while the others measure motion"


def _format_unit_set(
    group: Sequence[str], status: Status, told: Collection[str] = ()
) -> str:
    """Return a sentence if a set consists of whole units in one half, else an empty text.

    ``told``: units that another sentence is about.
    """
    measures = {channel.name: channel.unit for channel in status.channels}
    half = measures.get(group[0]) if group else None
    inside = {
        unit.name: own
        for unit in status.units
        if (own := {one for one in unit.channels if measures.get(one) == half})
        and own.issubset(group)
    }
    if not inside or sum(map(len, inside.values())) != len(group):
        return ""
    if len(inside) == 1 and not inside.keys().isdisjoint(told):
        return ""
    names = [f"{name}.accel" if half == FORCE.unit else name for name in inside]
    who = f"{'one of ' if len(names) > 1 else ''}{', '.join(names)}"
    return f"{who} is faulty, as a whole or in part: undecided"


def _why_no_rate(status: Status) -> str:
    if status.withheld and status.all_repeat:
        return "withheld, because all channels repeat their values in motion: the data source has stalled; "
    if status.withheld:
        return "withheld, because suspect channels cannot be left out; "
    if status.bias_state == "learning":
        return "the biases are being learned, at rest; "
    return (
        f"biases not learned: {status.bias_state}; "
        if status.bias_state.startswith("refused")
        else ""
    )


def _reach(status: Status) -> str:
    detect = len(status.can_detect)
    isolate = len(status.can_isolate)
    alive = sum(not channel.is_left_out for channel in status.channels)
    if not detect:
        return "no further fault would be detected"
    if any(channel.state == ChannelState.AMBIGUOUS for channel in status.channels):
        return "no further fault would be isolated until this set is decided"
    # Without a fault there is nothing that another one would be further to.
    is_first = not any(
        one.is_left_out or one.state in DECLARED for one in status.channels
    )
    fault = "a fault" if is_first else "a further fault"
    if isolate == alive:
        return f"{fault} would be isolated"
    seen = (
        f"{fault} would be detected"
        if detect == alive
        else f"a fault would be detected on {detect} of {alive}"
    )
    return f"{seen} " + (
        f"and isolated on {isolate} of {alive}" if isolate else "but not isolated"
    )


def _whole_values(status: Status) -> Values:
    return (
        ("detector", status.detector),
        ("statistic", _figure(status.statistic)),
        ("threshold", _figure(status.threshold)),
        ("samples", str(status.samples)),
        ("fused rate", "yes" if status.has_rate else "no"),
        ("faults seen on", ", ".join(status.can_detect) or "none"),
        ("faults isolated on", ", ".join(status.can_isolate) or "none"),
        ("names rest on", status.names_rest_on or "one fault at a time"),
        ("protection level (rad/s)", " ".join(map(_figure, status.protection_level))),
        (
            "protection level after one more loss (rad/s)",
            " ".join(map(_figure, status.protection_level_after_loss)),
        ),
        *_force_values(status.acceleration),
        ("bias", status.bias_state),
        *((f"{unit.name}: stamps late (ms)", _late(unit)) for unit in status.units),
        ("note", status.note),
    )


def _force_values(status: Status | None) -> Values:
    """Figures of the accelerometers as a whole."""
    if status is None:
        return ()
    return (
        ("accelerometers: statistic", _figure(status.statistic)),
        ("accelerometers: threshold", _figure(status.threshold)),
        ("fused specific force", "yes" if status.has_rate else "no"),
        ("protection level (m/s^2)", " ".join(map(_figure, status.protection_level))),
    )


def _late(unit: UnitStatus) -> str:
    if not math.isfinite(unit.delay):
        return "none"
    if unit.name == unit.against:
        return "0 (reference of the other units)"
    return f"{1e3 * unit.delay:.2f} +- {1e3 * unit.delay_std:.2f}"


def _channel_message(
    channel: ChannelStatus, status: Status, worse: Mapping[str, Sequence[str]]
) -> tuple[Level, str]:
    """Return level and words for a channel: its state, and each degradation."""
    wrong = [
        *map(_format_frozen, _frozen_units(channel, status)),
        *worse.get(channel.name, ()),
    ]
    is_far = any(
        one.unit == channel.unit and status.has_implausible_start_bias(one)
        for one in status.channels
    )
    unusual = [
        str(error)
        for error in status.errors
        if error.owner == channel.name
        and error.is_unusual
        # One bias that is a fault makes those of the others look large.
        and not (is_far and error.kind == "bias")
    ]
    level = max(
        _LEVELS.get(channel.state, Level.WARN), Level.WARN if wrong else Level.OK
    )
    return level, "; ".join([_format_state(channel, status), *wrong, *unusual])


def _frozen_units(channel: ChannelStatus, status: Status) -> list[UnitStatus]:
    return [
        unit for unit in status.units if unit.frozen and channel.name in unit.channels
    ]


def _format_state(channel: ChannelStatus, status: Status) -> str:
    # ``since`` is 0 in the initial state of a channel.
    ago = max(0, status.stamp - channel.since) / 1e9
    lasting = f", for {_seconds(ago)}" if ago else ""
    if not channel.since:
        lasting = ", since the start"
    if channel.state == ChannelState.OK:
        return "agrees with the others"
    if channel.state == ChannelState.AMBIGUOUS:
        return f"{_format_set(channel, status)}{lasting}"
    words = channel.reason.value or channel.state.name.lower()
    if channel.reason == Reason.LATELY and not channel.since:
        return (
            "not checked yet; used unchecked" if status.has_rate else "not checked yet"
        )
    size = f"{_figure(abs(channel.error))} {channel.unit}" if channel.error else ""
    if channel.reason == Reason.DISAGREES and size:
        words = f"{words} by {size}"
    if channel.reason == Reason.DRIFTED and size:
        words = f"{words} ({size})"
    if channel.reason == Reason.INTERMITTENT:
        words = f"{words}: delivers in {percent(channel.delivers)} of samples"
    ending = {
        ChannelState.SUSPECT: "suspected, left out for now",
        ChannelState.FAULTY: "isolated and left out",
        ChannelState.UNCHECKED: "still used"
        if status.has_rate
        else "no fused rate yet",
    }
    if channel.is_left_out:
        ending[ChannelState.UNCHECKED] = "left out"
    return f"{words}{lasting}; {ending.get(channel.state, 'left out')}"


def _format_set(channel: ChannelStatus, status: Status) -> str:
    pair = status.apart
    if pair is not None and set(pair.channels) == set(channel.group):
        return f"{pair}: one of the two is faulty, undecided"
    if len(channel.group) == 1:
        return "probably faulty, to be confirmed"
    one_of = f"one of {', '.join(channel.group)} is faulty, undecided"
    return (_format_unit_set(channel.group, status) or one_of) + (
        f"; seen on {pair}" if pair else ""
    )


def _channel_values(
    channel: ChannelStatus, status: Status, k: int, since: int
) -> Values:
    ago = (
        f"{_seconds((status.stamp - channel.last_received) / 1e9)} ago"
        if channel.last_received
        else "never"
    )
    pair = status.apart
    unit = channel.unit
    scales = [
        error
        for error in status.errors
        if error.owner == channel.name and error.kind.startswith("scale")
    ]
    return (
        ("state", channel.state.name),
        ("reason", channel.reason.value),
        ("state since (stamp, s)", f"{since // 10**9}.{since % 10**9:09d}"),
        (
            "one of",
            ", ".join(channel.group) if channel.state == ChannelState.AMBIGUOUS else "",
        ),
        (
            f"apart ({unit})",
            plus_minus(pair.size, pair.std)
            if pair and channel.name in pair.channels
            else "",
        ),
        (f"residual ({unit})", _figure(channel.residual)),
        (f"estimated error ({unit})", _figure(channel.error)),
        (f"bias ({unit})", _figure(status.bias[k]) if k < len(status.bias) else ""),
        (f"of that followed in flight ({unit})", _figure(channel.drift)),
        (
            f"implausible bias ({unit})",
            _figure(channel.start_bias)
            if status.has_implausible_start_bias(channel)
            else "none",
        ),
        (f"bias known to ({unit})", _figure(channel.bias_std)),
        (
            "scale and misalignment (1)",
            ", ".join(
                f"{one.kind[-1]} {one.value:+.4f} +- {one.std:.4f}" for one in scales
            )
            or "none",
        ),
        ("noise (noise_std)", _figure(channel.noise) if channel.noise else "none"),
        (
            "repeats for (s)",
            "".join(_figure(unit.frozen) for unit in _frozen_units(channel, status)),
        ),
        ("last value", ago),
        *((kind, str(count)) for kind, count in channel.counts.items()),
    )


def _input_values(line: InputStatus) -> Values:
    return (
        ("topic", line.topic),
        *([("frame_id", line.frame_now)] if line.frame_now else []),
        ("received", str(line.received)),
        ("rate (Hz)", f"{line.rate:.1f}"),
        ("behind the other inputs (s)", _figure(line.lag)),
        *(
            []
            if line.offset is None
            else [("behind the clock (s)", _figure(line.offset))]
        ),
        *((kind, str(count)) for kind, count in line.counts.items()),
        *([("last malformed", line.error)] if line.error else []),
    )


def frame_words(first: str, now: str) -> str:
    """Return a warning about a topic whose frame_id has changed."""
    return f"frame_id changed from {shown(first)!r} to {shown(now)!r}: another sensor?"


def input_warning(line: InputStatus) -> str:
    """Return what puts the source of an input in doubt while it delivers. Empty: nothing."""
    troubles = []
    if line.parted:
        troubles.append(
            "the clocks of the two inputs differ, and it is unknown which is right: neither is used"
        )
    if line.frame_now != line.frame:
        troubles.append(frame_words(line.frame, line.frame_now))
    if line.sources:
        troubles.append(line.sources)
    return "; ".join(troubles) if line.live else ""


def _input_message(line: InputStatus, more: Sequence[str]) -> tuple[Level, str]:
    troubles = [*more]
    troubles += [
        f"{kind_in_words}: {line.recent[kind]}"
        for kind, kind_in_words in UNUSED_COUNTERS.items()
        if line.recent.get(kind)
    ]
    if line.recent.get("malformed") and line.error:
        troubles.append(line.error)
    if line.lag > line.max_lag:
        troubles.append(
            f"stamps are {_seconds(line.lag)} behind those of the other inputs"
        )
    if line.unstamped:
        troubles.append("stamps are not set")
    elif line.offset is not None and abs(line.offset) > FAR_FROM_NOW:
        side = "behind" if line.offset > 0 else "ahead of"
        why = OLD_WORDS if line.offset > OLD else ""
        troubles.append(
            f"stamps are {_seconds(abs(line.offset))} {side} the clock{why}"
        )
    if warning := input_warning(replace(line, live=True)):
        troubles.append(warning)
    if line.silent is None:
        return Level.STALE, "; ".join([f"no message yet on {line.topic}", *troubles])
    if not line.live:
        silence = (
            "gives no usable message"
            if line.arrives
            else f"silent for {_seconds(line.silent)}"
        )
        return Level.STALE, "; ".join([silence, *troubles])
    return (Level.WARN if troubles else Level.OK), "; ".join(troubles) or "delivers"


def _seconds(value: float) -> str:
    fitting = (row for row in _TIMES if abs(value) < row[2])
    unit, seconds, _, digits = next(fitting)
    return f"{value / seconds:.{digits}f} {unit}"


def _figure(value: float) -> str:
    return figures(value, 4) if math.isfinite(value) else "none"


DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")


def encode_diagnostics(lines: Sequence[StatusLine], now: int) -> bytes:
    """Encode diagnostics, stamped at the clock time now, ns, clipped to the times that a header can hold."""
    # A simulator may publish any clock.
    out = bytearray(
        struct.pack(
            "<4BiI", 0, 1, 0, 0, *divmod(min(max(now, 0), LAST_STAMP), 1_000_000_000)
        )
    )

    def add(content: str | int) -> None:
        data = b"" if isinstance(content, int) else content.encode() + b"\0"
        # The 4 bytes of encapsulation keep the alignment to 4.
        out.extend(
            bytes(-len(out) % 4)
            + struct.pack("<I", content if isinstance(content, int) else len(data))
            + data
        )

    add("")
    add(len(lines))
    for line in lines:
        out.append(line.level)
        for text in (line.name, line.message, line.hardware_id):
            add(text)
        add(len(line.values))
        for text in chain(*line.values):
            add(text)
    return bytes(out)
