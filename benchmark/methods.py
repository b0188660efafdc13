# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CPU time of every method for one sample of a recording, and that of an earlier version beside it.

    python benchmark/methods.py RECORDING [--config FILE] [--gyros] [--earlier DIR] [--rounds N]

--gyros: without the accelerometers, which earlier versions did not judge. DIR: a checkout of the earlier version; a
relative FILE is the one of each checkout. Each method of each version runs in
a process of its own, which reads the recording, judges it once to load the code and once to be timed. The versions
take turns, so that a change of the machine's speed meets both. Figures are medians of the rounds, us; the ratio is the
median of the ratios in each round.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

HERE = Path(__file__).parents[1]
FOR_FIVE = "determinant"  # judges five channels only, which no recording of units has


def arguments_of() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--config", default="config/three_imus.yaml")
    parser.add_argument("--gyros", action="store_true")
    parser.add_argument("--earlier", type=Path, metavar="DIR")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--method", help=argparse.SUPPRESS)
    return parser.parse_args()


def timed(recording: Path, config: str, gyros: bool, method: str) -> float:
    """Return the CPU time of this version for one sample, us."""
    from fdi_ros import Config, Pipeline, read

    settings = Config.from_file(config, {"detector.name": method})
    if gyros and "accelerometers.enabled" in settings.parameters():
        settings = settings.replaced({"accelerometers.enabled": "off"})
    blocks = list(read(recording, settings))
    spent = 0.0
    for _ in range(2):
        pipeline = Pipeline.from_config(settings)
        begun = time.thread_time()
        for block in blocks:
            pipeline.process(block)
        spent = time.thread_time() - begun
    return 1e6 * spent / sum(map(len, blocks))


def time_in(checkout: Path, asked: argparse.Namespace, method: str) -> float:
    """Time a method of the version in a checkout, in a process of its own."""
    command = [sys.executable, __file__, str(asked.recording.resolve())]
    command += ["--config", asked.config, "--method", method]
    command += ["--gyros"] if asked.gyros else []
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    printed = subprocess.run(
        command,
        cwd=checkout,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return float(printed.stdout)


def main() -> None:
    asked = arguments_of()
    if asked.method:
        print(timed(asked.recording, asked.config, asked.gyros, asked.method))
        return
    from fdi_ros.detectors import DETECTORS

    checkouts = [HERE, *([asked.earlier.resolve()] if asked.earlier else [])]
    print("method, us, earlier us, ratio")
    for method in reversed(DETECTORS):
        if method == FOR_FIVE:
            continue
        rounds = [
            [time_in(checkout, asked, method) for checkout in checkouts]
            for _ in range(asked.rounds)
        ]
        cells = [f"{median(column):.1f}" for column in zip(*rounds, strict=True)]
        if asked.earlier:
            cells.append(f"{median(now / before for now, before in rounds):.2f}")
        print(", ".join((method, *cells)), flush=True)


if __name__ == "__main__":
    main()
