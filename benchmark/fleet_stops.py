# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A run of `fdi fleet` that is stopped in every way there is, beside one that is not: nothing may be lost.

    python benchmark/fleet.py FOLDER --flights 1000 --minutes 10
    python benchmark/fleet_stops.py FOLDER

One worker process killed, then the whole run; a worker of a Dask cluster killed, then its scheduler; Ctrl-C; a disk
that takes no more (files of a limited size stand for it). Each time the same command goes on. At the end the tables are
compared, byte by byte, with those that benchmark/fleet.py has left in FOLDER/out.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as parquet

Act = Callable[[subprocess.Popen[str]], None]


def count(out: Path) -> int:
    """Flights whose rows are written."""
    files = [*out.glob("parts/[0-9]*/flights.parquet"), *out.glob("flights.parquet")]
    return sum(parquet.read_metadata(file).num_rows for file in files)


def run(folder: Path, words: list[str], acts: dict[float, Act], flights: int, most: int | None = None) -> None:
    """Run until it ends, doing something at given shares of the flights; print what it says."""
    out = folder / "stopped"
    command = [sys.executable, "-m", "fdi_ros.cli", "fleet", str(folder / "flights"), "--output", str(out), "--quiet"]
    before = count(out)

    def limit() -> None:
        # Ignored by what a shell starts in the background.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if most is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    begun = time.perf_counter()
    # Killed by its number, not by its group: a worker must not outlive it either.
    run = subprocess.Popen(
        [*command, "--config", str(folder / "config.yaml"), *words], stderr=subprocess.PIPE, text=True, preexec_fn=limit
    )
    waiting = sorted(acts.items())
    while run.poll() is None:
        time.sleep(0.2)
        if waiting and count(out) >= waiting[0][0] * flights:
            waiting.pop(0)[1](run)
    said = (run.stderr.read() if run.stderr else "").strip()
    taken = time.perf_counter() - begun
    print(f"  exit {run.returncode}, {before} -> {count(out)} flights in {taken:.0f} s: {said or 'nothing said'}")
    if waiting:
        print("  ENDED BEFORE IT WAS STOPPED: give it more flights")
    time.sleep(2)
    left = [one for one in psutil.process_iter(["cmdline"]) if str(out) in " ".join(one.info["cmdline"] or [])]
    if left:
        print(f"  STILL RUNNING: {left}")


def kill_worker(run: subprocess.Popen[str]) -> None:
    """Kill the largest of its processes."""
    children = psutil.Process(run.pid).children(recursive=True)
    max(children, key=lambda child: child.memory_info().rss).kill()


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, subprocess.Popen[str], list[subprocess.Popen[str]]]]:
    """Start a Dask scheduler and its workers as programs of their own."""
    with tempfile.TemporaryDirectory() as scratch:
        where = Path(scratch) / "scheduler.json"
        quiet: dict[str, Any] = {
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
            "cwd": scratch,
            "text": True,
        }
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
        words = ["--port", "0", "--no-dashboard", "--scheduler-file", str(where), "--host", "127.0.0.1"]
        scheduler = subprocess.Popen([*dask, *words], **quiet)
        while not where.exists():
            time.sleep(0.1)
        dask = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(where)]
        words = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--death-timeout", "60"]
        own = [subprocess.Popen([*dask, *words], **quiet) for _ in range(workers)]
        try:
            yield json.loads(where.read_text())["address"], scheduler, own
        finally:
            for one in (*own, scheduler):
                one.kill()
                one.wait()


def main() -> None:
    """Stop it, go on, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    flights = len(list(folder.glob("flights/*/*.mcap")))
    shutil.rmtree(folder / "stopped", ignore_errors=True)
    print("two workers; at 10 % one is killed, at 25 % the whole run:")
    run(folder, ["--workers", "2"], {0.1: kill_worker, 0.25: lambda run: run.kill()}, flights)
    print("Dask, three workers; at 40 % one is killed, at 55 % the scheduler:")
    with cluster(3) as (address, scheduler, workers):
        acts: dict[float, Act] = {0.4: lambda _: workers[0].kill(), 0.55: lambda _: scheduler.kill()}
        run(folder, ["--scheduler", address], acts, flights)
    print("the scheduler is not there:")
    run(folder, ["--scheduler", address], {}, flights)
    print("two workers; Ctrl-C at 70 %:")
    run(folder, ["--workers", "2"], {0.7: lambda run: run.send_signal(signal.SIGINT)}, flights)
    print("no file may be larger than 20 kB:")
    run(folder, ["--workers", "2"], {}, flights, most=20_000)
    print("two workers, not stopped:")
    run(folder, ["--workers", "2"], {}, flights)
    for table in ("flights", "events"):
        one, other = (folder / out / f"{table}.parquet" for out in ("out", "stopped"))
        same = one.read_bytes() == other.read_bytes()
        print(f"{table}: {parquet.read_metadata(other).num_rows} rows, {'the same bytes' if same else 'OTHER ROWS'}")


if __name__ == "__main__":
    main()
