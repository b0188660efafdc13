"""The live monitor as a managed node: topics in, topics out, services, parameters, diagnostics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from fdi_ros.errors import FdiError
from fdi_ros.monitor.alignment import Sample
from fdi_ros.monitor.build import alarm_probability
from fdi_ros.monitor.diagnostics import WHOLE, Level, StatusLine, describe
from fdi_ros.monitor.output import ChannelState, Event, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.ros import parameters
from fdi_ros.ros.inputs import ChannelsInput, ImusInput, Inlet, Input, Silence, drain
from fdi_ros.ros.live import Live
from fdi_ros.ros.messages import Publishers
from fdi_ros.study.mounting_text import gist

WATCH_PERIOD = 0.05
"""How often silence is looked for, s."""
REPORT_EVERY = 20
"""A regular report every so many looks: 1 Hz."""
MAX_AT_ONCE = 20
"""Reports and log lines of changes between two regular reports: a fault that flickers at 1 kHz floods nobody."""
OWN = {"autostart": parameters.own(True, "configure and activate at the start; false: wait for a lifecycle manager")}
SUCCESS = TransitionCallbackReturn.SUCCESS


class MonitorNode(LifecycleNode):
    """Gyro fault monitor.

    Raises
    ------
    FdiError
        If a parameter is wrong or the settings do not fit each other.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("fdi_node", automatically_declare_parameters_from_overrides=True, **options)
        self.config = parameters.declare(self, OWN)
        # Built here too, so that settings that do not fit refuse the start and not the first transition.
        self.live: Live | None = Live(Pipeline.from_config(self.config))
        self.outputs: Publishers | None = None
        self.input: Input | None = None
        self._inlets: list[Inlet] = []
        """None while inactive."""
        self._silence = Silence(round(self.config.health.stale_timeout * 1e9))
        self._at_once = MAX_AT_ONCE
        self._untold = 0
        self._restarts = 0
        self._looks = 0
        self._without_rate = 0
        self._report_samples = (0, 0)
        self._rate = 0.0
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/relearn_bias", self._on_relearn_bias)

    # Managed node -------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the pipeline and announce the outputs."""
        self.live = Live(Pipeline.from_config(self.config)) if self.live is None else self.live
        channels = self.live.pipeline.geometry.n
        self.outputs = Publishers(self, self.config.body_frame, channels)
        if self.config.input == "channels":
            self.input = ChannelsInput(self.get_clock(), self.config, channels, self._take)
        else:
            self.input = ImusInput(self.config, channels, self._take)
        self._restarts = 0
        # Silence must be told by the wall, even if the clock of the simulation stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(WATCH_PERIOD, self._on_look, clock=steady)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen."""
        assert self.input is not None
        assert self.live is not None
        self._inlets = self.input.subscribe(self)
        pipeline = self.live.pipeline
        self.get_logger().info(gist(pipeline.geometry, pipeline.noise, alarm_probability(self.config)))
        self.get_logger().info(f"monitoring {', '.join(self.config.topics)} with {self.config.detector.name}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; what is known stays."""
        for inlet in self._inlets:
            self.destroy_subscription(inlet.subscription)
        self._inlets = []
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self.on_deactivate(state)
        if self.outputs is not None:
            self.destroy_timer(self._timer)
            self.outputs.destroy()
        self.outputs = self.live = self.input = None
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take everything down."""
        return self.on_cleanup(state)

    # Samples ------------------------------------------------------------------------------------------------------

    def _take(self, sample: Sample) -> None:
        assert self.live is not None
        self.live.take(sample)

    def work(self) -> None:
        """Work all samples that have arrived and publish what comes of them."""
        if self.live is None or self.outputs is None:
            return
        drain(self._inlets)
        for output, shifts in self.live.work():
            self._without_rate += self.outputs.publish_rate(output, shifts)
            if self.outputs.integrity_is_heard:
                self.outputs.publish_integrity(output, self.live.pipeline.protection(output))
            if output.events:
                self._tell(output)

    def _tell(self, output: Output) -> None:
        for event in output.events:
            if self._at_once > 0:
                self._log(event)
            else:
                self._untold += 1
        if self._at_once > 0:
            self._at_once -= 1
            self._report()

    def _log(self, event: Event) -> None:
        assert self.live is not None
        names = self.live.pipeline.channel_names
        words = event.reason.value
        if event.error:
            words += f" by {abs(event.error):.3g} rad/s"
        if len(event.group) > 1:
            words += f"; one of {', '.join(names[i] for i in event.group)}"
        stamp = event.stamp - self.live.shift
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
        now = self.get_clock().now().nanoseconds
        if any(list(self._newly_silent(now))):
            self._report()
        if self.input is not None and self.input.restarts != self._restarts:
            self._restarts = self.input.restarts
            self.get_logger().warning("all stamps jumped together, or paused: the time of the samples begins anew")
        if self._looks % REPORT_EVERY == 0:
            self._report()
            self._regular(now)

    def _newly_silent(self, now: int) -> Iterator[bool]:
        """Look at everything that may fall silent; True for each that changed."""
        assert self.live is not None
        if self.input is None or not self._inlets:
            return
        for topic in self.input.topics:
            changed = topic.silence.look(topic.received, now)
            if changed and topic.silence.silent and not topic.received:
                self.get_logger().warning(f"{topic.name}: no message yet on {topic.topic}")
            elif changed and topic.silence.silent:
                self.get_logger().error(f"{topic.name}: no message on {topic.topic}")
            elif changed:
                self.get_logger().info(f"{topic.name}: messages on {topic.topic} again")
            yield changed
        yield self._silence.look(self.live.samples, now)

    def _regular(self, now: int) -> None:
        """Begin to count anew what is told between two regular reports."""
        assert self.live is not None
        if self.input is not None:
            self.input.reported(now)
        if self._untold:
            self.get_logger().warning(f"and {self._untold} more changes of state")
        samples, before = self._report_samples
        self._rate = 1e9 * (self.live.samples - samples) / (now - before) if now > before > 0 else 0.0
        self._report_samples = (self.live.samples, now)
        self._at_once, self._untold = MAX_AT_ONCE, 0

    def _report(self) -> None:
        if self.live is None or self.outputs is None:
            return
        now = self.get_clock().now().nanoseconds
        hardware = self.config.hardware_id
        if self.input is None or not self._inlets:
            lines = [StatusLine(Level.STALE, WHOLE, "inactive: not monitoring", hardware, ())]
        else:
            silent = self._silence.seconds(now) if self._silence.silent or not self.live.samples else None
            inputs = self.input.statuses(now)
            status = self.live.pipeline.status()
            lines = describe(status, hardware, inputs=inputs, figures=self._figures(), silent=silent)
        self.outputs.diagnose(lines, now)

    def _figures(self) -> list[tuple[str, str]]:
        assert self.live is not None
        median, late = self.live.latency()
        return [
            ("sample rate (Hz)", f"{self._rate:.1f}"),
            ("latency p50 (ms)", f"{1e3 * median:.3f}"),
            ("latency p99 (ms)", f"{1e3 * late:.3f}"),
            ("samples without fused rate", str(self._without_rate)),
            ("restarts of time", str(self._restarts)),
        ]

    # Control ------------------------------------------------------------------------------------------------------

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            config = parameters.changed(self.config, changes)
            if self.live is not None and config is not self.config:
                self.work()
                self.live.pipeline.reconfigure(config)
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if config is not self.config:
            self.get_logger().info(f"changed: {', '.join(f'{p.name} = {p.value}' for p in changes)}")
        self.config = config
        return SetParametersResult(successful=True)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.live is not None
        response.message = "not configured"
        if self.live is not None:
            declared = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
            names = [c.name for c in self.live.pipeline.status().channels if c.state in declared]
            self.live.pipeline.reset()
            response.message = f"cleared: {', '.join(names) or 'nothing was declared'}"
            self.get_logger().info(f"reset; {response.message}")
        return response

    def _on_relearn_bias(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = self._why_not_at_rest()
        response.success = not refusal
        response.message = f"refused: {refusal}" if refusal else "learning the bias; keep the vehicle at rest"
        if not refusal and self.live is not None:
            self.live.pipeline.relearn_bias()
        self.get_logger().info(f"relearn_bias: {response.message}")
        return response

    def _why_not_at_rest(self) -> str:
        """Say why the bias cannot be learned now; empty if it can."""
        if self.live is None or not self._inlets or self._silence.silent or not self.live.samples:
            return "no samples"
        rate = float(np.linalg.norm(self.live.last_rate))
        if not np.isfinite(rate):
            return "no fused rate, so nothing says that the vehicle is at rest"
        limit = self.config.bias.max_rest_rate
        return f"in motion, {rate:.3g} rad/s, expected at most {limit:g} rad/s" if rate > limit else ""
