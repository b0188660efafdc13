# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyros over MAVLink: what can be found at which rate, CPU, a session, and an attack on the link.

    python benchmark/mavlink.py found [--flights 8]        # three IMUs and two, bias and drift, 10, 25, 50 and 100 Hz
    python benchmark/mavlink.py cpu [--seconds 20]         # 3 x 100 Hz beside a plain pymavlink reader
    python benchmark/mavlink.py session                    # PX4 and ArduPilot simulated, with faults: all that is said
    python benchmark/mavlink.py hammer [--seconds 600]     # random MAVLink, garbage, floods, cuts, restarts

The autopilots are those of the tests (test/mavlink/autopilots.py).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
# In place of this folder, where this file would be taken for the tests' folder of the same name.
sys.path[:1] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_mavlink_"))

from fdi_ros.config.config import Config  # noqa: E402

NS = 1_000_000_000
RATES = (10.0, 25.0, 50.0, 100.0)
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


def flight(
    stack: str, rate: float, seed: int, count: int, fault: tuple[float, float], link: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Messages of IMUs in motion: unit, stamp, ns, rates (k, 3); imu_2.y has a bias and a drift from `STRIKES` on.

    With noise of 4 mrad/s, scale factors off by 0.5 %, up to about 0.8 rad/s, sampled as the autopilot does.
    link: in the steps of SCALED_IMU, cut off towards zero; else exact.
    """
    random = np.random.default_rng(seed)
    phase, factor = random.uniform(0, 2 * np.pi, 6), 1 + SCALE * random.standard_normal((3, 3))
    slow, fast = (0.25, 0.41, 0.17), (0.83, 0.67, 0.53)
    units, stamps, rates = [], [], []
    for unit in range(count):
        due = np.arange(round(SECONDS * rate)) / rate
        if stack == "ardupilot":
            stamp = due + 0.0005 * unit
            at = np.floor(stamp / 0.0025) * 0.0025
        else:
            first = 0.0007 * unit
            at = stamp = np.floor((due + random.uniform(0, 0.006) - first) / 0.005) * 0.005 + first
        omega = np.column_stack(
            [
                np.sin(2 * np.pi * slow[a] * at + phase[a]) + 0.4 * np.sin(2 * np.pi * fast[a] * at + phase[a + 3])
                for a in range(3)
            ]
        )
        z = MOTION * omega * factor[unit] + NOISE * random.standard_normal(omega.shape)
        if unit == 1:
            z[:, 1] += (fault[0] + fault[1] * (at - STRIKES)) * (at >= STRIKES)
        if link:
            z, stamp = np.trunc(z * 1e3) / 1e3, np.floor(stamp * 1e3) / 1e3
        units.append(np.full(len(at), unit))
        stamps.append(np.round((stamp + 100.0) * NS).astype(np.int64))
        rates.append(z)
    order = np.argsort(np.concatenate(stamps), kind="stable")
    return np.concatenate(units)[order], np.concatenate(stamps)[order], np.concatenate(rates)[order]


class Told(NamedTuple):
    """What was declared in one flight."""

    first: float
    """Time from the fault to the first declaration, s; infinite: there was none."""
    named: float
    """To that which names the channel that is struck."""
    wrong: int
    """Declarations that name a healthy channel, or a set without that which is struck."""
    early: int
    """Declarations before the fault."""


def judged(config: Config, messages: tuple[np.ndarray, np.ndarray, np.ndarray], struck: bool) -> Told:
    """Let the monitor judge a flight."""
    from fdi_ros.core.alignment import Alignment
    from fdi_ros.monitor.pipeline import Pipeline
    from fdi_ros.sources import source_of

    pipeline = Pipeline.from_config(config)
    declared = pipeline.process(Alignment(*source_of(config).alignment).push_block(*messages)).events
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
            given = {"imus.topics": whole.imus.topics[:count], "imus.names": whole.imus.names[:count]}
            given |= {"imus.mounts": whole.imus.mounts[: 9 * count]}
            for link, rate in product((True, False), RATES):
                config, row, wrong, early = whole.replaced({**given, "sample_rate": rate}), [], 0, 0
                for name, fault in FAULTS.items():
                    told = [
                        judged(config, flight(stack, rate, seed, count, fault, link), any(fault))
                        for seed in range(flights)
                    ]
                    wrong, early = wrong + sum(t.wrong for t in told), early + sum(t.early for t in told)
                    if any(fault):
                        row.append(f"{name}: {_share([t.first for t in told])}, {_share([t.named for t in told])}")
                kind = "1 mrad/s" if link else "exact"
                print(
                    f"{count} {stack:10}{kind:9}{rate:4g} Hz  {' | '.join(row)}  wrong {wrong}, early {early}",
                    flush=True,
                )


def _share(times: list[float]) -> str:
    """Say how many are finite, and their median."""
    known = [time for time in times if np.isfinite(time)]
    return f"{len(known)} {np.median(known):.2f}" if known else "0"


# Processes ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def started(*words: str, show: bool = False) -> Iterator[subprocess.Popen]:
    """Run a Python process; show: its lines are printed."""
    output = None if show else subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, *words], cwd=ROOT, stdout=output, stderr=output)
    try:
        yield process
    finally:
        # Not SIGINT, which whatever a shell has started in the background ignores.
        process.terminate()
        process.wait(20)


def node(name: str, stack: str, *parameters: str) -> list[str]:
    values = [word for parameter in parameters for word in ("-p", parameter)]
    file = str(ROOT / "config" / f"{stack}.yaml")
    return ["-m", f"fdi_ros.ros.{name}", "--ros-args", "--params-file", file, *values]


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory(pid: int) -> float:
    """Resident, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


def read_plainly(port: int) -> None:
    """Read all messages of a port with pymavlink, and do nothing with them."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    while link.recv_match(blocking=True) is not None:
        pass


def listen(file: str) -> None:
    """Keep when every Imu and every report of the link comes, until stopped, and write it down."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions
    from ros.harness import DEEP
    from sensor_msgs.msg import Imu

    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    one = rclpy.create_node("ears")
    heard: dict[str, list[float]] = {name: [] for name in ("imu_1", "imu_2", "imu_3", "reports")}
    for name in ("imu_1", "imu_2", "imu_3"):
        arrived = heard[name].append
        one.create_subscription(Imu, f"{name}/data_raw", lambda _, a=arrived: a(time.monotonic()), DEEP, raw=True)

    def report(message: DiagnosticArray) -> None:
        if message.status and "mavlink_node" in message.status[0].name:
            heard["reports"].append(time.monotonic())

    one.create_subscription(DiagnosticArray, "/diagnostics", report, 50)
    executor = SingleThreadedExecutor()
    executor.add_node(one)
    # It is there.
    Path(file).write_text("{}")
    while not stop:
        executor.spin_once(timeout_sec=0.1)
    Path(file).write_text(json.dumps(heard))


@contextlib.contextmanager
def listening() -> Iterator[dict[str, list[float]]]:
    """Listen in a process of its own; what it has heard is there at the end."""
    heard: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/heard.json"
        with started(__file__, "listen", file):
            while not Path(file).exists():
                time.sleep(0.1)
            yield heard
        heard |= json.loads(Path(file).read_text())


def cpu(seconds: float) -> None:
    from mavlink.autopilots import Autopilot, OverUdp, free_port

    for name in ("plain pymavlink reader", "mavlink_node"):
        port = free_port()
        words = [__file__, "reader", str(port)]
        if name == "mavlink_node":
            words = node("mavlink_node", "px4", f"url:=udpin:127.0.0.1:{port}", "mavlink_node:rate:=100.0")
        autopilot = Autopilot(boot=time.monotonic_ns() - 100 * NS, rates={26: 100.0, 116: 100.0, 129: 100.0})
        with OverUdp(port, autopilot), listening() as heard, started(*words) as process:
            time.sleep(8.0)
            before, begin, sent = cpu_seconds(process.pid), time.monotonic(), autopilot.sent
            time.sleep(seconds)
            end = time.monotonic()
            used, sent = cpu_seconds(process.pid) - before, autopilot.sent - sent
            resident = memory(process.pid)
        came = sum(begin <= at < end for unit in ("imu_1", "imu_2", "imu_3") for at in heard[unit])
        print(
            f"{name:24}{100 * used / (end - begin):6.1f} % CPU, {1e6 * used / sent:.0f} us a message, "
            f"{resident:.0f} MB; {sent / (end - begin):.0f} messages and {came / (end - begin):.0f} Imu a second"
        )


# A session -----------------------------------------------------------------------------------------------------------


def session() -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from mavlink.autopilots import Autopilot, OverUdp, free_port
    from ros.harness import listening as listener_of
    from ros.harness import wait

    for stack, fault in (("px4", (1, 1, 0.2)), ("ardupilot", (2, slice(None), 0.15))):
        print(
            f"\n{stack}: a bias of {fault[2]} rad/s on imu_{fault[0] + 1} {'y' if fault[1] == 1 else 'x, y, z'}\n",
            flush=True,
        )
        strikes = [np.inf]
        autopilot = Autopilot(stack, boot=time.monotonic_ns() - 100 * NS)
        sound = autopilot.motion

        def motion(t: float, sound=sound, strikes=strikes, fault=fault) -> np.ndarray:
            z = sound(t)
            if t >= strikes[0]:
                z[fault[0], fault[1]] += fault[2]
            return z

        autopilot.motion = motion
        port = free_port()
        said: dict[str, str] = {}

        def hear(message: DiagnosticArray, said=said) -> None:
            said.update({status.name: status.message for status in message.status})

        link = node("mavlink_node", stack, f"url:=udpin:127.0.0.1:{port}", "named_values:=true")
        with (
            OverUdp(port, autopilot) as line,
            listener_of(()) as listener,
            started(*node("fdi_node", stack), show=True),
            started(*link, show=True),
        ):
            listener.create_subscription(DiagnosticArray, "/diagnostics", hear, 50)

            def report(what: str, said=said, autopilot=autopilot) -> None:
                sys.stdout.flush()
                print(f"\n--- {what}")
                for name in sorted(said):
                    if "mavlink_node" in name or name == "fdi_node: monitor":
                        print(f"  {name}: {said[name]}")
                values = {name: round(value, 2) for name, value in autopilot.values.items()}
                print(f"  STATUSTEXT at the autopilot: {autopilot.texts}, NAMED_VALUE_FLOAT: {values}\n", flush=True)

            wait(lambda said=said: "9 of 9" in said.get("fdi_node: monitor", ""), 300.0)
            time.sleep(3.0)
            report("all is well")
            strikes[0] = (time.monotonic_ns() - autopilot.start) / NS
            wait(lambda autopilot=autopilot: autopilot.texts, 60.0)
            time.sleep(3.0)
            report("after the fault")
            line.silent = True
            time.sleep(6.0)
            report("the link is cut")
            autopilot.reboot(time.monotonic_ns())
            line.silent = False
            time.sleep(8.0)
            report("the autopilot has started anew")


# An attack -----------------------------------------------------------------------------------------------------------


def attack(port: int, seconds: float) -> None:
    """Send in turn all kinds, 5 s each, and print the counts."""
    from mavlink.attack import KINDS, Attacker

    attacker, counts = Attacker(port), Counter[str]()
    begin = time.monotonic()
    while (now := time.monotonic()) < begin + seconds:
        kind = KINDS[int((now - begin) / 5) % len(KINDS)]
        counts[kind] += attacker.burst(kind)
        time.sleep(0.02 if kind != "flood" else 0.002)
    attacker.close()
    print(dict(counts), flush=True)


def hammer(seconds: float) -> None:
    from mavlink.autopilots import Autopilot, OverUdp, free_port

    port = free_port()
    autopilot = Autopilot(boot=time.monotonic_ns() - 100 * NS)
    link = node("mavlink_node", "px4", f"url:=udpin:127.0.0.1:{port}")
    cuts: list[list[float]] = []
    with OverUdp(port, autopilot) as line, listening() as heard, started(*link) as process:
        time.sleep(8.0)
        words = [sys.executable, __file__, "attack", str(port), str(seconds)]
        attacker = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        start, before, used = time.monotonic(), memory(process.pid), cpu_seconds(process.pid)
        most = before
        while attacker.poll() is None:
            time.sleep(1.0)
            most = max(most, memory(process.pid))
            # Now and then the link is cut for 5 s, and every other time the autopilot starts anew meanwhile.
            silent = 50 < (time.monotonic() - start) % 60 < 55
            if silent and not line.silent:
                cuts.append([time.monotonic(), np.inf])
                if len(cuts) % 2:
                    autopilot.reboot(time.monotonic_ns())
            if line.silent and not silent:
                cuts[-1][1] = time.monotonic()
            line.silent = silent
        share = 100 * (cpu_seconds(process.pid) - used) / (time.monotonic() - start)
        print("sent by the attacker:", attacker.communicate()[0].strip())
        print(f"cuts of 5 s: {len(cuts)}, every other with a restart; node alive: {process.poll() is None}")
        last = memory(process.pid)
        print(f"memory {before:.1f} MB before, {most:.1f} at most, {last:.1f} at the end; CPU {share:.0f} %")
    for name in ("imu_1", "reports"):
        times = [start, *(at for at in heard[name] if at >= start)]
        apart = [
            b - a for a, b in pairwise(times) if name == "reports" or not any(c < b and a < d + 3 for c, d in cuts)
        ]
        print(f"{name}: {len(times) - 1}, longest gap {max(apart):.2f} s{'' if name == 'reports' else ' outside cuts'}")
    print(f"load of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")


def main() -> None:
    if sys.argv[1:2] == ["reader"]:
        read_plainly(int(sys.argv[2]))
        return
    if sys.argv[1:2] == ["listen"]:
        listen(sys.argv[2])
        return
    if sys.argv[1:2] == ["attack"]:
        attack(int(sys.argv[2]), float(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("found").add_argument("--flights", type=int, default=8)
    verbs.add_parser("cpu").add_argument("--seconds", type=float, default=20.0)
    verbs.add_parser("session")
    verbs.add_parser("hammer").add_argument("--seconds", type=float, default=600.0)
    arguments = vars(parser.parse_args())
    {"found": found, "cpu": cpu, "session": session, "hammer": hammer}[arguments.pop("verb")](**arguments)


if __name__ == "__main__":
    main()
