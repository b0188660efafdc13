# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Storms upon a monitor in turn: random parameters, services, transitions, links that come and go.

Each is made by a process of its own; a table says what was sent and answered, the longest time without diagnostics,
lines of the log a second, and memory.

    python benchmark/storm.py [--minutes 60] [--seconds 30] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# The harness of the node tests starts the node and talks to it.
sys.path[:0] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_storm_"))

from ros.harness import TWO_IMUS, monitoring  # noqa: E402
from ros.storm import KINDS, weather  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each storm")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with monitoring(TWO_IMUS, Path(tempfile.mkdtemp(prefix="fdi_storm_"))) as (listener, process):
        for subscription in list(listener.subscriptions):
            if subscription.topic_name != "/diagnostics":
                listener.destroy_subscription(subscription)
        end, seed = time.monotonic() + 60 * arguments.minutes, arguments.seed
        while time.monotonic() < end:
            kind = KINDS[seed % len(KINDS)]
            listener.clear()
            listener.play(np.zeros((300, 6)))
            told = weather(listener, process, kind, arguments.seconds, seed)
            print(f"{seed:4} {kind:10}", "  ".join(f"{name} {value:.4g}" for name, value in told.items()), flush=True)
            seed += 1
    print("ended with exit code 0, no traceback")


if __name__ == "__main__":
    main()
