"""What an operator is told: level, words and figures for every channel, every input and the whole."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from fdi_ros.monitor.output import ChannelState, ChannelStatus, Reason, Status

PREFIX = "fdi_ros: "
WHOLE = PREFIX + "monitor"
FAR_FROM_NOW = 1.0
"""Stamps further than this from the clock of the monitor are not of this clock, s."""


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class StatusLine:
    """One diagnostic_msgs/DiagnosticStatus."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class InputStatus:
    """One input topic as it stands."""

    name: str
    topic: str
    received: int
    rate: float
    """Messages a second, lately."""
    silent: float | None
    """Since the last message, s; None: there was none yet."""
    live: bool
    """Whether it speaks, by the stamps of the others and by the clock."""
    arrives: bool = False
    """Whether messages arrive, of use or not."""
    lag: float = 0.0
    """How far its stamps stay behind those of the other inputs, s."""
    max_lag: float = math.inf
    """What is still one instant, s."""
    offset: float | None = None
    """Clock of the monitor minus its last stamp, s; None: its messages carry no stamp."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """All that was not taken as it came, by kind."""
    recent: Mapping[str, int] = field(default_factory=dict)
    """The same since the last regular report."""
    error: str = ""
    """Why the last malformed message was refused."""


_LEVELS = {
    ChannelState.OK: Level.OK,
    ChannelState.SUSPECT: Level.WARN,
    ChannelState.AMBIGUOUS: Level.ERROR,
    ChannelState.FAULTY: Level.ERROR,
    ChannelState.STALE: Level.STALE,
    ChannelState.UNCHECKED: Level.WARN,
    ChannelState.EXCLUDED: Level.WARN,
}
_ODD = {
    "malformed": "malformed messages",
    "duplicate": "stamps repeated",
    "backward": "stamps going back",
    "jumped": "stamps far ahead of all",
    "late": "messages too late for their sample",
}


def describe(
    status: Status,
    hardware_id: str = "",
    *,
    inputs: Sequence[InputStatus] = (),
    figures: Sequence[tuple[str, str]] = (),
    silent: float | None = None,
) -> list[StatusLine]:
    """Describe a monitor: the whole first, then every channel, then every input.

    Parameters
    ----------
    status
        Of the pipeline.
    hardware_id
        Of the sensors.
    inputs
        The input topics, where there are any.
    figures
        More key-values for the whole.
    silent
        No sample for this long, s: all is STALE. None: samples come.
    """
    whole = StatusLine(*_whole(status, silent), hardware_id, (*_whole_values(status), *figures))
    channels = []
    for k, channel in enumerate(status.channels):
        level, message = _LEVELS[channel.state], channel_message(channel, status.stamp)
        if silent is not None:
            level, message = Level.STALE, _no_sample(status, silent)
        name = PREFIX + channel.name
        channels.append(StatusLine(level, name, message, hardware_id, _channel_values(channel, status, k)))
    return [whole, *channels, *(_input_line(line, hardware_id) for line in inputs)]


def channel_message(channel: ChannelStatus, now: int) -> str:
    """Say in words how a channel stands at the stamp now, ns."""
    # No sample has changed the state that a channel starts in.
    lasting = f"for {_seconds(max(0, now - channel.since) / 1e9)}" if channel.since else "since the start"
    if channel.state == ChannelState.OK:
        return "agrees with the others"
    if channel.state == ChannelState.AMBIGUOUS:
        return f"one of {', '.join(channel.group)} is faulty, the evidence cannot tell which; {lasting}"
    words = channel.reason.value or channel.state.name.lower()
    if channel.reason == Reason.DISAGREES:
        words = f"{words} by {_figure(abs(channel.error))} rad/s"
    ending = {
        ChannelState.SUSPECT: "; under suspicion, left out for now",
        ChannelState.FAULTY: "; isolated and left out",
        ChannelState.UNCHECKED: "; used unchecked",
    }
    return f"{words} {lasting}{ending.get(channel.state, '; left out')}"


def _no_sample(status: Status, silent: float) -> str:
    return f"no sample for {_seconds(silent)}" if status.samples else "no sample yet"


def _whole(status: Status, silent: float | None) -> tuple[Level, str, str]:
    if silent is not None:
        return Level.STALE, WHOLE, _no_sample(status, silent)
    total = len(status.channels)
    healthy = sum(channel.state == ChannelState.OK for channel in status.channels)
    count = f"{healthy} of {total} channels healthy"
    alive = sum(
        channel.state not in (ChannelState.FAULTY, ChannelState.STALE, ChannelState.EXCLUDED)
        for channel in status.channels
    )
    reach = _reach(len(status.can_detect), len(status.can_isolate), alive)
    note = f"; {status.note}" if status.note else ""
    if not status.has_rate:
        return Level.ERROR, WHOLE, f"no fused rate: {count}{note}"
    if not status.can_detect:
        return Level.ERROR, WHOLE, f"{count}; {reach}{note}"
    complete = healthy == total and len(status.can_isolate) == total
    return (Level.OK if complete else Level.WARN), WHOLE, f"{count}; {reach}{note}"


def _reach(detect: int, isolate: int, alive: int) -> str:
    if not detect:
        return "no further fault would be seen"
    seen = "any further fault would be seen" if detect == alive else f"a fault would be seen on {detect} of {alive}"
    named = {0: "but not isolated", alive: "and isolated"}.get(isolate, f"and isolated on {isolate} of {alive}")
    return f"{seen} {named}"


def _whole_values(status: Status) -> tuple[tuple[str, str], ...]:
    return (
        ("detector", status.detector),
        ("statistic", _figure(status.statistic)),
        ("threshold", _figure(status.threshold)),
        ("samples", str(status.samples)),
        ("fused rate", "yes" if status.has_rate else "no"),
        ("faults seen on", ", ".join(status.can_detect) or "none"),
        ("faults isolated on", ", ".join(status.can_isolate) or "none"),
        ("protection level (rad/s)", _figures(status.protection_level)),
        ("protection level after one more loss (rad/s)", _figures(status.protection_level_after_loss)),
        ("bias", status.bias_state),
        ("note", status.note),
    )


def _channel_values(channel: ChannelStatus, status: Status, k: int) -> tuple[tuple[str, str], ...]:
    ago = f"{_seconds((status.stamp - channel.last_received) / 1e9)} ago" if channel.last_received else "never"
    return (
        ("state", channel.state.name),
        ("reason", channel.reason.value),
        ("state since (stamp, s)", _stamp(channel.since)),
        ("one of", ", ".join(channel.group) if channel.state == ChannelState.AMBIGUOUS else ""),
        ("residual (rad/s)", _figure(channel.residual)),
        ("estimated error (rad/s)", _figure(channel.error)),
        ("bias (rad/s)", _figure(status.bias[k]) if k < len(status.bias) else ""),
        ("last value", ago),
        ("samples", str(channel.samples)),
        ("missing", str(channel.missing)),
        ("non-finite", str(channel.non_finite)),
        ("out of range", str(channel.out_of_range)),
        ("stuck", str(channel.stuck)),
    )


def _input_line(line: InputStatus, hardware_id: str) -> StatusLine:
    values = [("topic", line.topic), ("received", str(line.received)), ("rate (Hz)", f"{line.rate:.1f}")]
    values += [("behind the other inputs (s)", _figure(line.lag))]
    if line.offset is not None:
        values += [("behind the clock (s)", _figure(line.offset))]
    values += [(kind, str(count)) for kind, count in line.counts.items()]
    if line.error:
        values += [("last malformed", line.error)]
    return StatusLine(*_input_message(line), hardware_id, tuple(values))


def _input_message(line: InputStatus) -> tuple[Level, str, str]:
    name = f"{PREFIX}input {line.name}"
    odd = [f"{kind_in_words} ({line.recent[kind]})" for kind, kind_in_words in _ODD.items() if line.recent.get(kind)]
    if line.lag > line.max_lag:
        odd.append(f"stamps stay {_seconds(line.lag)} behind the other inputs'")
    if line.offset is not None and abs(line.offset) > FAR_FROM_NOW:
        side = "behind" if line.offset > 0 else "ahead of"
        odd.append(f"stamps are {_seconds(abs(line.offset))} {side} the clock")
    if line.silent is None:
        return Level.STALE, name, "; ".join([f"no message yet on {line.topic}", *odd])
    if not line.live:
        silence = "gives nothing that can be used" if line.arrives else f"silent for {_seconds(line.silent)}"
        return Level.STALE, name, "; ".join([silence, *odd])
    return (Level.WARN if odd else Level.OK), name, "; ".join(odd) or "delivers"


def _seconds(value: float) -> str:
    if abs(value) < 0.1:
        return f"{1e3 * value:.1f} ms"
    return f"{value:.1f} s" if abs(value) < 600 else f"{value / 60:.0f} min"


def _figure(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "none"


def _figures(values: Sequence[float]) -> str:
    return " ".join(_figure(value) for value in values)


def _stamp(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"
