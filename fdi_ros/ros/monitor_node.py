"""The live monitor as a managed node: topics in, topics out, services, parameters, diagnostics."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from fdi_ros.core.bias import IN_MOTION, NOT_AT_REST, TOO_FEW
from fdi_ros.core.compiling import announced, refused
from fdi_ros.core.live import HAS_EVENTS, HAS_RATE, MALFORMED, MORE, SUPPLY, WORKED
from fdi_ros.core.messages import LAST_STAMP
from fdi_ros.errors import FdiError
from fdi_ros.monitor.build import alarm_probability
from fdi_ros.monitor.diagnostics import WHOLE, Level, StatusLine, describe
from fdi_ros.monitor.output import ChannelState, Event, Events
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import Receiver
from fdi_ros.monitor.sampling import Sampling
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.monitor.warm import warm_detector
from fdi_ros.mounting.text import gist
from fdi_ros.ros import parameters
from fdi_ros.ros.inputs import Intake, Topic, Watchdog
from fdi_ros.ros.log import log_through
from fdi_ros.ros.messages import OVERRIDABLE, Publishers, message_class, prefix_of

WATCH_PERIOD = 0.05
"""How often silence is looked for, and the state saved if it has changed, s."""
REPORT_EVERY = 20
"""A regular report every so many looks: 1 Hz."""
MAX_AT_ONCE = 20
"""Reports and log lines of changes between two regular reports: a fault that flickers at 1 kHz must cause no flood."""
REMEMBERED = 4096
"""Samples whose latency is remembered."""
END_OF_TIME = 2**62
"""The stamps of the samples have run beyond all clocks, as a clock was set back by decades again and again, ns."""
OWN = {
    "autostart": parameters.own(True, "configure and activate at the start; false: wait for a lifecycle manager"),
    "state_file": parameters.own("", "file that keeps biases and declarations over a restart; empty: none"),
    "state_max_age": parameters.own(3600.0, "a kept state older than this is not taken over [s]"),
}
SUCCESS = TransitionCallbackReturn.SUCCESS
RCLError = rclpy_implementation.RCLError


class MonitorNode(parameters.Judging, LifecycleNode):
    """Gyro fault monitor.

    Raises
    ------
    FdiError
        If a parameter is wrong or the settings do not fit each other.
    """

    def __init__(self, **options: Any) -> None:
        self.intake = Intake(self)
        super().__init__("fdi_node", automatically_declare_parameters_from_overrides=True, **options)
        self.config = parameters.declare(self, OWN, OVERRIDABLE)
        self._prefix = prefix_of(self)
        path, max_age = (self.get_parameter(name).value for name in ("state_file", "state_max_age"))
        self._state = StateFile(Path(path), float(max_age)) if path else None
        log_through(self.get_logger())
        # Built here too, so that settings that do not fit refuse the start and not the first transition.
        self.receiver: Receiver | None = self._build()
        self.outputs: Publishers | None = None
        self.topics: tuple[Topic, ...] = ()
        self._watchdog = Watchdog(round(self.config.health.stale_timeout * 1e9))
        self._at_once = MAX_AT_ONCE
        self._untold = 0
        self._restarts = 0
        self._looks = 0
        self._report_samples = (0, 0)
        self._rate = 0.0
        self._latency = np.zeros(REMEMBERED, dtype=np.int64)
        self._latencies = 0
        self._bias_outcome = -1
        self._sampling = Sampling(self.config.sample_rate)
        self._shifts: dict[int, tuple[int, int]] = {}
        """By channel: stamp of its last change of state, and what of it is no message's, ns."""
        self._service_change_state.callback = partial(self._on_change_state, self._service_change_state.callback)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/relearn_bias", self._on_relearn_bias)

    def _build(self) -> Receiver:
        with announced():
            receiver = Receiver(Pipeline.from_config(self.config))
        if self._state is not None:
            self._state.restore(receiver.pipeline)
            if self._state.left:
                self.get_logger().warning(self._state.words)
            else:
                self.get_logger().info(self._state.words)
        return receiver

    def create_subscription(self, kind: Any, topic: str, callback: Any, *arguments: Any, **options: Any) -> Any:
        """Subscribe; what rclpy makes of /clock is made safe from times that it cannot hold."""
        if kind is ClockMessage:
            callback = partial(self._on_clock, callback)
        return super().create_subscription(kind, topic, callback, *arguments, **options)

    def _on_clock(self, take: Any, message: Any) -> None:
        if message.clock.sec >= 0:
            take(message)
        else:
            words = f"/clock says {message.clock.sec} s, which is before 1970: left aside"
            self.get_logger().error(words, throttle_duration_sec=1.0)

    @property
    def subscriptions(self) -> Iterator[Any]:
        """Subscriptions that an executor is to know."""
        return self.intake.shown(super().subscriptions)

    # Managed node -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Configure and activate without a manager."""
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def _on_change_state(self, change: Any, request: ChangeState.Request, response: Any) -> ChangeState.Response:
        """Answer what cannot be done in the present state; rclpy itself raises, and never answers."""
        try:
            return change(request, response)
        except RCLError as error:
            wanted = request.transition.label or f"transition {request.transition.id}"
            now = self._state_machine.current_state[1]
            self.get_logger().warning(f"{wanted} refused: not possible while {now}")
            self.get_logger().debug(str(error))
            response.success = False
            return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the pipeline and announce the outputs."""
        try:
            self.receiver = self._build() if self.receiver is None else self.receiver
        except FdiError as error:
            self.get_logger().error(f"configure refused: {error}")
            return TransitionCallbackReturn.FAILURE
        self.outputs = Publishers(self)
        self._watch(self.receiver)
        # Silence must be told by the wall, even if the clock of the simulation stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(WATCH_PERIOD, self._on_look, clock=steady)
        return SUCCESS

    def _watch(self, receiver: Receiver) -> None:
        """Look at the inputs of a receiver from now on."""
        names = [parameters.resolved(self, topic) for topic in self.config.topics]
        self.topics = tuple(Topic(receiver, k, name) for k, name in enumerate(names))
        self._restarts, self._bias_outcome = receiver.restarts, -1
        self._sampling = Sampling(self.config.sample_rate)
        self._shifts.clear()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen; what was learned of the time of the samples stays from before."""
        assert self.receiver is not None
        source = self.receiver.source
        kind, take = message_class(source.type), self._take if source.stamped else self._take_arrived
        for k, topic in enumerate(source.topics):
            self.intake.open(kind, topic, partial(take, k))
        pipeline = self.receiver.pipeline
        self.get_logger().info(gist(pipeline.geometry, pipeline.noise, alarm_probability(self.config)))
        names = ", ".join(topic.topic for topic in self.topics)
        self.get_logger().info(f"monitoring {names} with {self.config.detector.name}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; what is known stays."""
        self.intake.close()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self.on_deactivate(state)
        self.save_state()
        if self.outputs is not None:
            self.destroy_timer(self._timer)
            self.outputs.destroy()
        self.outputs, self.receiver, self.topics = None, None, ()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take everything down."""
        return self.on_cleanup(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what a failed transition has left."""
        self.get_logger().error(f"transition from {state.label} failed: the node is unconfigured")
        return self.on_cleanup(state)

    # Samples ------------------------------------------------------------------------------------------------------

    def _take(self, inlet: int, data: bytes) -> None:
        assert self.receiver is not None
        begun = time.perf_counter_ns()
        told = self.receiver.take(inlet, data)
        if told:
            self._tell(told, begun, inlet, data)

    def _take_arrived(self, inlet: int, data: bytes) -> None:
        assert self.receiver is not None
        begun = time.perf_counter_ns()
        # A simulator may say any time: what the header of a message cannot hold is its end.
        told = self.receiver.take(inlet, data, min(self.get_clock().now().nanoseconds, LAST_STAMP))
        if told:
            self._tell(told, begun, inlet, data)

    def _tell(self, told: int, begun: int, inlet: int, data: bytes) -> None:
        """Publish what a message has brought, and go on with all samples that it completes."""
        receiver, outputs = self.receiver, self.outputs
        assert receiver is not None
        assert outputs is not None
        while told:
            if told & SUPPLY:
                receiver.supply()
            if told & HAS_RATE:
                outputs.fused.publish(receiver.fused.tobytes())
            if told & WORKED:
                if outputs.integrity_is_heard:
                    outputs.integrity.publish(receiver.integrity.tobytes())
                self._latency[self._latencies % REMEMBERED] = time.perf_counter_ns() - begun
                self._latencies += 1
            if told & HAS_EVENTS:
                self._tell_events(receiver.events)
            if told & MALFORMED:
                receiver.refused(inlet, data)
            told = receiver.go_on() if told & MORE else 0

    def save_state(self) -> None:
        """Save biases and declarations, if there is a file for them and they have changed."""
        if self._state is not None and self.receiver is not None and self._state.save(self.receiver.pipeline):
            if self._state.failed:
                self.get_logger().error(self._state.words, throttle_duration_sec=60.0)
            else:
                self.get_logger().info(self._state.words)

    def destroy_node(self) -> None:
        """Save the state and take the node down."""
        self.save_state()
        super().destroy_node()

    def _tell_events(self, events: Events) -> None:
        assert self.receiver is not None
        for event in events:
            self._shifts[event.channel] = (event.stamp, self.receiver.shift)
            if self._at_once > 0:
                self._log(event)
            else:
                self._untold += 1
        if self._at_once > 0:
            self._at_once -= 1
            self._report()

    def _log(self, event: Event) -> None:
        assert self.receiver is not None
        names = self.receiver.pipeline.channel_names
        words = event.reason.value
        if event.error:
            words += f" by {abs(event.error):.3g} rad/s"
        if len(event.group) > 1:
            words += f"; one of {', '.join(names[i] for i in event.group)}"
        stamp = event.stamp - self.receiver.shift
        line = f"{names[event.channel]}: {event.before.name} -> {event.after.name} at {stamp / 1e9:.3f} s"
        line += f": {words}" if words else ""
        # The logger refuses another severity from the same line of code.
        if event.declares or event.after == ChannelState.STALE:
            self.get_logger().error(line)
        elif event.after == ChannelState.OK:
            self.get_logger().info(line)
        else:
            self.get_logger().warning(line)

    # Diagnostics --------------------------------------------------------------------------------------------------

    def _on_look(self) -> None:
        self._looks += 1
        assert self.outputs is not None
        self.outputs.look()
        self.save_state()
        now = self.get_clock().now().nanoseconds
        if any(list(self._newly_silent(now))):
            self._report()
        if self.receiver is not None:
            self._look_at_time(self.receiver)
            self._look_at_bias(self.receiver)
        if self._looks % REPORT_EVERY == 0:
            self._report()
            self._regular(now)

    def _look_at_time(self, receiver: Receiver) -> None:
        if receiver.restarts != self._restarts:
            self._restarts = receiver.restarts
            words = "all stamps jumped together, or paused: the time of the samples begins anew"
            self.get_logger().warning(words, throttle_duration_sec=1.0)
        if not 0 <= receiver.live["last_stamp"][0] < END_OF_TIME:
            self.get_logger().error("the clock went back by decades too often: the monitor begins anew")
            self.receiver = self._build()
            self._watch(self.receiver)

    def _look_at_bias(self, receiver: Receiver) -> None:
        """Say where the biases come from, and why not from a time at rest, whenever that changes."""
        outcome = int(receiver.pipeline.core["bias"]["outcome"][0])
        if outcome == self._bias_outcome or not self._samples:
            return
        self._bias_outcome = outcome
        words = f"bias: {receiver.pipeline.status().bias_state}"
        if outcome in (NOT_AT_REST, TOO_FEW, IN_MOTION):
            self.get_logger().warning(words, throttle_duration_sec=1.0)
        else:
            self.get_logger().info(words, throttle_duration_sec=1.0)

    def _newly_silent(self, now: int) -> Iterator[bool]:
        """Look at everything that may fall silent; True for each that changed."""
        if not self.intake.inlets:
            return
        for topic in self.topics:
            changed = topic.watchdog.look(topic.received, now)
            if changed and topic.watchdog.silent and not topic.received:
                self.get_logger().warning(f"{topic.name}: no message yet on {topic.topic}")
            elif changed and topic.watchdog.silent:
                self.get_logger().error(f"{topic.name}: no message on {topic.topic}")
            elif changed:
                again = " again" if topic.was_heard else ""
                self.get_logger().info(f"{topic.name}: messages on {topic.topic}{again}")
            topic.was_heard |= topic.received > 0
            yield changed
        yield self._watchdog.look(self._samples, now)

    @property
    def _samples(self) -> int:
        return 0 if self.receiver is None else int(self.receiver.pipeline.core["samples"][0])

    def _regular(self, now: int) -> None:
        """Begin to count anew what is told between two regular reports."""
        for topic in self.topics:
            topic.reported(now)
        if self._untold:
            self.get_logger().warning(f"and {self._untold} more changes of state")
        count, (samples, before) = self._samples, self._report_samples
        self._rate = 1e9 * (count - samples) / (now - before) if now > before > 0 else 0.0
        self._report_samples = (count, now)
        self._look_at_rate(count)
        self._at_once, self._untold = MAX_AT_ONCE, 0

    def _look_at_rate(self, count: int) -> None:
        """Log when the samples are found to come at another rate than the configured one."""
        if self.receiver is None:
            return
        before = self._sampling.words
        self._sampling.look(count, int(self.receiver.live["last_stamp"][0]))
        if self._sampling.words and not before:
            self.get_logger().warning(self._sampling.words)

    def _report(self) -> None:
        if self.receiver is None or self.outputs is None:
            return
        now = self.get_clock().now().nanoseconds
        hardware = self.config.hardware_id
        if not self.intake.inlets:
            lines = [StatusLine(Level.STALE, self._prefix + WHOLE, "inactive: not monitoring", hardware, ())]
        else:
            silent = self._watchdog.seconds(now) if self._watchdog.silent or not self._samples else None
            inputs = [topic.status(now) for topic in self.topics]
            status = self.receiver.pipeline.status()
            since = [self._message_stamp(i, channel.since) for i, channel in enumerate(status.channels)]
            lines = describe(
                *(status, hardware, self._prefix),
                inputs=inputs,
                figures=self._figures(),
                silent=silent,
                since=since,
                warning=self._sampling.words,
            )
        self.outputs.diagnose(lines, now)

    def _message_stamp(self, channel: int, since: int) -> int:
        """Return the stamp of the message, ns, that brought a channel into its state."""
        stamp, shift = self._shifts.get(channel, (0, 0))
        return since - shift if stamp == since else since

    def _figures(self) -> list[tuple[str, str]]:
        assert self.receiver is not None
        known = self._latency[: min(self._latencies, REMEMBERED)]
        median, late = np.percentile(known, (50, 99), method="lower") / 1e6 if len(known) else (0.0, 0.0)
        return [
            ("sample rate (Hz)", f"{self._rate:.1f}"),
            ("latency p50 (ms)", f"{median:.3f}"),
            ("latency p99 (ms)", f"{late:.3f}"),
            ("samples without fused rate", str(self.receiver.live["without_rate"][0])),
            ("restarts of time", str(self._restarts)),
            *([("state file", self._state.words)] if self._state is not None else []),
        ]

    # Control ------------------------------------------------------------------------------------------------------

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            config = parameters.changed(self.config, changes)
            self._check_detector(config.detector.name)
            if self.receiver is None and config is not self.config:
                # Unconfigured: so that what does not fit is refused now, and not at the next transition.
                Pipeline.from_config(config)
            if self.receiver is not None and config is not self.config:
                self.intake.drain()
                with announced():
                    self.receiver.pipeline.reconfigure(config)
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if config is not self.config:
            self.get_logger().info(f"changed: {', '.join(f'{p.name} = {p.value}' for p in changes)}")
        self.config = config
        return SetParametersResult(successful=True)

    def _check_detector(self, name: str) -> None:
        """Refuse a detector that must be compiled first: meanwhile an active node would be deaf."""
        if self.intake.inlets and name != self.config.detector.name:
            words = f"detector {name} is not compiled yet, which would stop the monitor for up to a minute"
            with refused(f"{words}: run fdi compile first, or deactivate the node"):
                warm_detector(name)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.receiver is not None
        response.message = "not configured"
        if self.receiver is not None:
            declared = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
            names = [c.name for c in self.receiver.pipeline.status().channels if c.state in declared]
            self.receiver.pipeline.reset()
            response.message = f"cleared: {', '.join(names) or 'nothing was declared'}"
            self.get_logger().info(f"reset; {response.message}")
        return response

    def _on_relearn_bias(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = self._why_not_at_rest()
        response.success = not refusal
        response.message = f"refused: {refusal}" if refusal else "learning the bias; keep the vehicle at rest"
        if not refusal and self.receiver is not None:
            self.receiver.pipeline.relearn_bias()
        self.get_logger().info(f"relearn_bias: {response.message}")
        return response

    def _why_not_at_rest(self) -> str:
        """Say why the bias cannot be learned now; empty if it can."""
        if self.receiver is None or not self.intake.inlets or self._watchdog.silent or not self._samples:
            return "no samples"
        rate = float(np.linalg.norm(self.receiver.rate))
        if not np.isfinite(rate):
            return "no fused rate, so nothing says that the vehicle is at rest"
        limit = self.config.bias.max_rest_rate
        return f"in motion, {rate:.3g} rad/s, expected at most {limit:g} rad/s" if rate > limit else ""
