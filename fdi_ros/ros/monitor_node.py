# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The live monitor as a managed node: life cycle, parameters and services.

`Running` does the work.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from fdi_ros.compiling.notice import announced, refused
from fdi_ros.config.config import is_ros_parameter
from fdi_ros.config.settings import MONITOR
from fdi_ros.errors import FdiError
from fdi_ros.model.noise import summary_line
from fdi_ros.monitor.building import alarm_probability
from fdi_ros.monitor.output import OUTPUTS, ChannelState
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import Receiver, warm_detector
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.ros.node import CheckedNode
from fdi_ros.ros.process import Stop
from fdi_ros.ros.running import Running
from fdi_ros.system.memory import give_back
from fdi_ros.system.text import shown

CHECK_PERIOD = 0.05  # period of the checks for silence and of saving a changed state, s
LATE_PERIODS = 2  # periods after which the timer is not waited for any longer: the executor's queue is full
# stamps beyond all clocks, ns: a clock was set back by decades again and again
END_OF_TIME = 2**62
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
RCLError = rclpy_implementation.RCLError


class MonitorNode(CheckedNode, LifecycleNode):
    """Gyro fault monitor.

    Raise `FdiError` if a parameter is wrong or settings contradict each other.
    """

    def __init__(self, **options: Any) -> None:
        topics = [output.topic.name for output in OUTPUTS]
        super().__init__(
            "fdi_node", MONITOR, subscribes=True, publishes=topics, **options
        )
        # rcl_lifecycle repeats the node's own line on every impossible transition, without bound.
        set_logger_level("rcl_lifecycle", LoggingSeverity.ERROR)
        file, age = (self.values()[name] for name in ("state_file", "state_max_age"))
        self._state_file = StateFile(Path(file), age) if file else None
        self.log.take_over()
        self._running: Running | None = None
        self._checked_at = time.monotonic()  # steady time of the last check, s
        # Built here too, so that settings that do not fit refuse the start and not the
        # first transition.
        self._receiver: Receiver | None = (
            self._build()
        )  # again from configure to cleanup
        self._service_change_state.callback = partial(
            self._on_change_state, self._service_change_state.callback
        )
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/relearn_bias", self._on_relearn_bias)

    def _build(self) -> Receiver:
        with announced():
            receiver = Receiver(Pipeline.from_config(self.config))
        if self._state_file is not None:
            self._state_file.restore(receiver.pipeline)
            say = self.log.warning if self._state_file.is_rejected else self.log.info
            say(self._state_file.words)
        return receiver

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, *arguments: Any, **options: Any
    ) -> Any:
        """Subscribe. Messages on /clock with times that rclpy cannot hold are ignored."""
        if kind is ClockMessage:
            callback = partial(self._on_clock, callback)
        return super().create_subscription(kind, topic, callback, *arguments, **options)

    def _on_clock(self, take: Any, message: Any) -> None:
        if message.clock.sec >= 0:
            take(message)
        else:
            words = (
                f"/clock says {message.clock.sec} s, which is before 1970: left aside"
            )
            self.get_logger().error(words, throttle_duration_sec=1.0)

    # Managed node ---------------------------------------------------------------------
    # ----------------------------

    def start(self) -> None:
        """Configure and activate without a manager."""
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def live(self, stop: Stop) -> None:
        """Begin, unless a manager starts the node, and work until stopped."""
        if self.get_parameter("autostart").value:
            self.start()
        else:
            self.get_logger().info(
                f"autostart is false: waiting for a lifecycle manager, or ros2 lifecycle set"
                f" {self.get_fully_qualified_name()} configure"
            )
        super().live(stop)

    def _on_change_state(
        self, change: Any, request: ChangeState.Request, response: Any
    ) -> ChangeState.Response:
        """Answer a request that is impossible in the present state.

        rclpy raises, and never answers.
        """
        try:
            return change(request, response)
        except RCLError as error:
            wanted = (
                shown(request.transition.label) or f"transition {request.transition.id}"
            )
            now = self._state_machine.current_state[1]
            self.log.warning(f"{wanted} refused: not possible while {now}")
            self.get_logger().debug(str(error))
            response.success = False
            return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the monitor, unless the constructor has built one, and announce the outputs."""
        try:
            self._receiver = self._receiver or self._build()
        except FdiError as error:
            self.log.error(f"configure refused: {error}")
            return FAILURE
        self._running = Running(self, self._receiver, self._state_file)
        self._timer = self.every(CHECK_PERIOD, partial(self._check, self._running))
        # Not active yet, so no sample waits for this.
        give_back()
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen. The known offsets between clocks remain."""
        if self._running is None:
            return FAILURE
        self._running.listen()
        pipeline = self._running.receiver.pipeline
        self.log.info(
            summary_line(
                pipeline.geometry, pipeline.noise, alarm_probability(self.config)
            )
        )
        names = ", ".join(topic.topic for topic in self._running.topics)
        self.log.info(f"monitoring {names} with {self.config.detector.name}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening. All estimates remain."""
        self.inputs.close()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self.inputs.close()
        self.save_state()
        if self._running is not None:
            self.destroy_timer(self._timer)
            self._running.close()
        self._running = self._receiver = None
        give_back()
        return SUCCESS

    on_shutdown = on_cleanup

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what a failed transition has left."""
        self.log.error(
            f"transition from {state.label} failed: the node is unconfigured"
        )
        return self.on_cleanup(state)

    def keep_up(self) -> None:
        """Take in waiting messages and run the checks while requests keep the executor busy."""
        super().keep_up()
        if (
            self._running is not None
            and time.monotonic() - self._checked_at > LATE_PERIODS * CHECK_PERIOD
        ):
            self.inputs.drain()
            self._check(self._running)

    def _check(self, running: Running) -> None:
        # An event outlives its timer where the node is cleaned up before its turn.
        if running is not self._running:
            return
        self._checked_at = time.monotonic()
        self.save_state()
        running.check()
        if not 0 <= running.receiver.live["last_stamp"][0] < END_OF_TIME:
            self.log.error(
                "the clock went back by decades too often: the monitor begins anew"
            )
            self._receiver = self._build()
            running.start(self._receiver)

    def save_state(self) -> None:
        """Save changed biases and declarations, if a state file is set."""
        if (
            self._state_file is None
            or self._receiver is None
            or not self._state_file.save(self._receiver.pipeline)
        ):
            return
        if self._state_file.failed:
            self.get_logger().error(self._state_file.words, throttle_duration_sec=60.0)
        else:
            self.log.info(self._state_file.words)

    def destroy_node(self) -> None:
        """Save the state and take the node down."""
        self.save_state()
        super().destroy_node()

    # Parameters and services ----------------------------------------------------------
    # ----------------------------

    def change(self, changes: Sequence[Parameter]) -> None:
        """Take over settings that may change at run time, all or none."""
        values = {p.name: p.value for p in changes if not is_ros_parameter(p.name)}
        if not values:
            return
        config = self.config.replaced(values)
        name = config.detector.name
        if self.inputs.subscriptions and name != self.config.detector.name:
            # An active node would be deaf while compiling.
            words = f"detector {name} is not compiled yet, which would stop the monitor for up to a minute"
            with refused(f"{words}: run fdi compile first, or deactivate the node"):
                warm_detector(name)
        if self._receiver is None:
            # Unconfigured: so that what does not fit is refused now, and not at the
            # next transition.
            Pipeline.from_config(config)
        else:
            self.inputs.drain()
            with announced():
                self._receiver.pipeline.reconfigure(config)
        self.config = config
        changed = [f"{one.name} = {one.value}" for one in changes]
        self.log.info(f"changed: {', '.join(changed)}")

    def _on_reset(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success = self._receiver is not None
        response.message = "not configured"
        if self._receiver is not None:
            pipeline = self._receiver.pipeline
            declared = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
            names = [c.name for c in pipeline.status().channels if c.state in declared]
            pipeline.reset()
            response.message = f"cleared: {', '.join(names) or 'nothing was declared'}"
            self.log.info(f"reset; {response.message}")
        return response

    def _on_relearn_bias(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        running = self._running
        refusal = "no samples" if running is None else running.why_not_at_rest()
        response.success = not refusal
        response.message = (
            f"refused: {refusal}"
            if refusal
            else "learning the bias; keep the vehicle at rest"
        )
        if running is not None and not refusal:
            running.receiver.pipeline.relearn_bias()
        self.log.info(f"relearn_bias: {response.message}")
        return response
