# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Play the input topics of a recording, as they were recorded, with /clock.

Unlike other players it needs no more than this package: the messages go out byte for byte, read by the same code
that replays them offline.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from fdi_ros.errors import BagError
from fdi_ros.libraries import BAGS, require
from fdi_ros.ros.process import ErrorGuard, Stop, run

if TYPE_CHECKING:
    from fdi_ros.ros.playing import PlayerNode

PATIENCE = 0.1
"""A request, or a signal, waits at most this long for its answer, s."""


SETTLING = 0.3
"""Time for the subscribers that were found to have found the player, s."""


def main(argv: Sequence[str] | None = None) -> int:
    """Play to the end or until stopped; exit code 0, or 2 with one line if it cannot start."""
    return run("player_node", _node, argv, play)


def _node() -> PlayerNode:
    require("reading recordings", BAGS)
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from fdi_ros.ros.playing import PlayerNode

    return PlayerNode()


def play(node: PlayerNode, stop: Stop) -> None:
    """Publish every message when its time comes, and answer requests meanwhile."""
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor, guard = SingleThreadedExecutor(), ErrorGuard(node, ExternalShutdownException)
    executor.add_node(node)

    def spin(seconds: float) -> None:
        with guard:
            executor.spin_once(timeout_sec=seconds)

    try:
        _await_subscribers(node, stop, spin)
        while _play_once(node, stop, spin) and node.loop:
            node.log.info("the recording has ended: from its beginning")
            spin(0.0)
    except ExternalShutdownException:
        return
    finally:
        executor.remove_node(node)


def _await_subscribers(node: PlayerNode, stop: Stop, spin: Callable[[float], None]) -> None:
    """Wait for a subscriber to every topic, as long as the user has patience."""
    start = time.monotonic()
    if node.without_subscriber():
        node.log.info(f"waiting for subscribers of {', '.join(node.without_subscriber())}, at most {node.patience:g} s")
    while node.without_subscriber() and not stop.asked and time.monotonic() < start + node.patience:
        spin(0.05)
    if node.without_subscriber() and not stop.asked:
        node.log.warning(f"no subscriber to {', '.join(node.without_subscriber())}: playing all the same")
    # A publisher learns of a subscriber a moment before that one takes what it sends.
    time.sleep(SETTLING if not stop.asked else 0)


def _play_once(node: PlayerNode, stop: Stop, spin: Callable[[float], None]) -> bool:
    """Play the recording; return whether it came to its end.

    Raises
    ------
    BagError
        If it holds no message.
    """
    start = answered = time.monotonic()
    played = False
    for due in node.messages():
        played = True
        while True:
            now = time.monotonic()
            ahead, paused = start + due / node.rate - now, node.paused
            if paused or ahead > 0 or now - answered > PATIENCE:
                spin(PATIENCE if paused else min(max(ahead, 0.0), PATIENCE))
                answered = time.monotonic()
                # What was paused is not made up for.
                start += answered - now if paused else 0.0
            if stop.asked:
                return False
            if not node.paused and start + due / node.rate <= time.monotonic():
                break
    if not played:
        raise BagError(f"{node.recording.path} holds no message of {', '.join(node.config.topics)}")
    return not stop.asked


if __name__ == "__main__":
    sys.exit(main())
