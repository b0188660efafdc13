# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Real gyros: a bias on each of the nine channels in turn, at rest and in the fastest motion, and how soon it is named.

python benchmark/recording.py ../shared/data/mimu_exp1 [--config config/three_imus.yaml] [--size 0.2] [--end 180]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import parse_fault
from fdi_ros.faults.injection import Injector
from fdi_ros.model.block import Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline


def read(path: Path, config: Config, end: float) -> Block:
    channels = Pipeline(config).geometry.n
    with Recording(path) as recording:
        blocks = list(Samples(recording, config, channels, end=end).blocks())
    return Block(np.concatenate([block.stamp for block in blocks]), np.concatenate([block.z for block in blocks]))


def declared(pipeline: Pipeline, output: Output, origin: int) -> str:
    found = [
        (pipeline.channel_names[e.channel], e.after.name, (e.stamp - origin) / 1e9) for e in output.events if e.declares
    ]
    return ", ".join(f"{name} {state} after {1e3 * delay:.0f} ms" for name, state, delay in found) or "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--config", type=Path, default=Path("config/three_imus.yaml"))
    parser.add_argument("--size", type=float, default=0.2, help="rad/s")
    parser.add_argument("--end", type=float, default=180.0, help="s")
    arguments = parser.parse_args()
    config = Config.from_file(arguments.config)
    block = read(arguments.bag, config, arguments.end)
    sound = Pipeline(config)
    output = sound.process(block)
    print(f"{len(block)} samples, no fault: declared {declared(sound, output, int(block.stamp[0]))},", end=" ")
    print(f"largest statistic {np.nanmax(output.statistic / output.threshold):.2f} of the threshold")
    speed = np.linalg.norm(output.rate, axis=1)
    for row, words in (
        (int(np.argmin(np.abs(block.stamp - block.stamp[0] - 60e9))), "at rest"),
        (int(np.nanargmax(speed)), "moving"),
    ):
        start = (block.stamp[row] - block.stamp[0]) / 1e9
        print(f"\nbias of {arguments.size} rad/s from {start:.2f} s, {words} at {np.degrees(speed[row]):.1f} deg/s")
        for name in sound.channel_names:
            pipeline = Pipeline(config)
            fault = parse_fault(f"channel={name} kind=bias size={arguments.size} start={start:.9f}")
            result = pipeline.process(Injector([fault], pipeline.channel_names).apply(block))
            print(f"  {name}: {declared(pipeline, result, int(block.stamp[row]))}")


if __name__ == "__main__":
    main()
