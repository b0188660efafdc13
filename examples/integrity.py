# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Print every change of a channel's state: subscribes to ~/integrity, whose label names its values.

python3 examples/integrity.py --ros-args -r integrity:=/fdi_node/integrity
"""

from __future__ import annotations

import signal

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64MultiArray

STATES = ("OK", "SUSPECT", "AMBIGUOUS", "FAULTY", "STALE", "UNCHECKED", "EXCLUDED")


def read(message: Float64MultiArray) -> dict[str, float]:
    """Return the values of a message by their labels."""
    labels = message.layout.dim[0].label.split(",")
    return dict(zip(labels, message.data, strict=True))


class Subscriber(Node):
    """Remembers the state of each channel."""

    def __init__(self) -> None:
        super().__init__("integrity_example")
        self.states: dict[str, str] = {}
        self.create_subscription(Float64MultiArray, "integrity", self.on_message, 10)

    def on_message(self, message: Float64MultiArray) -> None:
        """Print the states that have changed since the message before."""
        values = read(message)
        stamp = values["stamp [s]"] + 1e-9 * values["stamp [ns]"]
        for label, value in values.items():
            kind, _, channel = label.partition(" ")
            if kind != "state":
                continue
            state = STATES[int(value)]
            if self.states.get(channel) != state:
                self.states[channel] = state
                print(f"{stamp:.3f} {channel} {state}", flush=True)


def main() -> None:
    """Print until interrupted."""
    # A KeyboardInterrupt while rclpy converts a message becomes a RuntimeError of
    # rclpy. Therefore an interrupt only sets a flag, which is read between messages.
    interrupts: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Subscriber()
    while rclpy.ok() and not interrupts:
        rclpy.spin_once(node, timeout_sec=0.2)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
