# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyros over MAVLink: what can be found at which rate, CPU of the link, and storms upon it and the monitor.

    python benchmark/mavlink.py found [--flights 8]        # three IMUs and two, bias and drift, 10, 25, 50 and 100 Hz
    python benchmark/mavlink.py cpu [--seconds 20]         # 3 x 100 Hz beside a plain pymavlink reader
    python benchmark/mavlink.py failover [--trials 20]     # from an onset to PARAM_SET, both nodes live
    python benchmark/mavlink.py storms [--minutes 60]      # parameters, services, transitions, publishers, packets

Storms come in turn, each from a process of its own, while three gyros come in. A line says what was sent and answered,
the longest time without diagnostics, lines of the log a second and memory of both nodes, and the load of the machine.

The autopilots are those of the tests (test/mavlink/autopilots.py).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
# In place of this folder, where this file would be taken for the tests' folder of the same name.
sys.path[:1] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_mavlink_"))

from fdi_ros.config.config import Config  # noqa: E402

NS = 1_000_000_000
RATES = (10.0, 25.0, 50.0, 100.0)
SIZES = (0.1, 0.3, 1.0)
"""Biases of one axis, rad/s, that failover is timed with."""
FAULTS = {
    "none": (0.0, 0.0),
    "0.01": (0.01, 0.0),
    "0.03": (0.03, 0.0),
    "0.1": (0.1, 0.0),
    "0.3": (0.3, 0.0),
    "drift 0.01": (0.0, 0.01),
    "drift 0.05": (0.0, 0.05),
}
"""Bias, rad/s, and drift, rad/s^2."""
STRUCK = "imu_2.y"
SECONDS, STRIKES = 90.0, 30.0
NOISE, SCALE, MOTION = 0.004, 0.005, 0.6


# What can be found -------------------------------------------------------------------------------------------------


Messages = tuple[np.ndarray, np.ndarray, np.ndarray]


def flight(
    stack: str, rate: float, seed: int, count: int, fault: tuple[float, float]
) -> Messages:
    """Messages of IMUs in motion: unit, stamp, ns, rates (k, 3); imu_2.y has a bias and a drift from `STRIKES` on.

    With noise of 4 mrad/s, scale factors off by 0.5 %, up to about 0.8 rad/s, sampled as the autopilot does,
    in the steps of SCALED_IMU, cut off towards zero.
    """
    random = np.random.default_rng(seed)
    phase, factor = (
        random.uniform(0, 2 * np.pi, 6),
        1 + SCALE * random.standard_normal((3, 3)),
    )
    slow, fast = (
        2 * np.pi * np.array(hertz)
        for hertz in ((0.25, 0.41, 0.17), (0.83, 0.67, 0.53))
    )
    units, stamps, rates = [], [], []
    for unit in range(count):
        due = np.arange(round(SECONDS * rate)) / rate
        if stack == "ardupilot":
            stamp = due + 0.0005 * unit
            at = np.floor(stamp / 0.0025) * 0.0025
        else:
            first = 0.0007 * unit
            at = stamp = (
                np.floor((due + random.uniform(0, 0.006) - first) / 0.005) * 0.005
                + first
            )
        omega = np.sin(np.outer(at, slow) + phase[:3]) + 0.4 * np.sin(
            np.outer(at, fast) + phase[3:]
        )
        z = MOTION * omega * factor[unit] + NOISE * random.standard_normal(omega.shape)
        if unit == 1:
            z[:, 1] += (fault[0] + fault[1] * (at - STRIKES)) * (at >= STRIKES)
        z, stamp = np.trunc(z * 1e3) / 1e3, np.floor(stamp * 1e3) / 1e3
        units.append(np.full(len(at), unit))
        stamps.append(np.round((stamp + 100.0) * NS).astype(np.int64))
        rates.append(z)
    order = np.argsort(np.concatenate(stamps), kind="stable")
    return (
        np.concatenate(units)[order],
        np.concatenate(stamps)[order],
        np.concatenate(rates)[order],
    )


class Told(NamedTuple):
    """What was declared in one flight."""

    first: float  # time from the fault to the first declaration, s; infinite: there was none
    named: float  # to that which names the channel that is struck
    wrong: int  # declarations that name a healthy channel, or a set without that which is struck
    early: int  # declarations before the fault


def judged(config: Config, messages: Messages, struck: bool) -> Told:
    """Let the monitor judge a flight."""
    from fdi_ros.core.alignment import Alignment
    from fdi_ros.core.sources import source_of
    from fdi_ros.monitor.pipeline import Pipeline

    pipeline = Pipeline.from_config(config)
    declared = pipeline.process(
        Alignment(*source_of(config).alignment).push_block(*messages)
    ).events
    first, named, wrong, early = np.inf, np.inf, 0, 0
    for event in declared:
        if not event.declares:
            continue
        since = event.stamp / NS - 100.0 - STRIKES
        names = {pipeline.channel_names[k] for k in (event.channel, *event.group)}
        early += since < 0
        wrong += not struck or STRUCK not in names
        if STRUCK in names:
            first = min(first, since)
            named = min(named, since if event.after.name == "FAULTY" else np.inf)
    return Told(first, named, wrong, early)


def found(flights: int) -> None:
    print(
        f"fault of {STRUCK} (rad/s, rad/s^2) after {STRIKES:g} s of {SECONDS:g}; of {flights} flights each how many "
        "declared, median s to the declaration (of a set or a name); how many named, median s"
    )
    for count in (3, 2):
        for stack in ("ardupilot", "px4"):
            whole = Config.from_file(ROOT / "config" / f"{stack}.yaml")
            given = {
                "imus.topics": whole.imus.topics[:count],
                "imus.names": whole.imus.names[:count],
            }
            given |= {"imus.mounts": whole.imus.mounts[: 9 * count]}
            for rate in RATES:
                config, row, wrong, early = (
                    whole.replaced({**given, "sample_rate": rate}),
                    [],
                    0,
                    0,
                )
                for name, fault in FAULTS.items():
                    told = [
                        judged(
                            config, flight(stack, rate, seed, count, fault), any(fault)
                        )
                        for seed in range(flights)
                    ]
                    wrong, early = (
                        wrong + sum(t.wrong for t in told),
                        early + sum(t.early for t in told),
                    )
                    if any(fault):
                        row.append(
                            f"{name}: {_share([t.first for t in told])}, {_share([t.named for t in told])}"
                        )
                print(
                    f"{count} {stack:10}{rate:4g} Hz  {' | '.join(row)}  wrong {wrong}, early {early}",
                    flush=True,
                )


def _share(times: list[float]) -> str:
    """Say how many are finite, and their median."""
    known = [time for time in times if np.isfinite(time)]
    return f"{len(known)} {np.median(known):.2f}" if known else "0"


# Processes ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def started(*words: str) -> Iterator[subprocess.Popen]:
    """Run a Python process."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([sys.executable, *words], cwd=ROOT, **quiet)
    try:
        yield process
    finally:
        # Not SIGINT, which whatever a shell has started in the background ignores.
        process.terminate()
        process.wait(20)


def node(name: str, stack: str, *parameters: str) -> list[str]:
    values = [word for parameter in parameters for word in ("-p", parameter)]
    file = str(ROOT / "config" / f"{stack}.yaml")
    return [
        "-m",
        "fdi_ros.ros.process",
        name,
        "--ros-args",
        "--params-file",
        file,
        *values,
    ]


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_plainly(port: int) -> None:
    """Read all messages of a port with pymavlink, and do nothing with them."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    while link.recv_match(blocking=True) is not None:
        pass


def cpu(seconds: float) -> None:
    """Print what a message costs the node of the link, and a reader that does nothing with it."""
    from mavlink.autopilots import Autopilot, OverUdp, free_port
    from ros.harness import listening
    from sensor_msgs.msg import Imu

    came: list[float] = []
    for name in ("plain pymavlink reader", "mavlink_node"):
        port = free_port()
        words = [__file__, "reader", str(port)]
        if name == "mavlink_node":
            words = node(
                "mavlink_node",
                "px4",
                f"url:=udpin:127.0.0.1:{port}",
                "mavlink_node:rate:=100.0",
            )
        autopilot = Autopilot(
            boot=time.monotonic_ns() - 100 * NS,
            rates={26: 100.0, 116: 100.0, 129: 100.0},
        )
        with (
            OverUdp(port, autopilot),
            listening(()) as listener,
            started(*words) as process,
        ):
            for unit in (1, 2, 3):
                topic = f"imu_{unit}/data_raw"
                listener.create_subscription(
                    Imu, topic, lambda _: came.append(time.monotonic()), 50, raw=True
                )
            time.sleep(8.0)
            before, begin, sent = (
                cpu_seconds(process.pid),
                time.monotonic(),
                autopilot.sent,
            )
            time.sleep(seconds)
            used, took, sent = (
                cpu_seconds(process.pid) - before,
                time.monotonic() - begin,
                autopilot.sent - sent,
            )
        heard = sum(begin <= at < begin + took for at in came)
        print(
            f"{name:24}{100 * used / took:6.1f} % CPU, {1e6 * used / sent:.0f} us a message; "
            f"{sent / took:.0f} messages and {heard / took:.0f} Imu a second"
        )


# Failover ------------------------------------------------------------------------------------------------------------


def failover(trials: int, seed: int) -> None:
    """Print the time from an onset to the order, both nodes and the link live, at 50 Hz.

    Errors of one axis of any size of `SIZES`, and of all axes of a unit, come in turn on a
    random IMU of three, with noise of 1.5 mrad/s. The autopilot confirms an order at once.
    """
    from mavlink.autopilots import PARAMETERS, Autopilot, OverUdp, free_port, gentle
    from ros.harness import listening
    from ros.processes import wait

    random = np.random.default_rng(seed)
    fault = np.zeros((3, 3))
    healthy = gentle(3, noise=0.0015)
    autopilot = Autopilot("ardupilot", boot=time.monotonic_ns() - 100 * NS)
    autopilot.motion = lambda t: healthy(t) + fault
    autopilot.late_reads = 80_000_000
    port = free_port()
    file = Path(tempfile.mkdtemp()) / "out.json"
    values = (f"url:=udpin:127.0.0.1:{port}", "failover:=ardupilot")
    values += (f"failover_file:={file}",)
    words = [f"mavlink_node:{value}" for value in values]
    times: dict[str, list[float]] = {name: [] for name in (*map(str, SIZES), "unit")}
    used = autopilot.parameters
    wrong = 0
    with (
        OverUdp(port, autopilot),
        started(*node("fdi_node", "ardupilot")),
        started(*node("mavlink_node", "ardupilot", *words)),
        listening(()),
    ):
        assert wait(lambda: len(autopilot.texts) > 0, 60.0), "not ready"
        for name in [*times] * trials:
            autopilot.armed = True
            time.sleep(3.0 + random.random())
            autopilot.sets.clear()
            unit = int(random.integers(3))
            signs = random.choice([-1, 1], 3)
            begun = time.monotonic_ns()
            if name == "unit":
                fault[unit] = signs * random.uniform(0.2, 0.7, 3)
            else:
                fault[unit, random.integers(3)] = float(name) * signs[0]
            wait(lambda: autopilot.sets, 5.0)
            at = autopilot.sets[0][0] if autopilot.sets else np.inf
            times[name].append((at - begun) / NS)
            time.sleep(0.5)
            wrong += [autopilot.parameters[one] for one in PARAMETERS] != [
                float(k != unit) for k in range(3)
            ]
            fault[:] = 0.0
            autopilot.armed = False
            assert wait(lambda: all(used[one] for one in PARAMETERS), 60.0), "stays out"
    for name, found in times.items():
        print(
            f"{name:5} median {np.median(found):.2f}  longest {max(found):.2f}  of {trials}"
        )
    print(f"not only the right IMU out: {wrong}; load {os.getloadavg()[0]:.1f}")


def storms(minutes: float, seconds: float, seed: int) -> None:
    """Let storms of so many seconds each loose in turn, and print what each cost."""
    from ros.storm import KINDS, vehicle, weather

    with vehicle(Path(tempfile.mkdtemp(prefix="fdi_storms_"))) as over:
        end = time.monotonic() + 60 * minutes
        while time.monotonic() < end:
            kind = KINDS[seed % len(KINDS)]
            over.listener.clear()
            time.sleep(2.5)
            cost = weather(over, kind, seconds, seed) | {
                "load of the machine": os.getloadavg()[0]
            }
            print(
                f"{seed:4} {kind:10}",
                "  ".join(f"{name} {value:.4g}" for name, value in cost.items()),
                flush=True,
            )
            seed += 1
    print("both nodes ended with exit code 0, no traceback")


def main() -> None:
    if sys.argv[1:2] == ["reader"]:
        read_plainly(int(sys.argv[2]))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("found").add_argument("--flights", type=int, default=8)
    verbs.add_parser("cpu").add_argument("--seconds", type=float, default=20.0)
    order = verbs.add_parser("failover")
    order.add_argument("--trials", type=int, default=20)
    order.add_argument("--seed", type=int, default=0)
    storm = verbs.add_parser("storms")
    storm.add_argument("--minutes", type=float, default=60.0)
    storm.add_argument("--seconds", type=float, default=30.0, help="of each storm")
    storm.add_argument("--seed", type=int, default=0)
    arguments = vars(parser.parse_args())
    {"found": found, "cpu": cpu, "failover": failover, "storms": storms}[
        arguments.pop("verb")
    ](**arguments)


if __name__ == "__main__":
    main()
