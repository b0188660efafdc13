# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What exists only while the node is configured: the path of a message, and the supervision of the monitor."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from fdi_ros.core.bias import IN_MOTION, NOT_AT_REST, TOO_FEW
from fdi_ros.core.live import (
    AHEAD_OF_CLOCK,
    HAS_EVENTS,
    HAS_RATE,
    MALFORMED,
    MORE,
    NO_STAMP,
    SUPPLY,
    WORKED,
)
from fdi_ros.core.messages import LAST_STAMP, frame_of
from fdi_ros.core.sources import SOURCES
from fdi_ros.monitor.diagnostics import (
    MONITOR_LINE,
    OLD,
    InputStatus,
    Level,
    StatusLine,
    describe,
    encode_diagnostics,
    frame_words,
)
from fdi_ros.monitor.inputs import other_input
from fdi_ros.monitor.output import OUTPUTS, ChannelState, Event, format_reason
from fdi_ros.monitor.receiver import (
    Receiver,
    SampleRateCheck,
    SilenceClock,
    Watchdog,
)
from fdi_ros.monitor.recent import RecentHealth
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.monitor.status import ApartStatus, Status
from fdi_ros.ros.node import OVERRIDABLE, REPORT_PERIOD, BoundedLog, CheckedNode
from fdi_ros.system.text import LINE, figures, shown

MAX_AT_ONCE = 20  # reports of changes between two regular reports: a fault that flickers at 1 kHz must cause no flood


class _ReportTimes(NamedTuple):
    """Ages of messages and of lines from which on something is reported, s."""

    #: age from which the newest judged sample is reported: several times the time
    #: that the slowest link and the alignment take. A starved computer, or clocks
    #: that differ, look like this
    late_sample: float = 0.5
    #: messages arrive if the last one is younger than this, two checks
    arrives: float = 0.1
    #: after a line about a channel, time until the next one unless its state gets
    #: worse
    quiet: float = 5.0


REPORT_TIMES = _ReportTimes()

NAMED = 4  # publishers of one topic that are named at most
BY_SEVERITY = (
    "OK",
    "EXCLUDED",
    "UNCHECKED",
    "SUSPECT",
    "STALE",
    "AMBIGUOUS",
    "FAULTY",
)  # states, the worst last


@dataclass
class _Line:
    """The last line of the log about a channel."""

    #: as logged
    state: ChannelState = ChannelState.UNCHECKED
    #: when the next line may come, s
    until: float = 0.0
    #: number of changes since then that were not logged
    left_out: int = 0
    #: state after these changes
    present: ChannelState = ChannelState.UNCHECKED


class ChangeLog:
    """Logs changes of state: channels that change alike in one line, and of each channel seldom more than a few."""

    def __init__(
        self,
        log: BoundedLog,
        names: Sequence[str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log = log
        self._names = names
        self._clock = clock
        self._last = [_Line() for _ in names]

    def grow(self, names: Sequence[str]) -> None:
        """Take channels behind those that there were."""
        self._last += [_Line() for _ in names[len(self._names) :]]
        self._names = names

    def add(
        self, events: Sequence[Event], shift: int, pair: ApartStatus | None
    ) -> None:
        """Log the changes of a sample, stamped in ns less the shift.

        The pair is the two channels of a set that surely differ.
        """
        now = self._clock()
        lines: dict[tuple[ChannelState, str], list[int]] = {}
        for event in events:
            last = self._last[event.channel]
            if now < last.until and BY_SEVERITY.index(
                event.after.name
            ) <= BY_SEVERITY.index(last.state.name):
                last.left_out = last.left_out + 1
                last.present = event.after
                continue
            words = format_reason(event, self._names)
            words += f"; {pair}" if pair is not None and len(event.group) > 1 else ""
            at = (event.stamp - shift) / 1e9
            line = f"{event.before.name} -> {event.after.name} at {at:.3f} s"
            lines.setdefault(
                (event.after, f"{line}{words and ': '}{words}"), []
            ).append(event.channel)
        for (state, words), channels in lines.items():
            self._write(state, channels, words)

    def check(self) -> None:
        """Log where the channels are now that have changed since their last line."""
        now = self._clock()
        lines: dict[ChannelState, list[int]] = {}
        for channel, last in enumerate(self._last):
            if last.left_out and now >= last.until:
                lines.setdefault(last.present, []).append(channel)
        for state, channels in lines.items():
            most = max(self._last[channel].left_out for channel in channels)
            self._write(
                state,
                channels,
                f"{state.name} now, after {most} more change{'s' if most > 1 else ''}",
            )

    def _write(self, state: ChannelState, channels: Sequence[int], words: str) -> None:
        for channel in channels:
            self._last[channel] = _Line(state, self._clock() + REPORT_TIMES.quiet)
        line = f"{', '.join(self._names[channel] for channel in channels)}: {words}"
        if state.name in BY_SEVERITY[-3:]:
            self._log.error(line)
        elif state is ChannelState.OK:
            self._log.info(line)
        else:
            self._log.warning(line)


class InputTopic:
    """Status of one input topic of a monitor, by its number among the topics of the receiver."""

    def __init__(self, receiver: Receiver, number: int, topic: str) -> None:
        self.topic = topic
        self._receiver = receiver
        self._number = number
        self._inlet = receiver.live["inlets"][0, number]
        self._name = receiver.source.names[number]
        self._watchdog = Watchdog(round(receiver.source.timeout * 1e9))
        self._was_heard = self._was_unstamped = self._was_ahead = False
        self.last = b""  # message
        self._frame = ""  # frame_id of the first message
        self._frame_now = ""  # last frame_id read
        self._sources = ""  # faults of its publishers, in words, or empty
        self._reported_counts: dict[str, int] = {}

    @property
    def _misses_imus(self) -> bool:
        # The default input is an array, which nobody publishes where IMUs are meant.
        source = self._receiver.source
        return not source.stamped and not self._inlet["received"]

    @property
    def _is_unstamped(self) -> bool:
        # One may be of 0 s, not several.
        return (
            self._inlet["stamp"] == 0
            and self._receiver.counts(self._number).get("duplicate", 0) > 0
        )

    def status(self, now: int) -> InputStatus:
        """Describe the topic at the clock time now, ns."""
        counts = self._receiver.counts(self._number)
        receiver = self._receiver
        watchdog = self._watchdog
        received, stamp, lag = (
            int(self._inlet[name]) for name in ("received", "stamp", "lag")
        )
        return InputStatus(
            name=self._name,
            topic=self.topic,
            received=received,
            rate=watchdog.rate,
            silent=watchdog.seconds(now) if received else None,
            live=receiver.alignment.is_live(self._number) and not watchdog.silent,
            arrives=watchdog.seconds(now) < REPORT_TIMES.arrives,
            lag=max(lag, 0) / 1e9,
            max_lag=receiver.source.max_lag,
            offset=None if stamp == NO_STAMP else (watchdog.at - stamp) / 1e9,
            counts=counts,
            recent={
                kind: count - self._reported_counts.get(kind, 0)
                for kind, count in counts.items()
            },
            error=receiver.errors[self._number],
            unstamped=self._is_unstamped,
            parted=receiver.alignment.are_parted,
            frame=self._frame,
            frame_now=self._frame_now,
            sources=self._sources,
        )

    def check(self, now: int, log: BoundedLog) -> bool:
        """Log changes at the clock time now, ns.

        Return whether the topic fell silent or came back.
        """
        received = int(self._inlet["received"])
        changed = self._watchdog.check(received, now)
        self._check_frame(log)
        if changed and not self._watchdog.silent:
            again = " again" if self._was_heard else ""
            frame = f", frame_id {shown(self._frame_now)}" if self._frame_now else ""
            log.info(f"{self._name}: messages on {self.topic}{again}{frame}")
        elif changed and not received:
            log.warning(f"{self._name}: no message yet on {self.topic}")
        elif changed:
            log.error(f"{self._name}: no message on {self.topic}")
        self._was_heard |= received > 0
        if self._is_unstamped and not self._was_unstamped:
            self._was_unstamped = True
            log.warning(f"{self.topic}: stamps are not set")
        if not self._was_ahead and self._receiver.counts(self._number).get("ahead"):
            self._was_ahead = True
            log.warning(
                f"{self.topic}: stamps are more than {AHEAD_OF_CLOCK / 1e9:g} s ahead"
                " of the clock: such messages are refused"
            )
        return changed

    def _check_frame(self, log: BoundedLog) -> None:
        """Log when the frame_id of the messages becomes another."""
        if not self._receiver.source.stamped or not self.last:
            return
        frame = frame_of(self.last)
        self._frame = self._frame or frame
        if frame != self._frame_now and frame != self._frame:
            log.warning(f"{self.topic}: {frame_words(self._frame, frame)}")
        self._frame_now = frame

    def check_sources(
        self, node: CheckedNode, inputs: Sequence[InputTopic], log: BoundedLog
    ) -> None:
        """Log when the topic gets a second publisher, is read twice, or has none but IMUs do."""
        before = self._sources
        self._sources = ""
        first = next(one for one in inputs if one.topic == self.topic)
        if first is not self:
            self._sources = (
                f"{self._name} and {first._name} read the same topic {self.topic}"
            )
        elif len(found := node.get_publishers_info_by_topic(self.topic)) > 1:
            names = sorted(
                f"{one.node_namespace.rstrip('/')}/{one.node_name}"
                for one in found[:NAMED]
            )
            self._sources = shown(
                f"{len(found)} publishers on {self.topic}, expected one: {', '.join(names)}",
                LINE,
            )
        elif self._misses_imus:
            self._sources = _imus_instead(node, self.topic)
        if self._sources and self._sources != before:
            log.warning(self._sources)

    def count_anew(self, now: int) -> None:
        """Restart the counts of recent messages at the clock time now, ns."""
        self._watchdog.measure(int(self._inlet["received"]), now)
        self._reported_counts = self._receiver.counts(self._number)
        self._inlet["lag"] = NO_STAMP


def _imus_instead(node: CheckedNode, topic: str) -> str:
    """Return that no array is published on a topic, but IMU topics are. Empty: not so."""
    imu = SOURCES["imus"].type
    kinds = [
        (name, one.topic_type)
        for name, types in node.get_topic_names_and_types()
        if imu in types
        for one in node.get_publishers_info_by_topic(name)
        if one.topic_type == imu
    ]
    found = other_input(SOURCES["channels"].type, list(dict.fromkeys(kinds)))
    return shown(f"no array on {topic}, but {found}", LINE) if found else ""


class Running:
    """A configured monitor: the path of its messages, its outputs, and its reports to an operator."""

    def __init__(
        self, node: CheckedNode, receiver: Receiver, state_file: StateFile | None
    ) -> None:
        self._node = node
        self._state_file = state_file
        self._outputs = {
            output: node.create_output(
                output.topic.type, output.topic.name, **OVERRIDABLE
            )
            for output in OUTPUTS
        }
        self._diagnostics = node.create_diagnostics()
        # Of the last samples, ns: enough for the 99 % quantile of a report.
        self._latencies: deque[int] = deque(maxlen=4096)
        self.start(receiver)

    def start(self, receiver: Receiver) -> None:
        """Run a monitor from now on, its first or another one."""
        config = receiver.pipeline.config
        self.receiver = receiver
        self.topics = [
            InputTopic(receiver, k, self._node.resolved(topic))
            for k, topic in enumerate(config.topics)
        ]
        self._count_subscribers()
        self._changes = ChangeLog(self._node.log, receiver.pipeline.channel_names)
        self._watchdog = Watchdog(round(config.stale_timeout * 1e9))
        self._rate_check = SampleRateCheck(config.sample_rate)
        self._silence_clock = SilenceClock()
        self._clock_stood = False  # in the log
        self._due = 0.0  # steady time of the next regular report, s: the first at once
        self._at_once = (
            MAX_AT_ONCE  # reports of changes left before the next regular one
        )
        self._restarts = receiver.restarts
        self._bias_outcome = -1
        self._health = RecentHealth()
        self._changed = [(0, 0)] * len(receiver.pipeline.channel_names)
        """By channel: stamps in ns of the sample that last changed its state, and of the message behind that sample."""

    def close(self) -> None:
        """Take the topics down."""
        for publisher in (*self._outputs.values(), self._diagnostics):
            self._node.destroy_publisher(publisher)

    # The path of a message ------------------------------------------------------------
    # ----------------------------

    def listen(self) -> None:
        """Subscribe to the input topics."""
        source = self.receiver.source
        for k, topic in enumerate(source.topics):
            self._node.inputs.open(source.type, topic, partial(self._take, k))

    def _take(self, inlet: int, data: bytes) -> None:
        """Take in a message, and publish the results of all samples that the message completes."""
        begun = time.perf_counter_ns()
        receiver = self.receiver
        self.topics[inlet].last = data
        # The clock of a simulator may have any time: what the header of a message
        # cannot hold is its end.
        result = receiver.receive(
            inlet, data, min(self._node.get_clock().now().nanoseconds, LAST_STAMP)
        )
        while result:
            if result & SUPPLY:
                receiver.supply()
            for flag, output, publisher in self._wanted:
                if result & flag:
                    publisher.publish(receiver.message(output))
            if result & WORKED:
                self._latencies.append(time.perf_counter_ns() - begun)
            if result & HAS_EVENTS:
                self._report_events(receiver.events)
            if result & MALFORMED:
                receiver.refused(inlet, data)
            result = receiver.go_on() if result & MORE else 0

    def _report_events(self, events: Sequence[Event]) -> None:
        """Log and report changes of state, up to a limit."""
        self._learn_channels()
        in_sets = any(event.after == ChannelState.AMBIGUOUS for event in events)
        pair = self.receiver.pipeline.status().apart if in_sets else None
        for event in events:
            self._changed[event.channel] = (
                event.stamp,
                event.stamp - self.receiver.shift,
            )
        self._changes.add(events, self.receiver.shift, pair)
        if self._at_once > 0:
            self._at_once -= 1
            self._report()

    def _learn_channels(self) -> None:
        """Take in the accelerometers, which the first samples show."""
        names = self.receiver.pipeline.channel_names
        if len(names) > len(self._changed):
            self._changed += [(0, 0)] * (len(names) - len(self._changed))
            self._changes.grow(names)
            self._node.log.info("accelerometers are judged, too")

    # Supervision ----------------------------------------------------------------------
    # ----------------------------

    def check(self) -> None:
        """Check for changes. Call this many times in each period of the reports."""
        self._count_subscribers()
        now = self._now()
        log = self._node.log
        self._check_clock()
        is_open = bool(self._node.inputs.subscriptions)
        changes = [topic.check(now, log) for topic in self.topics] if is_open else []
        if is_open and (self._watchdog.check(self._samples, now) or any(changes)):
            self._report()
        if self.receiver.restarts != self._restarts:
            self._restarts = self.receiver.restarts
            log.warning(
                "all stamps jumped together, or paused: the time of the samples begins anew"
            )
        self._check_bias()
        self._changes.check()
        if (steady := time.monotonic()) >= self._due:
            # One that came late is not made up for.
            self._due = max(self._due, steady - REPORT_PERIOD) + REPORT_PERIOD
            for topic in self.topics if is_open else ():
                topic.check_sources(self._node, self.topics, log)
            self._read_health(now)
            self._report()
            self._count_anew(now)

    def _read_health(self, now: int) -> None:
        """Read what channels and units delivered, once in the period of the reports."""
        inputs = [topic.status(now) for topic in self.topics]
        self._health.add(self.receiver.pipeline.status(), inputs, now * 1e-9)

    def _now(self) -> int:
        """Return the time by which silence is judged, ns."""
        clock = self._node.get_clock().now().nanoseconds
        return self._silence_clock.read(clock, time.monotonic_ns())

    def _check_clock(self) -> None:
        """Log when the clock stops and when the clock runs again."""
        words = self._clock_words()
        if bool(words) != self._clock_stood:
            self._clock_stood = bool(words)
            if words:
                self._node.log.warning(words)
            else:
                self._node.log.info("the clock runs again")

    def _clock_words(self) -> str:
        """Return the fault of the clock in words, empty while the clock runs."""
        if not self._silence_clock.standing:
            return ""
        if self._node.get_clock().now().nanoseconds == 0:
            return "no time on /clock, and use_sim_time is true: times are unknown"
        return (
            f"the clock has stood still for {self._silence_clock.standing:.0f} s, and"
            " use_sim_time is true: times are unknown"
        )

    def _warnings(self, status: Status, clock: int) -> tuple[str, str, str]:
        """Return warnings about the whole at a clock time, ns: sample rate, clock, age of the samples."""
        age = self._age(status, clock)
        old = REPORT_TIMES.late_sample < age <= OLD and not self._has_no_samples
        return (
            self._rate_check.words,
            self._clock_words(),
            f"the newest judged sample is {age:.1f} s old" if old else "",
        )

    def _age(self, status: Status, clock: int) -> float:
        """Return how long before a clock time, ns, the newest judged sample was measured, by its stamp, s."""
        return (clock - status.stamp + self.receiver.shift) / 1e9

    def why_not_at_rest(self) -> str:
        """Return why the bias cannot be learned now, empty if learning is possible."""
        if not self._node.inputs.subscriptions or self._has_no_samples:
            return "no samples"
        rate = float(np.linalg.norm(self.receiver.pipeline.core["last"]["rate"][0]))
        if not np.isfinite(rate):
            return "no fused rate, so nothing says that the vehicle is at rest"
        limit = self.receiver.pipeline.config.bias.max_rest_rate
        return (
            f"in motion, {figures(rate)} rad/s, expected at most {limit:g} rad/s"
            if rate > limit
            else ""
        )

    @property
    def _samples(self) -> int:
        return int(self.receiver.pipeline.core["samples"][0])

    @property
    def _has_no_samples(self) -> bool:
        return self._watchdog.silent or not self._samples

    def _count_subscribers(self) -> None:
        """Find the outputs to publish: those with subscribers, and those that are always published."""
        self._wanted = [
            (HAS_RATE if output.needs_rate else WORKED, output, publisher)
            for output, publisher in self._outputs.items()
            if not output.on_demand or publisher.get_subscription_count() > 0
        ]

    def _check_bias(self) -> None:
        """Log where the biases come from, and why not from a time at rest, whenever that changes."""
        pipeline = self.receiver.pipeline
        log = self._node.log
        outcome = int(pipeline.core["bias"]["outcome"][0])
        if outcome != self._bias_outcome and self._samples:
            self._bias_outcome = outcome
            say = (
                log.warning
                if outcome in (NOT_AT_REST, TOO_FEW, IN_MOTION)
                else log.info
            )
            say(f"bias: {pipeline.status().bias_state}")

    def _count_anew(self, now: int) -> None:
        """Begin a new time between two regular reports."""
        for topic in self.topics:
            topic.count_anew(now)
        self._watchdog.measure(self._samples, now)
        self._at_once = MAX_AT_ONCE
        was_wrong = self._rate_check.words
        self._rate_check.check(self._samples, self.receiver.last_stamp)
        if self._rate_check.words and not was_wrong:
            self._node.log.warning(self._rate_check.words)

    def _report(self) -> None:
        """Publish the diagnostics."""
        self._learn_channels()
        clock = self._node.get_clock().now().nanoseconds
        now = self._now()
        prefix = self._node.prefix
        if not self._node.inputs.subscriptions:
            hardware = self.receiver.pipeline.config.hardware_id
            lines = [
                StatusLine(
                    Level.STALE,
                    prefix + MONITOR_LINE,
                    "inactive: not monitoring",
                    hardware,
                )
            ]
        else:
            status = self.receiver.pipeline.status()
            lines = describe(
                *(status, prefix),
                inputs=[topic.status(now) for topic in self.topics],
                figures=[
                    *self._figures(),
                    (
                        "age of the last sample (s)",
                        f"{self._age(status, clock):.3f}" if status.samples else "none",
                    ),
                ],
                silent=self._watchdog.seconds(now) if self._has_no_samples else None,
                since=[
                    message if sample == channel.since else channel.since
                    for channel, (sample, message) in zip(
                        status.channels, self._changed, strict=True
                    )
                ],
                warning="; ".join(filter(None, self._warnings(status, clock))),
                concerns=self._health.concerns,
            )
        self._diagnostics.publish(encode_diagnostics(lines, clock))

    def _figures(self) -> list[tuple[str, str]]:
        median, late = (
            np.percentile(np.array(self._latencies or [0]), (50, 99), method="lower")
            / 1e6
        )
        return [
            ("sample rate (Hz)", f"{self._watchdog.rate:.1f}"),
            ("latency p50 (ms)", f"{median:.3f}"),
            ("latency p99 (ms)", f"{late:.3f}"),
            ("samples without fused rate", str(self.receiver.live["without_rate"][0])),
            ("restarts of time", str(self._restarts)),
            *(
                [("state file", self._state_file.words)]
                if self._state_file is not None
                else []
            ),
        ]
