# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Peak memory of `fdi fleet` over the length of a flight.

    python benchmark/fleet_memory.py FOLDER --hours 1 4 24

Writes a dataflash log of so many hours (three IMUs at 400 Hz, 3.7 GB a day) where it is not there yet, judges it with
one process, and prints the largest memory that process ever had. The flight rests for a minute and flies on; one gyro
gets a bias of 0.1 rad/s after half of the time.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

RATE, UNITS, HEAD = 400, 3, b"\xa3\x95"
IMU = np.dtype(
    [("head", "S2"), ("type", "u1"), ("time", "<u8"), ("instance", "u1"), ("rate", "<f4", 3), ("force", "<f4", 3)]
)
CONFIG = {
    "input": "imus",
    "sample_rate": float(RATE),
    "imus": {
        "topics": [f"/imu_{k}" for k in range(UNITS)],
        "names": [f"imu_{k}" for k in range(UNITS)],
        "mounts": UNITS * [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    },
    "noise": {"noise_std": [0.003], "scale_std": [0.003], "timing_std": [0.0002]},
}


def described(number: int, name: str, types: str, columns: str, size: int) -> bytes:
    """FMT record of a message."""
    return HEAD + struct.pack("<BBB4s16s64s", 128, number, size, name.encode(), types.encode(), columns.encode())


def make(path: Path, hours: float) -> None:
    """Write a log."""
    random = np.random.default_rng(2026)
    scratch = path.with_suffix(".part")
    with scratch.open("wb") as file:
        file.write(described(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89))
        file.write(described(70, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", IMU.itemsize))
        minutes = round(60 * hours)
        for minute in range(minutes):
            count = np.arange(60 * RATE) + minute * 60 * RATE
            seconds = count / RATE
            body = np.sin(seconds[:, None] * [0.8, 1.1, 0.5]) * [0.5, 0.4, 0.3] * (minute > 0)
            rows = np.zeros((len(count), UNITS), dtype=IMU)
            rows["head"], rows["type"], rows["instance"] = HEAD, 70, np.arange(UNITS)
            rows["time"] = (count * (1_000_000 // RATE) + 10_000_000)[:, None]
            rows["rate"] = body[:, None, :] + random.normal(0.0, 0.003, (len(count), UNITS, 3))
            rows["rate"][:, 1, 1] += 0.1 * (2 * minute >= minutes)
            rows["force"] = [0.0, 0.0, -9.81]
            file.write(rows.tobytes())
    scratch.rename(path)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 2.0])
    parser.add_argument("words", nargs="*", help="further options of fdi fleet, after --")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    config = given.folder / "config.yaml"
    config.write_text(json.dumps({"/**": {"ros__parameters": CONFIG}}))
    for hours in sorted(given.hours):
        path, out = given.folder / f"flight_{hours:g}_h.bin", given.folder / "out"
        if not path.exists():
            make(path, hours)
        shutil.rmtree(out, ignore_errors=True)
        command = [sys.executable, "-m", "fdi_ros.cli", "fleet", str(path), "--output", str(out), "--quiet"]
        begun = time.perf_counter()
        subprocess.run([*command, "--config", str(config), "--workers", "1", *given.words], check=True)
        seconds = time.perf_counter() - begun
        # Of all processes so far: they come in the order of their length.
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        speed = 3600 * hours / seconds
        print(f"{hours:5g} h, {path.stat().st_size / 1e9:.2f} GB: {peak:.0f} MB at most, {speed:.0f} times real time")


if __name__ == "__main__":
    main()
