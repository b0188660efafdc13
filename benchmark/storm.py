# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Storms upon a monitor and its MAVLink link in turn: parameters, services, transitions, publishers, packets at random.

Each is made by a process of its own, while three gyros of a simulated autopilot come in. A line says what was sent and
answered, the longest time without diagnostics, lines of the log a second and memory of both nodes, and the longest time
without those of a plain node that does nothing but report: what the machine alone costs.

    python benchmark/storm.py [--minutes 60] [--seconds 30] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
# The harness of the node tests starts the nodes; in place of this folder, where mavlink.py would be taken for theirs.
sys.path[:1] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_storm_"))

from ros.storm import KINDS, vehicle, weather  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each storm")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    most: dict[str, dict[str, float]] = {}
    with vehicle(Path(tempfile.mkdtemp(prefix="fdi_storm_"))) as over:
        end, seed = time.monotonic() + 60 * arguments.minutes, arguments.seed
        while time.monotonic() < end:
            kind = KINDS[seed % len(KINDS)]
            over.listener.clear()
            for times in over.reports.values():
                times.clear()
            time.sleep(2.5)
            told = weather(over, kind, arguments.seconds, seed)
            told["load"] = os.getloadavg()[0]
            print(f"{seed:4} {kind:10}", "  ".join(f"{name} {value:.4g}" for name, value in told.items()), flush=True)
            kept = most.setdefault(kind, {"storms": 0.0})
            kept["storms"] += 1
            for name, value in told.items():
                sums = name in ("sent", "answered")
                kept[name] = kept.get(name, 0) + value if sums else max(kept.get(name, 0), value)
            seed += 1
    print("\nsums of what was sent and answered, and the largest of all else:")
    for kind, told in most.items():
        print(f"{kind:10}", "  ".join(f"{name} {value:.6g}" for name, value in told.items()))
    print("both ended with exit code 0, no traceback")


if __name__ == "__main__":
    main()
