"""Two IMUs at 1 kHz for ten minutes, a fault every 20 s, reset after each: all isolated, none else, nothing lost.

python benchmark/soak.py [--minutes 10] [--rate 1000] [--seed 0]
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
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="fdi_soak_")

from ros.harness import GEOMETRY, SIGMA, TWO_IMUS, Listener, Process, body_rate, monitoring, wait  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from fdi_ros.monitor.output import ChannelState  # noqa: E402

ROUND, BEGIN, END, RESET = 20.0, 5.0, 15.0, 15.5
"""s: length of a round; the fault begins and ends, and is reset, at these times in it."""


def play(listener: Listener, z: np.ndarray, rate: float, start: float, clock: int, done: int) -> None:
    """Publish one round at its pace; at the reset time ask for the reset without waiting for it."""
    reset = listener.create_client(Trigger, "fdi_node/reset")
    for k, row in enumerate(z.tolist(), done):
        ahead = start + k / rate - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        stamp = clock + round(k * 1e9 / rate)
        for j in (0, 1):
            listener.send_imu(j, stamp, row[3 * j : 3 * j + 3])
        if k - done == round(RESET * rate):
            reset.call_async(Trigger.Request())
    listener.destroy_client(reset)


def soak(listener: Listener, process: Process, rounds: int, rate: float, seed: int) -> dict[str, float]:
    random = np.random.default_rng(seed)
    count = round(ROUND * rate)
    omega = body_rate(np.arange(count) / rate)
    result = {"lost": 0, "isolated": 0, "others declared": 0, "worst delay (samples)": 0, "memory growth (MB)": 0.0}
    start, clock, memory = time.monotonic(), time.time_ns(), []
    for k in range(rounds):
        listener.clear()
        channel, size = int(random.integers(6)), float(random.uniform(0.05, 1.0) * random.choice([-1, 1]))
        z = omega @ GEOMETRY.axes.T + SIGMA * random.standard_normal((count, 6))
        z[round(BEGIN * rate) : round(END * rate), channel] += size
        play(listener, z, rate, start, clock, k * count)
        wait(lambda: len(listener.integrity) >= count, 0.5)
        faulty = listener.states() == ChannelState.FAULTY
        found = int(np.argmax(faulty[:, channel])) - round(BEGIN * rate) if faulty[:, channel].any() else -1
        result["lost"] += count - len(listener.integrity)
        result["isolated"] += found >= 0
        result["others declared"] += int(np.delete(faulty, channel, axis=1).any(axis=0).sum())
        result["worst delay (samples)"] = max(result["worst delay (samples)"], found)
        memory.append(process.memory())
        result["memory growth (MB)"] = memory[-1] - memory[min(len(memory) - 1, 2)]
        print(f"{(k + 1) * ROUND:5.0f} s  channel {channel + 1} {size:+.2f} rad/s  {result}", flush=True)
    return {"faults": rounds, **result, "cpu_percent": 100 * process.cpu() / (time.monotonic() - start)}


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
