# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The live monitor as a managed node: life cycle, parameters and services; `Running` does the work."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from fdi_ros.compiling.notice import announced, refused
from fdi_ros.config.config import Config
from fdi_ros.config.settings import MONITOR
from fdi_ros.errors import FdiError
from fdi_ros.model.thresholds import summary_line
from fdi_ros.monitor.build import alarm_probability
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import Receiver, warm_detector
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.ros import parameters
from fdi_ros.ros.inputs import InputQueue
from fdi_ros.ros.messages import OVERRIDABLE, log_through
from fdi_ros.ros.process import Stop
from fdi_ros.ros.running import Running
from fdi_ros.system.text import shown

CHECK_PERIOD = 0.05
"""How often silence is checked for, and the state saved if it has changed, s."""
LATE = 2
"""Periods after which the timer is not waited for any longer: other events are before it in the executor's queue."""
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
RCLError = rclpy_implementation.RCLError


class MonitorNode(parameters.CheckedParameters, LifecycleNode):
    """Gyro fault monitor.

    Raises
    ------
    FdiError
        If a parameter is wrong or the settings do not fit each other.
    """

    def __init__(self, **options: Any) -> None:
        self.inputs = InputQueue(self)
        super().__init__("fdi_node", **options)
        # It says of every impossible transition what the node says, too, and that without bound.
        set_logger_level("rcl_lifecycle", LoggingSeverity.ERROR)
        self.config = parameters.declare(self, MONITOR, OVERRIDABLE)
        params = self.values(MONITOR)
        self._state_file = (
            StateFile(Path(params["state_file"]), params["state_max_age"]) if params["state_file"] else None
        )
        log_through(self.log)
        self._running: Running | None = None
        self._checked_at = time.monotonic()
        """Steady time of the last check, s."""
        # Built here too, so that settings that do not fit refuse the start and not the first transition.
        self._built: Receiver | None = self._build()
        self._service_change_state.callback = partial(self._on_change_state, self._service_change_state.callback)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/relearn_bias", self._on_relearn_bias)

    def _build(self) -> Receiver:
        with announced():
            receiver = Receiver(Pipeline.from_config(self.config))
        if self._state_file is not None:
            self._state_file.restore(receiver.pipeline)
            if self._state_file.is_rejected:
                self.log.warning(self._state_file.words)
            else:
                self.log.info(self._state_file.words)
        return receiver

    @property
    def _pipeline(self) -> Pipeline | None:
        """The monitor: there from the start, and again from configure to cleanup."""
        receiver = self._built if self._running is None else self._running.receiver
        return None if receiver is None else receiver.pipeline

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
        """Subscriptions that an executor is to wait for."""
        return self.inputs.visible(super().subscriptions)

    # Managed node -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Configure and activate without a manager."""
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def live(self, stop: Stop) -> None:
        """Begin, if it is not for a manager to do that, and work until stopped."""
        if self.get_parameter("autostart").value:
            self.start()
        else:
            self.get_logger().info(
                f"autostart is false: waiting for a lifecycle manager, or ros2 lifecycle set"
                f" {self.get_fully_qualified_name()} configure"
            )
        super().live(stop)

    def _on_change_state(self, change: Any, request: ChangeState.Request, response: Any) -> ChangeState.Response:
        """Answer what cannot be done in the present state; rclpy itself raises, and never answers."""
        try:
            return change(request, response)
        except RCLError as error:
            wanted = shown(request.transition.label) or f"transition {request.transition.id}"
            now = self._state_machine.current_state[1]
            self.log.warning(f"{wanted} refused: not possible while {now}")
            self.get_logger().debug(str(error))
            response.success = False
            return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the monitor, unless it was built at the start, and announce the outputs."""
        try:
            receiver = self._build() if self._built is None else self._built
        except FdiError as error:
            self.log.error(f"configure refused: {error}")
            return FAILURE
        self._running, self._built = Running(self, self.inputs, receiver, self._state_file), None
        self._timer = self.every(CHECK_PERIOD, partial(self._on_timer, self._running))
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen; what was learned of the time of the samples stays from before."""
        if self._running is None:
            return FAILURE
        self._running.listen()
        pipeline = self._running.receiver.pipeline
        self.log.info(summary_line(pipeline.geometry, pipeline.noise, alarm_probability(self.config)))
        names = ", ".join(topic.topic for topic in self._running.supervisor.topics)
        self.log.info(f"monitoring {names} with {self.config.detector.name}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; what is known stays."""
        self.inputs.close()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self.inputs.close()
        self.save_state()
        if self._running is not None:
            self.destroy_timer(self._timer)
            self._running.publishers.destroy()
        self._running = self._built = None
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take everything down."""
        return self.on_cleanup(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what a failed transition has left."""
        self.log.error(f"transition from {state.label} failed: the node is unconfigured")
        return self.on_cleanup(state)

    def keep_up(self) -> None:
        """Take in what waits and check what may have changed, where requests keep the executor from doing so."""
        super().keep_up()
        if self._running is not None and time.monotonic() - self._checked_at > LATE * CHECK_PERIOD:
            self.inputs.drain()
            self._on_timer(self._running)

    def _on_timer(self, running: Running) -> None:
        self._checked_at = time.monotonic()
        self.save_state()
        running.supervisor.check()
        if running.supervisor.is_out_of_time:
            self.log.error("the clock went back by decades too often: the monitor begins anew")
            running.start(self._build())

    def save_state(self) -> None:
        """Save biases and declarations, if there is a file for them and they have changed."""
        pipeline = self._pipeline
        if self._state_file is not None and pipeline is not None and self._state_file.save(pipeline):
            if self._state_file.failed:
                self.get_logger().error(self._state_file.words, throttle_duration_sec=60.0)
            else:
                self.log.info(self._state_file.words)

    def destroy_node(self) -> None:
        """Save the state and take the node down."""
        self.save_state()
        super().destroy_node()

    # Parameters and services --------------------------------------------------------------------------------------

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            config = parameters.changed(self.config, changes)
            self._check_detector(config.detector.name)
            if config is not self.config:
                self._reconfigure(config)
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if config is not self.config:
            self.log.info(f"changed: {', '.join(f'{p.name} = {p.value}' for p in changes)}")
        self.config = config
        return SetParametersResult(successful=True)

    def _check_detector(self, name: str) -> None:
        """Refuse a detector that must be compiled first: meanwhile an active node would be deaf."""
        if self.inputs.is_open and name != self.config.detector.name:
            words = f"detector {name} is not compiled yet, which would stop the monitor for up to a minute"
            with refused(f"{words}: run fdi compile first, or deactivate the node"):
                warm_detector(name)

    def _reconfigure(self, config: Config) -> None:
        pipeline = self._pipeline
        if pipeline is None:
            # Unconfigured: so that what does not fit is refused now, and not at the next transition.
            Pipeline.from_config(config)
            return
        self.inputs.drain()
        with announced():
            pipeline.reconfigure(config)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        pipeline = self._pipeline
        response.success, response.message = pipeline is not None, "not configured"
        if pipeline is not None:
            declared = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
            names = [c.name for c in pipeline.status().channels if c.state in declared]
            pipeline.reset()
            response.message = f"cleared: {', '.join(names) or 'nothing was declared'}"
            self.log.info(f"reset; {response.message}")
        return response

    def _on_relearn_bias(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        running = self._running
        refusal = "no samples" if running is None else running.supervisor.why_not_at_rest()
        response.success = not refusal
        response.message = f"refused: {refusal}" if refusal else "learning the bias; keep the vehicle at rest"
        if running is not None and not refusal:
            running.receiver.pipeline.relearn_bias()
        self.log.info(f"relearn_bias: {response.message}")
        return response
