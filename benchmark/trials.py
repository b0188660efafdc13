# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the parts of `estimator.py` share: what is asked, monitors, simulated gyros, motions, outcomes.

Shipped configs are those of the package that is imported; noise, scale errors and skew of the simulated gyros are
stated here.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import fdi_ros
from fdi_ros import Block, Config, Geometry, Pipeline
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.experiments.flight import (
    GyroErrors,
    Gyros,
    Motion,
    regular_stamps,
    vehicle_motion,
)
from fdi_ros.model.samples import Array, Int, Mask
from fdi_ros.monitor.output import ChannelState, Output

Rng = np.random.Generator
Row = tuple[str, dict[str, Any]]  # what was measured, in words, and its figures by name

CONFIGS = Path(fdi_ros.__file__).parents[1] / "config"
START = 10**18  # stamp of the first sample of a simulated flight, ns
RATE = 100.0  # samples a second
NOISE = 0.003  # standard deviation of the white noise of a channel in one sample, rad/s: "sigma" in all tables
STATED: dict[str, Any] = {
    "sample_rate": RATE,
    "noise.noise_std": (NOISE,),
    "noise.scale_std": (0.002,),
    "noise.timing_std": (0.0003,),
}
IDEAL: dict[str, Any] = {"noise.scale_std": (0.0,), "noise.timing_std": (0.0,)}
"""Settings where axes and clocks are simulated without error."""
PARALLEL: dict[str, Any] = {
    "imus.topics": ("imu_1/data_raw", "imu_2/data_raw", "imu_3/data_raw"),
    "imus.names": ("imu_1", "imu_2", "imu_3"),
    "imus.mounts": (),
}
"""What makes three parallel units of the two of two_imus.yaml."""
NO_ERRORS = GyroErrors(
    scale_std=0.0, misalignment_std=0.0, delay_std=0.0
)  # only the biases are not as they should be
REST = 6.0  # at the start of every flight, s


@dataclass(frozen=True)
class Asked:
    """What is asked on the command line."""

    trials: int | None = None
    seed: int = 1
    data: Path = Path("../shared/data")
    only: str = ""
    settings: dict[str, Any] = field(default_factory=dict)

    def count(self, usual: int) -> int:
        """Trials of each row."""
        return usual if self.trials is None else self.trials

    def wants(self, label: str) -> bool:
        """Whether a row is to be measured."""
        return self.only in label

    def rng(self, *words: object) -> Rng:
        """Random generator of each trial's own: what is measured beside it changes nothing."""
        return np.random.default_rng(
            [self.seed, zlib.crc32(" ".join(map(str, words)).encode())]
        )

    def configs(self, settings: dict[str, Any] | None = None) -> dict[str, Config]:
        """Return the configs of six channels on a cone and nine of three parallel units; the command line wins."""
        changes = {**STATED, **(settings or {}), **self.settings}
        path = CONFIGS / "two_imus.yaml"
        return {
            "six": Config.from_file(path, changes),
            "nine": Config.from_file(path, {**PARALLEL, **changes}),
        }

    def monitors(self, settings: dict[str, Any] | None = None) -> dict[str, Pipeline]:
        """Return the monitors of `configs`."""
        return {
            name: Pipeline.from_config(config)
            for name, config in self.configs(settings).items()
        }


def fresh(pipeline: Pipeline, block: Block) -> Output:
    """Judge a block with the monitor as it was before its first sample."""
    pipeline.restart()
    return pipeline.process(block)


@dataclass(frozen=True)
class Sines:
    """Rest, then one sine about each axis."""

    amplitude: float  # rad/s; 0: rest for ever
    turn: Array  # (3,) rad/s
    phase: Array  # (3,)

    @classmethod
    def drawn(cls, amplitude: float, rng: Rng) -> Sines:
        """With periods of 3 to 10 s."""
        return cls(
            amplitude, 2 * np.pi / rng.uniform(3, 10, 3), rng.uniform(0, 2 * np.pi, 3)
        )

    def rate_at(self, t: Array) -> Array:
        """Body rate (N, 3) rad/s at times t (N,) s."""
        begun = np.clip(t - REST, 0, 1)[:, None]
        return self.amplitude * begun * np.sin(np.outer(t, self.turn) + self.phase)


@dataclass(frozen=True)
class Flight:
    """Simulated gyros in motion, before noise and faults."""

    geometry: Geometry
    gyros: Gyros
    motion: Motion | Sines
    stamp: Int
    late: Array | float = 0.0
    """By how much the stamp of each unit lies after its sampling instant, s: a number, (units,) or (N, units)."""

    @classmethod
    def of(
        cls,
        pipeline: Pipeline,
        rng: Rng,
        seconds: float,
        motion: Motion | Sines | None,
        errors: GyroErrors = NO_ERRORS,
    ) -> Flight:
        """Make gyros and fly them; None: as a small vehicle flies."""
        gyros = errors.draw(pipeline.geometry, rng)
        stamp = regular_stamps(seconds, pipeline.config.sample_rate, START)
        return cls(
            pipeline.geometry,
            gyros,
            motion or vehicle_motion(seconds, rng, rest=REST),
            stamp,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Samples and channels."""
        return len(self.stamp), self.geometry.n

    @property
    def seconds(self) -> Array:
        """(N,) s since the first sample."""
        return seconds_of(self.stamp)

    @property
    def truth(self) -> Array:
        """Body rate (N, 3) rad/s."""
        return self.motion.rate_at(self.seconds)

    def shown(self) -> Array:
        """Return what healthy channels show but for noise, (N, n) rad/s."""
        shown = np.empty(self.shape)
        every = np.broadcast_to(self.late, (len(shown), self.geometry.n // 3))
        for k in range(every.shape[1]):
            own = slice(3 * k, 3 * k + 3)
            at = self.seconds - every[:, k] + self.gyros.delay[3 * k]
            shown[:, own] = self.motion.rate_at(at) @ self.gyros.axes[own].T
        return shown + self.gyros.bias

    def block(self, added: Array) -> Block:
        """Return samples with noise and faults (N, n), in sigma."""
        return Block(self.stamp, self.shown() + NOISE * added)


def seconds_of(stamp: Int) -> Array:
    """(N,) s since the first."""
    return np.asarray((stamp - stamp[0]) * 1e-9)


def walks(rng: Rng, shape: tuple[int, int], walk: float) -> Array:
    """Random walks of the biases, (N, n) in sigma; walk: rad/s per square root of a second."""
    return np.cumsum(walk / NOISE / np.sqrt(RATE) * rng.standard_normal(shape), axis=0)


Noise = Callable[[Rng, int, int], Array]  # noise of unit variance, (rows, n)


def white(rng: Rng, rows: int, n: int) -> Array:
    """White and normal."""
    return rng.standard_normal((rows, n))


def faulty(output: Output) -> Mask:
    """(N, n) whether a channel is declared by itself."""
    return np.asarray(
        (output.state == ChannelState.FAULTY) | (output.state == ChannelState.STALE)
    )


def is_state(output: Output, state: ChannelState) -> Mask:
    """(N, n) whether a channel is AMBIGUOUS (in a set that holds a faulty one), SUSPECT, UNCHECKED, as asked for."""
    return np.asarray(output.state == state)


def first(rows: Mask) -> float:
    """Count samples up to and with the first that is true; inf: none is."""
    return float(rows.argmax() + 1) if rows.any() else np.inf


class Found(NamedTuple):
    """What came of the fault of one channel."""

    declared: float  # samples to the declaration of the channel, or of a set that holds it; inf: none
    named: float  # until it stands alone
    wrong: bool  # a healthy channel was declared by itself
    early: bool  # something stood declared before the fault
    judged: bool  # the channels were checked when it began


def found(
    output: Output,
    channel: int,
    onset: int,
    guilty: tuple[int, ...] = (),
    since: int = 0,
) -> Found:
    """Say what came of a fault of one channel from a sample on; guilty: others that are faulty, all clear since."""
    alone, among = faulty(output), is_state(output, ChannelState.AMBIGUOUS)
    alone[:, list(guilty)] = among[:, list(guilty)] = False
    wrong = np.delete(alone[onset:], channel, axis=1).any()
    early = (alone | among)[since:onset].any()
    own = alone[onset:, channel]
    judged = not is_state(output, ChannelState.UNCHECKED)[onset - 1, channel]
    return Found(
        first(own | among[onset:, channel]),
        first(own),
        bool(wrong),
        bool(early),
        bool(judged),
    )


def summary(outcomes: list[Found], most: float) -> dict[str, Any]:
    """Figures of faults that were watched for at most so many samples: mean and median (missed ones count as that)."""
    kept = [o for o in outcomes if o.judged and not o.early]
    declared, named = (np.array([o[k] for o in kept]) for k in (0, 1))
    share = {
        name: sum(getattr(o, name) for o in outcomes) / len(outcomes)
        for name in ("wrong", "early")
    }
    share["unjudged"] = sum(not o.judged for o in outcomes) / len(outcomes)
    if not kept:
        return share
    return {
        "declared": float(np.minimum(declared, most).mean()),
        "error": float(np.minimum(declared, most).std() / np.sqrt(len(kept))),
        "median": float(np.median(declared)),
        "named": float(np.minimum(named, most).mean()),
        "named_median": float(np.median(named)),
        "missed": float(np.isinf(declared).mean()),
        "unnamed": float(np.isinf(named).mean()),
        **share,
    }


FOUND = {
    **dict.fromkeys(("declared", "error", "median", "named", "named_median"), ".1f"),
    **dict.fromkeys(("missed", "unnamed", "wrong", "early", "unjudged"), ".1%"),
}
"""Formats of the figures of `summary`."""


def labelled(
    asked: Asked, settings: dict[str, Any] | None, kinds: Any
) -> Iterator[tuple[str, Pipeline, Any]]:
    """Every kind with both mountings that is asked for: its label, the monitor and the kind."""
    for mounting, pipeline in asked.monitors(settings).items():
        for kind in kinds:
            if asked.wants(label := f"{mounting} {kind}"):
                yield label, pipeline, kind


def array_of(config: Config) -> Config:
    """Return the config of one array of the channels of a config of units."""
    axes = Pipeline.from_config(config).geometry.axes
    mounting = {
        "geometry.preset": "axes",
        "geometry.axes": tuple(axes.ravel().tolist()),
    }
    # The cone's own preset knows its triads; its fourth axis is the reverse of the unit's.
    mounting = mounting if len(axes) > 6 else {"geometry.preset": "two_triad_cone"}
    same = {
        name: value
        for name, value in config.parameters().items()
        if name.split(".")[0] in ("bias", "detector")
    }
    return Config.from_parameters({"input": "channels", **STATED, **mounting, **same})


def ways(
    asked: Asked, settings: dict[str, Any] | None, kinds: Any
) -> Iterator[tuple[str, str, Config, Any]]:
    """Every kind with both mountings and both inputs: its label, the mounting, the config and the kind."""
    for mounting, units in asked.configs(settings).items():
        for way, config in (("Imu topics", units), ("array", array_of(units))):
            for kind in kinds:
                if asked.wants(label := f"{mounting}, {way}, {kind}"):
                    yield label, mounting, config, kind


def write_bag(
    block: Block, topics: tuple[str, ...], path: Path, late: Array | float = 0.0
) -> None:
    """Write samples as messages of each unit, stamped late by (N, units) s; they arrive when they are stamped."""
    stamps = block.stamp[:, None] + np.round(
        1e9 * np.broadcast_to(late, (len(block.stamp), len(topics)))
    ).astype(int)
    template = ImuTemplate("imu")
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        units = [
            writer.add_connection(topic, "sensor_msgs/msg/Imu", typestore=store)
            for topic in topics
        ]
        for at in np.argsort(stamps, axis=None, kind="stable"):
            row, unit = divmod(int(at), len(topics))
            data = template.fill(
                stamps[row, unit],
                block.z[row, 3 * unit : 3 * unit + 3].tolist(),
                (0.0,) * 9,
            )
            writer.write(units[unit], int(stamps[row, unit]), data)
