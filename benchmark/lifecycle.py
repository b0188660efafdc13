# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Transitions at random, possible or not, while messages come in: every one answered, the node's memory flat.

python benchmark/lifecycle.py [--transitions 1000] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
# The harness of the node tests starts the node and talks to it.
sys.path[:0] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_lifecycle_"))

from ros.harness import TWO_IMUS, monitoring, wander  # noqa: E402

BATCH = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--transitions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    folder = tempfile.mkdtemp(prefix="fdi_lifecycle_")
    total = {"done": 0, "refused": 0}
    with monitoring(TWO_IMUS, Path(folder), autostart=False) as (listener, process):
        for batch in range(arguments.transitions // BATCH):
            told = wander(listener, BATCH, arguments.seed + batch)
            total = {name: total[name] + told[name] for name in total}
            print(f"{(batch + 1) * BATCH:5} transitions  {total}  {process.memory():.1f} MB", flush=True)
            listener.clear()
    print("all answered as the state allows; ended with exit code 0")


if __name__ == "__main__":
    main()
