# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Streams for the tests of the monitor: a moving vehicle, white noise, and what the pipeline makes of it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate
from fdi_ros.config.config import Config
from fdi_ros.core.records import OutputRow
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Block
from fdi_ros.monitor.diagnostics import PREFIX, StatusLine, describe
from fdi_ros.monitor.output import ChannelState, Event, Output
from fdi_ros.monitor.pipeline import Pipeline

RATE = 100.0
SIGMA = 0.0025
START = 1_600_000_000_000_000_000


def body_rate(samples: int, size: float = 1.0) -> NDArray[np.float64]:
    """Smooth motion about all axes, (N, 3) rad/s."""
    t = np.arange(samples) / RATE
    return size * np.column_stack(
        [np.sin(0.7 * t), 0.6 * np.cos(1.1 * t), 0.8 * np.sin(0.3 * t + 1)]
    )


def swing(seconds: NDArray[np.float64], size: float = 0.5) -> NDArray[np.float64]:
    """Quick motion about all axes, (N, 3) rad/s."""
    return size * np.sin(
        2 * np.pi * np.outer(seconds, [0.5, 0.7, 0.3]) + np.arange(3.0)
    )


def stream(
    geometry: Geometry,
    samples: int,
    size: float = 1.0,
    seed: int = 0,
    late: float = 0.0,
) -> Block:
    """White noise of SIGMA on every channel of a moving vehicle, stamped so many seconds late."""
    rng = np.random.default_rng(seed)
    z = body_rate(samples, size) @ geometry.axes.T + rng.normal(
        0, SIGMA, (samples, geometry.n)
    )
    return Block(
        START
        + round(1e9 * late)
        + np.arange(samples, dtype=np.int64) * round(1e9 / RATE),
        z,
    )


def config(**changes: object) -> Config:
    """Settings that fit the streams; dots in the names are written as two underscores.

    The detector is one that judges each sample by itself, and nothing is to be learned of the biases: its verdicts can
    be foretold to the sample.
    """
    settings = {name.replace("__", "."): value for name, value in changes.items()}
    given = {
        "detector.name": "likelihood_ratio",
        "noise.noise_std": SIGMA,
        "sample_rate": RATE,
    }
    if settings.get("detector.name") != "sequential":
        given["bias.turn_on_std"] = 0.0
    return Config.from_parameters({**given, **settings})


def parallel(count: int, **changes: object) -> Config:
    """Settings of `count` triads mounted alike."""
    topics = [f"/imu_{k + 1}" for k in range(count)]
    return config(input="imus", imus__topics=topics, **changes)


def mounted(
    axes: NDArray[np.float64], detector: str = "sequential", **changes: object
) -> Config:
    """Settings of channels along these axes (n, 3), whatever housings they are in, judged by a detector."""
    axis = {
        "geometry.preset": "axes",
        "geometry.axes": axes.ravel().tolist(),
        "detector.name": detector,
    }
    return config(input="channels", **axis, **changes)


def struck(block: Block, faults: Sequence[str], names: Sequence[str]) -> Block:
    """The stream with faults injected."""
    return Injector([parse_fault(fault) for fault in faults], names).apply(block)


def run(
    pipeline: Pipeline, samples: int, *faults: str, **options: float
) -> tuple[Block, Output]:
    """A stream, of these options, with faults injected, and what a monitor makes of it."""
    block = struck(
        stream(pipeline.geometry, samples, **options), faults, pipeline.channel_names
    )
    return block, pipeline.process(block)


def told(pipeline: Pipeline) -> dict[str, StatusLine]:
    """What an operator is told of a monitor as it stands, by name."""
    return {
        line.name.removeprefix(PREFIX): line for line in describe(pipeline.status())
    }


def declarations(pipeline: Pipeline, output: Output) -> list[tuple[str, str]]:
    """Declared channels in order: name and state."""
    return [
        (pipeline.channel_names[e.channel], e.after.name)
        for e in output.events
        if e.declares
    ]


def seconds(event: Event) -> float:
    """Time of an event from the first sample, s."""
    return (event.stamp - START) / 1e9


def states_of(pipeline: Pipeline, output: Output, name: str) -> set[ChannelState]:
    """Every state a channel was in."""
    return {
        ChannelState(s)
        for s in np.unique(output.state[:, pipeline.channel_names.index(name)])
    }


def output_of(n: int, events: Sequence[Event] = (), **fields: object) -> Output:
    """An output made of arrays, named as its attributes; the covariance as (N, 3, 3)."""
    rows = allocate(OutputRow, len(fields["stamp"]))
    for name, values in {"instant": fields["stamp"], **fields}.items():
        if name == "covariance":
            rows[name] = np.reshape(values, (-1, 9))[:, [0, 1, 2, 4, 5, 8]]
        elif name in ("state", "residual"):
            rows[name][:, :n] = values
        else:
            rows[name] = values
    return Output(rows, n, events)
