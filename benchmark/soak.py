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

from ros.harness import GEOMETRY, SIGMA, TWO_IMUS, Listener, Process, body_rate, monitoring  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from fdi_ros.cdr import read_channels, read_imu  # noqa: E402
from fdi_ros.monitor.output import ChannelState  # noqa: E402

ROUND, BEGIN, END, RESET = 20.0, 5.0, 15.0, 15.5
"""s: length of a round; the fault begins and ends, and is reset, at these times in it."""
GRACE = 0.5
"""Time for the last answers of a round to arrive, s."""


class Flight(threading.Thread):
    """Publishes all rounds without a pause, and asks for a reset in each."""

    def __init__(self, listener: Listener, rounds: int, rate: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.listener, self.rate, self.count = listener, rate, round(ROUND * rate)
        random = np.random.default_rng(seed)
        self.omega = body_rate(np.arange(self.count) / rate)
        self.noise = SIGMA * random.standard_normal((self.count, 6))
        sizes = random.uniform(0.05, 1.0, rounds) * random.choice([-1, 1], rounds)
        self.faults = list(zip(random.integers(6, size=rounds).tolist(), sizes.tolist(), strict=True))
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


def judge(flight: Flight, number: int) -> dict[str, int]:
    """Say what came back of one round, and take it off the lists."""
    listener = flight.listener
    first, end = flight.stamp(number * flight.count), flight.stamp((number + 1) * flight.count)
    stamps = [stamp for stamp, _ in map(read_imu, listener.fused[: 2 * flight.count]) if stamp < end]
    states = np.array([read_channels(data, 11)[2:8] for data in listener.integrity[: len(stamps)]]).astype(int)
    del listener.fused[: len(stamps)], listener.integrity[: len(stamps)]
    channel = flight.faults[number][0]
    faulty = states == ChannelState.FAULTY
    seen = int(np.argmax(faulty[:, channel])) if faulty[:, channel].any() else -1
    delay = round((stamps[seen] - first) / 1e9 * flight.rate) - round(BEGIN * flight.rate) if seen >= 0 else -1
    others = int(np.delete(faulty, channel, axis=1).any(axis=0).sum())
    return {"lost": flight.count - len(stamps), "isolated": int(seen >= 0), "others": others, "delay": delay}


def soak(listener: Listener, process: Process, rounds: int, rate: float, seed: int) -> dict[str, float]:
    flight = Flight(listener, rounds, rate, seed)
    listener.clear()
    flight.start()
    total, memory, worst, cpu = dict.fromkeys(("lost", "isolated", "others"), 0), [], 0, process.cpu()
    for number, (channel, size) in enumerate(flight.faults):
        time.sleep(max(0.0, flight.start_time + (number + 1) * ROUND + GRACE - time.monotonic()))
        found = judge(flight, number)
        total = {name: total[name] + found[name] for name in total}
        worst = max(worst, found["delay"])
        memory.append(process.memory())
        print(
            f"{(number + 1) * ROUND:5.0f} s  channel {channel + 1} {size:+.2f} rad/s  {found}  {memory[-1]:.1f} MB",
            flush=True,
        )
    growth = memory[-1] - memory[min(len(memory) - 1, round(60 / ROUND) - 1)]
    used = 100 * (process.cpu() - cpu) / (rounds * ROUND)
    return {"faults": rounds, **total, "worst delay, samples": worst, "memory growth, MB": growth, "CPU, %": used}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    config = TWO_IMUS.replaced({"sample_rate": arguments.rate})
    with tempfile.TemporaryDirectory() as folder, monitoring(config, Path(folder)) as (listener, process):
        assert listener.settle()
        # What is on its way must not count as the first round's.
        time.sleep(0.5)
        rounds = round(arguments.minutes * 60 / ROUND)
        result = soak(listener, process, rounds, arguments.rate, arguments.seed)
    print("\n".join(f"{name:24}{value:.6g}" for name, value in result.items()))


if __name__ == "__main__":
    main()
