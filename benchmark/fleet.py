# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Many generated flights through `fdi fleet`, beside the time that rosbags takes only to read them.

    python benchmark/fleet.py FOLDER --flights 1000 --minutes 10

Flights are made where they are not there yet: three units turned to each other, 200 Hz, vibration in flight, biases
that wander; of ten flights one has a fault, one a drifting gyro, one late stamps, one gaps, and one in fifty is cut
off.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from mcap.writer import CompressionType, Writer

RATE, UNITS, START = 200.0, 3, 1_700_000_000_000_000_000
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TILT = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]])
MOUNTS = (np.eye(3), TURN @ TILT, TILT @ TURN)
MESSAGE = np.dtype(
    [
        ("head", "V4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("length", "<u4"),
        ("frame", "S6"),
        ("pad", "V6"),
        ("orientation", "<13f8"),
        ("rate", "<3f8"),
        ("rest", "<21f8"),
    ]
)
"""sensor_msgs/Imu in CDR, with a frame name of five characters."""
KINDS = ("healthy", "fault", "drift", "late", "gaps", *["healthy"] * 5)
CUT = 50
CONFIG = {
    "/**": {
        "ros__parameters": {
            "input": "imus",
            "sample_rate": RATE,
            "imus": {
                "topics": [f"/imu_{k + 1}" for k in range(UNITS)],
                "names": [f"imu_{k + 1}" for k in range(UNITS)],
                "mounts": [float(value) for mount in MOUNTS for value in mount.ravel()],
                "max_skew": 0.002,
            },
            "noise": {"noise_std": [0.003], "scale_std": [0.003], "timing_std": [0.0002]},
            "bias": {"startup_bias_duration": 5.0},
            "detector": {"name": "sequential", "false_alarms_per_hour": 0.001},
        }
    }
}


def rates(kind: str, seconds: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, str, float]:
    """Channels (N, 9) of a flight, rad/s; which of them has the fault, if there is one, and since when, s."""
    flying = np.clip((seconds - 8.0) / 4.0, 0.0, 1.0)
    phase = random.uniform(0, 2 * np.pi, (3, 3))
    speed = random.uniform(0.05, 1.2, (3, 3))
    body = sum(0.3 * np.sin(seconds[:, None] * speed[k] * 2 * np.pi + phase[k]) for k in range(3))
    body = body * flying[:, None]
    z = np.hstack([body @ mount for mount in MOUNTS])
    z += random.normal(0.0, 0.003, z.shape) + random.normal(0.0, 0.01, z.shape[1])
    line = random.uniform(55.0, 75.0)
    shake = random.normal(0.0, 0.008, z.shape) + 0.01 * np.sin(2 * np.pi * line * seconds)[:, None]
    z += shake * flying[:, None]
    z += np.cumsum(random.normal(0.0, 1e-4 / np.sqrt(RATE), z.shape), axis=0)
    channel, since = random.integers(z.shape[1]), random.uniform(0.3, 0.9) * seconds[-1]
    if kind == "fault":
        z[seconds >= since, channel] += random.choice([-1, 1]) * random.uniform(0.1, 0.5)
    if kind == "drift":
        z[:, channel] += 0.002 * np.maximum(0.0, seconds - since)
    return z, f"imu_{channel // 3 + 1}.{'xyz'[channel % 3]}", float(since)


def made(number: int, minutes: float) -> tuple[np.ndarray, np.ndarray, str, float]:
    """Return times (N,), s, and `rates` of one flight."""
    seconds = np.arange(round(minutes * 60 * RATE)) / RATE
    return seconds, *rates(KINDS[number % len(KINDS)], seconds, np.random.default_rng([2026, number]))


def make(path: Path, number: int, minutes: float) -> None:
    """Write one flight."""
    kind = KINDS[number % len(KINDS)]
    seconds, z, _, _ = made(number, minutes)
    count = len(seconds)
    kept = np.ones(count, dtype=bool)
    if kind == "gaps":
        for at in np.random.default_rng([2026, number, 1]).integers(count, size=5):
            kept[at : at + int(0.3 * RATE)] = False
    stamps = START + np.int64(number) * 10**12 + np.round(seconds * 1e9).astype(np.int64)
    scratch = path.with_suffix(".part")
    with scratch.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=1 << 20)
        writer.start("ros2", "benchmark")
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"")
        channels = [writer.register_channel(f"/imu_{k + 1}", "cdr", schema) for k in range(UNITS)]
        late = [5_000_000 * (kind == "late" and k == 1) for k in range(UNITS)]
        data = [encoded(k, stamps + late[k], z[:, 3 * k : 3 * k + 3]) for k in range(UNITS)]
        for i in np.flatnonzero(kept).tolist():
            at = int(stamps[i])
            for k, channel in enumerate(channels):
                writer.add_message(channel, at, data[k][i].tobytes(), at, i)
        writer.finish()
    if number % CUT == CUT - 1:
        os.truncate(scratch, scratch.stat().st_size // 2)
    scratch.rename(path)


def encoded(unit: int, stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Messages (N,) of a unit."""
    out = np.zeros(len(stamps), dtype=MESSAGE)
    out["head"] = b"\0\1\0\0"
    out["sec"], out["nanosec"] = stamps // 10**9, stamps % 10**9
    out["length"], out["frame"] = 6, f"imu_{unit + 1}".encode()
    out["rate"] = values
    return out


def flights(folder: Path, count: int, minutes: float) -> None:
    """Make the flights that are not there yet, twenty to a vehicle."""
    (folder / "config.yaml").write_text(json.dumps(CONFIG))
    wanted = []
    for number in range(count):
        path = folder / "flights" / f"vehicle_{number // 20:03d}" / f"flight_{number:04d}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        wanted += [(path, number, minutes)] * (not path.exists())
    with ProcessPoolExecutor() as pool:
        for _ in pool.map(make, *zip(*wanted, strict=True)) if wanted else ():
            pass


def read_only(folder: Path) -> float:
    """Seconds that rosbags takes to hand over every message, nothing decoded."""
    from rosbags.highlevel import AnyReader, AnyReaderError

    begun = time.perf_counter()
    for path in sorted(folder.glob("flights/*/*.mcap")):
        # What is cut off it cannot read.
        with suppress(AnyReaderError), AnyReader([path]) as reader:
            for _ in reader.messages():
                pass
    return time.perf_counter() - begun


def judged(folder: Path, words: list[str]) -> tuple[float, list[float]]:
    """Seconds of one run of `fdi fleet`, and the memory of its largest process after each second, MB."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "fdi_ros.cli", "fleet", str(folder / "flights"), "--output", str(out), "--quiet"]
    begun, memory = time.perf_counter(), []
    run = subprocess.Popen([*command, "--config", str(folder / "config.yaml"), *words])
    while run.poll() is None:
        time.sleep(1.0)
        with suppress(psutil.Error, ValueError):
            # The workers of the cluster are ours.
            family = psutil.Process().children(recursive=True)
            memory.append(max(process.memory_info().rss for process in family) / 1e6)
    if run.returncode:
        raise SystemExit(f"fdi fleet ended with {run.returncode}")
    return time.perf_counter() - begun, memory


def verdict(number: int, minutes: float, declared: list[dict[str, Any]]) -> str:
    """Return what came of a flight, from its events that declare something."""
    if KINDS[number % len(KINDS)] not in ("fault", "drift"):
        return "falsely declared" if declared else "healthy, nothing declared"
    _, _, channel, since = made(number, minutes)
    if any(event["at"] < since or channel not in event["group"] for event in declared):
        return "wrong name, or too early"
    return "named" if any(event["after"] == "FAULTY" for event in declared) else "in a set" if declared else "missed"


def verdicts(folder: Path, minutes: float) -> Counter[str]:
    """Count what came of all flights that could be judged."""
    import pyarrow.parquet as parquet

    declared: dict[str, list[dict[str, Any]]] = {}
    for event in parquet.read_table(folder / "out" / "events.parquet").to_pylist():
        if event["declares"]:
            declared.setdefault(event["flight"], []).append(event)
    rows = parquet.read_table(folder / "out" / "flights.parquet").to_pylist()
    numbers = [int(Path(row["path"]).stem.rpartition("_")[2]) for row in rows if not row["error"]]
    found = [declared.get(row["flight"], []) for row in rows if not row["error"]]
    with ProcessPoolExecutor() as pool:
        return Counter(pool.map(verdict, numbers, [minutes] * len(numbers), found, chunksize=8))


@contextmanager
def cluster(workers: int) -> Iterator[str]:
    """Start a Dask cluster on this machine and give its address."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as local:
        yield local.scheduler_address


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=10.0)
    given = parser.parse_args()
    flights(given.folder, given.flights, given.minutes)
    size = sum(path.stat().st_size for path in given.folder.glob("flights/*/*.mcap")) / 1e9
    hours = given.flights * given.minutes / 60.0
    print(f"{given.flights} flights of {given.minutes:g} minutes, {size:.1f} GB", flush=True)
    seconds = read_only(given.folder)
    print(f"rosbags, reading alone   {seconds:8.1f} s {3600 * hours / seconds:9.0f} times real time", flush=True)
    tables = None
    for name, words, workers in (
        ("1 worker", ["--workers", "1"], 0),
        ("2 workers", ["--workers", "2"], 0),
        ("Dask, 3 workers", [], 3),
    ):
        with cluster(workers) if workers else nullcontext("") as address:
            seconds, memory = judged(given.folder, words or ["--scheduler", address])
        now = [(given.folder / "out" / f"{table}.parquet").read_bytes() for table in ("flights", "events")]
        same = "" if tables in (None, now) else "  OTHER RESULTS"
        tables = tables or now
        speed = 3600 * hours / seconds
        middle, last = (max(memory[k * len(memory) // 3 :][: len(memory) // 3 + 1]) for k in (1, 2))
        flat = f"largest process {middle:.0f} MB in the middle third, {last:.0f} MB in the last"
        print(f"fdi fleet, {name:14s}{seconds:8.1f} s {speed:9.0f} times real time, {flat}{same}", flush=True)
    print("; ".join(f"{count} {words}" for words, count in sorted(verdicts(given.folder, given.minutes).items())))


if __name__ == "__main__":
    main()
