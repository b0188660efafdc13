# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Digests of what the parts of the sample path make of hostile input and of a recording: python -m core.digests."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.compiling.compiled import INTERPRETED
from fdi_ros.config.config import Config
from fdi_ros.core.alignment import Alignment, as_block
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.sources.channels import ChannelsSource
from fdi_ros.sources.imus import ImuSource

ROOT = Path(__file__).parents[2]
FAULTS = (
    "channel=g3 kind=bias size=0.1 start=0.6 stop=0.9",
    "channel=g5 kind=dropout start=0.8 stop=0.9",
    "channel=g1 kind=stuck start=1.0",
)


def messages() -> tuple[str, int]:
    """Of messages that are whole, damaged and cut off; and how many of the last kind could be read."""
    rng, found, rows = np.random.default_rng(5), hashlib.sha256(), []
    for k in range(80):
        for row in (
            ImuTemplate("x" * (k % 9)).fill(5**k % 2**60, rng.normal(size=3), np.arange(9.0)),
            ChannelsTemplate(6).fill(rng.normal(size=6)),
        ):
            found.update(row)
            damaged = bytearray(row)
            damaged[k % 20] = rng.choice([0, 1, 255, damaged[k % 20]])
            rows.append(bytes(damaged[: len(damaged) - k % 2]))
    length = np.array([len(row) for row in rows])
    packed = np.frombuffer(b"".join(rows), np.uint8), length.cumsum() - length, length
    for decoded in (ImuSource.decode(*packed, 3), ChannelsSource.decode(*packed, 6)):
        for column in decoded:
            found.update(column.tobytes())
    return found.hexdigest(), int(decoded.good.sum())


def alignment() -> tuple[str, int]:
    """Of stamps that jump, repeat and go back; and how many samples they gave."""
    rng, found, count = np.random.default_rng(5), hashlib.sha256(), 0
    for units in (2, 3, 4):
        aligner = Alignment(units, 3, 25)
        stamp = np.cumsum(rng.integers(-1, 4, 150)) + rng.choice([0, 0, 0, 0, 40, -200], 150).cumsum() // 2
        rate = rng.normal(size=(150, 3))
        rate[::17] = np.nan
        for block in (aligner.push_block(rng.integers(0, units, 150), stamp, rate), as_block(aligner.flush(), units)):
            found.update(block.stamp.tobytes() + block.z.tobytes() + block.delivered.tobytes())
            count += len(block)
        found.update(aligner.rows.tobytes())
    return found.hexdigest(), count


def replay(detector: str) -> tuple[str, int]:
    """Of three faults in a short part of a flight; and how many events there were."""
    found, count = hashlib.sha256(), 0
    settings = {"bias.startup_bias_duration": 0.3, "bias.max_rest_rate": 10.0}
    settings |= {"detector.name": detector, "decision.latch": False, "decision.clean_time": 0.2}
    config = Config.from_file(ROOT / "config" / "two_triads.yaml", settings)
    pipeline = Pipeline.from_config(config)
    injector = Injector([parse_fault(text) for text in FAULTS], pipeline.channel_names)
    with Recording(ROOT / "bags" / "cone_flight") as recording:
        samples = Samples(recording, config, pipeline.geometry.n, end=1.4)
        for block in samples.blocks():
            injector.start_stamp = samples.origin
            output = pipeline.process(injector.apply(block))
            for name in output.rows.dtype.names:
                found.update(np.ascontiguousarray(output.rows[name]).tobytes())
            found.update("\n".join(map(repr, output.events)).encode())
            count += len(output.events)
    return found.hexdigest(), count


def digests() -> dict[str, list[str | int]]:
    """Return all of them: digest and count."""
    found = {"messages": messages(), "alignment": alignment()}
    found |= {name: replay(name) for name in ("likelihood_ratio", "sequential")}
    return {name: list(one) for name, one in found.items()}


if __name__ == "__main__":
    print(json.dumps({"interpreted": INTERPRETED, "digests": digests()}))
