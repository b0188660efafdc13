# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two IMUs at 1 kHz for ten minutes, a fault every 20 s, reset after each: all isolated, none else, nothing lost.

python benchmark/soak.py [--minutes 10] [--rate 1000] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# The harness of the node tests starts the node and talks to it.
sys.path[:0] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="fdi_soak_")

from ros.harness import GEOMETRY, SIGMA, TWO_IMUS, Listener, Process, body_rate, monitoring, wait  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from fdi_ros.monitor.diagnostics import PREFIX, WHOLE  # noqa: E402

CYCLE, BEGIN, END, RESET = 20.0, 5.0, 15.0, 15.5
"""s: length of a cycle; the fault begins and ends, and is reset, at these times in it."""
GRACE = 0.5
"""Time for the last answers of a cycle to arrive, s."""


class Flight(threading.Thread):
    """Publishes all cycles without a pause, and asks for a reset in each."""

    def __init__(self, listener: Listener, cycles: int, rate: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.listener, self.rate, self.count = listener, rate, round(CYCLE * rate)
        random = np.random.default_rng(seed)
        self.omega = body_rate(np.arange(self.count) / rate)
        self.noise = SIGMA * random.standard_normal((self.count, 6))
        sizes = random.uniform(0.05, 1.0, cycles) * random.choice([-1, 1], cycles)
        self.faults = list(zip(random.integers(6, size=cycles).tolist(), sizes.tolist(), strict=True))
        self.start_time, self.clock = time.monotonic() + 0.5, time.time_ns() + 500_000_000
        self.reset = listener.create_client(Trigger, "fdi_node/reset")

    def run(self) -> None:
        """Publish every sample when its time comes."""
        sound = (self.omega @ GEOMETRY.axes.T + self.noise).tolist()
        begin, end, reset = (round(t * self.rate) for t in (BEGIN, END, RESET))
        for number, (channel, size) in enumerate(self.faults):
            for k, row in enumerate(sound):
                sample = number * self.count + k
                ahead = self.start_time + sample / self.rate - time.monotonic()
                if ahead > 0:
                    time.sleep(ahead)
                values = list(row)
                values[channel] += size if begin <= k < end else 0.0
                stamp = self.stamp(sample)
                for j in (0, 1):
                    self.listener.send_imu(j, stamp, values[3 * j : 3 * j + 3])
                if k == reset:
                    self.reset.call_async(Trigger.Request())

    def stamp(self, sample: int) -> int:
        """Return the stamp of a sample, ns."""
        return self.clock + round(sample * 1e9 / self.rate)


def reports(listener: Listener) -> list[dict[str, dict[str, str]]]:
    """Return the key-values of all statuses in all reports, by name, and take them off the list."""
    heard, listener.diagnostics[:] = list(listener.diagnostics), []
    return [{status.name: {v.key: v.value for v in status.values} for status in m.status} for _, m in heard]


def judge(flight: Flight, number: int, said: list[dict[str, dict[str, str]]]) -> dict[str, int]:
    """Say what the node declared in one cycle."""
    begin = flight.stamp(number * flight.count + round(BEGIN * flight.rate))
    declared: dict[str, int] = {}
    for report in said:
        for name, values in report.items():
            if values.get("state") in ("FAULTY", "AMBIGUOUS"):
                sec, nanosec = values["state since (stamp, s)"].split(".")
                declared.setdefault(name, int(sec) * 10**9 + int(nanosec))
    struck = f"{PREFIX}{TWO_IMUS.channel_names[flight.faults[number][0]]}"
    at = declared.pop(struck, None)
    delay = -1 if at is None else round((at - begin) / 1e9 * flight.rate)
    return {"isolated": int(at is not None), "others": len(declared), "delay": delay}


def soak(listener: Listener, process: Process, cycles: int, rate: float, seed: int) -> dict[str, float]:
    flight = Flight(listener, cycles, rate, seed)
    samples = [int(report[PREFIX + WHOLE]["samples"]) for report in reports(listener)][-1]
    listener.clear()
    flight.start()
    total, memory, worst, cpu, heard = dict.fromkeys(("isolated", "others"), 0), [], 0, process.cpu(), 0
    for number, (channel, size) in enumerate(flight.faults):
        time.sleep(max(0.0, flight.start_time + (number + 1) * CYCLE + GRACE - time.monotonic()))
        said = reports(listener)
        found = judge(flight, number, said)
        total = {name: total[name] + found[name] for name in total}
        worst = max(worst, found["delay"])
        memory.append(process.memory())
        heard += len(listener.fused)
        listener.fused.clear()
        listener.integrity.clear()
        print(
            f"{(number + 1) * CYCLE:5.0f} s  channel {channel + 1} {size:+.2f} rad/s  {found}  {memory[-1]:.1f} MB",
            flush=True,
        )
    used = 100 * (process.cpu() - cpu) / (cycles * CYCLE)
    wait(lambda: len(listener.diagnostics) > 1, 3)
    last = reports(listener)[-1]
    sent = cycles * flight.count
    return {
        "faults": cycles,
        **total,
        "worst delay, samples": worst,
        "samples sent": sent,
        "lost by the node": sent - (int(last[PREFIX + WHOLE]["samples"]) - samples),
        "fused rates not heard": sent - heard - len(listener.fused),
        "memory growth, MB": memory[-1] - memory[min(len(memory) - 1, round(60 / CYCLE) - 1)],
        "CPU, %": used,
        "latency p99, ms": float(last[PREFIX + WHOLE]["latency p99 (ms)"]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    config = TWO_IMUS.replaced({"sample_rate": arguments.rate})
    with tempfile.TemporaryDirectory() as folder, monitoring(config, Path(folder)) as (listener, process):
        assert listener.settle()
        # What is on its way must not count as the first cycle's.
        listener.diagnostics.clear()
        assert wait(lambda: listener.diagnostics, 3)
        cycles = round(arguments.minutes * 60 / CYCLE)
        result = soak(listener, process, cycles, arguments.rate, arguments.seed)
    print("\n".join(f"{name:24}{value:.6g}" for name, value in result.items()))


if __name__ == "__main__":
    main()
