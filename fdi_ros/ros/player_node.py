# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Play the input topics of a recording, as they were recorded, with /clock.

Unlike other players it needs no more than this package: the messages go out byte for byte, read by the same code
that replays them offline.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from fdi_ros.ros.process import Stop, run

if TYPE_CHECKING:
    from fdi_ros.ros.playing import PlayerNode


SETTLING = 0.3
"""Time for the subscribers that were found to have found the player, s."""


def main(argv: Sequence[str] | None = None) -> int:
    """Play to the end or until stopped; exit code 0, or 2 with one line if it cannot start."""
    return run("player_node", _node, argv, play)


def _node() -> PlayerNode:
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from fdi_ros.ros.playing import PlayerNode

    return PlayerNode()


def play(node: PlayerNode, stop: Stop) -> None:
    """Publish every message when its time comes."""
    start = time.monotonic()
    if node.without_subscriber():
        node.get_logger().info(
            f"waiting for subscribers of {', '.join(node.without_subscriber())}, at most {node.patience:g} s"
        )
    while node.without_subscriber() and not stop.asked and time.monotonic() < start + node.patience:
        time.sleep(0.05)
    if node.without_subscriber() and not stop.asked:
        node.get_logger().warning(f"no subscriber to {', '.join(node.without_subscriber())}: playing all the same")
    # A publisher learns of a subscriber a moment before that one takes what it sends.
    time.sleep(SETTLING if not stop.asked else 0)
    start = time.monotonic()
    for due in _paced(node.messages(), stop):
        while not stop.asked and (ahead := start + due / node.rate - time.monotonic()) > 0:
            time.sleep(min(ahead, 0.1))


def _paced(messages: Iterator[float], stop: Stop) -> Iterator[float]:
    for due in messages:
        if stop.asked:
            return
        yield due


if __name__ == "__main__":
    sys.exit(main())
