# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the programs that measure the whole monitor share: arguments, monitors, simulated units, outcomes, tables.

`conditions`, `delays`, `false_alarms`, `several_faults`, `unit_faults` and `flights` import it. They use only names
that every version of the package has, so that an older one may be measured beside: put its folder into PYTHONPATH.
Shipped configs are those of the package that is imported.
"""

from __future__ import annotations

import argparse
import json
import re
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

import fdi_ros
from fdi_ros import Block, Config, Geometry, Pipeline
from fdi_ros.experiments.simulate import GyroErrors, Gyros, regular_stamps, vehicle_motion
from fdi_ros.monitor.output import ChannelState, Output

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]
Rng = np.random.Generator
Kind = TypeVar("Kind")
Outcome = TypeVar("Outcome")
Fly = Callable[[Pipeline, Rng, Kind], Outcome]
"""One flight with a fresh monitor, a random generator, and what is different from other flights; and its outcome."""

CONFIGS = Path(fdi_ros.__file__).parents[1] / "config"
START = 10**18
"""Stamp of the first sample of a simulated flight, ns."""
PARALLEL = {
    "imus.topics": ("imu_1/data_raw", "imu_2/data_raw", "imu_3/data_raw"),
    "imus.names": ("imu_1", "imu_2", "imu_3"),
    "imus.mounts": (),
}
"""What makes three parallel units of the two of two_imus.yaml."""
IDEAL = {"noise.scale_std": 0.0, "noise.timing_std": 0.0}
"""Settings where axes and clocks are simulated without error."""


def arguments_of(description: str | None, **more: dict[str, Any]) -> argparse.Namespace:
    """Parse the command line: what every program takes, and more options by name."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detector", help="detector.name; as in the config unless given")
    parser.add_argument("--config", type=Path, help="parameter file; both simulated mountings unless given")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="parameter that wins over it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a small part of the full size")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    for name, about in more.items():
        parser.add_argument(name if about.get("nargs") else f"--{name}", **about)
    return parser.parse_args()


def size_of(arguments: argparse.Namespace, name: str, quick: float) -> Any:
    """Return an argument that says how much is to be done; with --quick no more than so much."""
    asked = getattr(arguments, name)
    return min(asked, quick) if arguments.quick else asked


def overrides_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return parameters given by --set and --detector, ``{"section.field": value}``."""
    changes: dict[str, Any] = {}
    for text in arguments.set:
        name, _, value = text.partition("=")
        changes[name] = yaml.safe_load(value)
    return changes | ({"detector.name": arguments.detector} if arguments.detector else {})


def configs_of(arguments: argparse.Namespace, settings: dict[str, Any] | None = None) -> dict[str, Config]:
    """Return the configs to be measured by name; settings win over the file, the command line over both."""
    changes = {**(settings or {}), **overrides_of(arguments)}
    if arguments.config:
        return {arguments.config.stem: Config.from_file(arguments.config, changes)}
    path = CONFIGS / "two_imus.yaml"
    return {
        "cone": Config.from_file(path, changes),
        "parallel": Config.from_file(path, {**PARALLEL, **changes}),
    }


def renewed(pipeline: Pipeline) -> Pipeline:
    """Return the monitor as it was before its first sample."""
    # Version 0.1 cannot start again: it is built anew.
    if not hasattr(pipeline, "restart"):
        return Pipeline.from_config(pipeline.config)
    pipeline.restart()
    return pipeline


def repeated(
    pipeline: Pipeline, count: int, fly: Fly[Kind, Outcome], kind: Kind, seed: int, *words: object
) -> tuple[list[Outcome], float]:
    """Fly so many times, each with a random generator of its own; return the outcomes and the seconds it took."""
    begun, outcomes = time.perf_counter(), []
    for k in range(count):
        pipeline = renewed(pipeline)
        outcomes.append(fly(pipeline, generator(seed, *words, k), kind))
    return outcomes, time.perf_counter() - begun


def by_mounting(
    arguments: argparse.Namespace,
    count: int,
    fly: Fly[Kind, Outcome],
    kinds: Iterable[Kind],
    settings: dict[str, Any] | None = None,
) -> Iterator[tuple[str, Kind, list[Outcome], float]]:
    """Fly every kind so many times with every config; yield its name, the kind, outcomes and the seconds they took."""
    chosen = list(kinds)
    for mounting, config in configs_of(arguments, settings).items():
        pipeline = Pipeline.from_config(config)
        for kind in chosen:
            yield mounting, kind, *repeated(pipeline, count, fly, kind, arguments.seed, mounting, kind)


def generator(seed: int, *words: object) -> Rng:
    """Random generator of its own for each trial: what is measured beside it changes nothing."""
    return np.random.default_rng([seed, zlib.crc32(" ".join(map(str, words)).encode())])


class Moving(Protocol):
    """A motion as a function of time: `Motion`, or one with more on top."""

    def rate_at(self, t: Array) -> Array:
        """Body rate (N, 3) rad/s at times t (N,) s."""


@dataclass(frozen=True)
class Unit:
    """Simulated gyros as they were made, and the monitor's idea of them."""

    geometry: Geometry
    gyros: Gyros
    noise_std: Array
    """(n,) rad/s, as configured."""
    sample_rate: float

    @property
    def unit_of(self) -> NDArray[np.int64]:
        """(n,) number of the unit that each channel belongs to: three consecutive channels each."""
        return np.arange(self.geometry.n) // 3

    def stamps(self, duration: float) -> Stamps:
        """(N,) ns."""
        return regular_stamps(duration, self.sample_rate, START)

    def rates(self, motion: Moving, seconds: Array, late: Array | float = 0.0) -> Array:
        """Return what sound channels show without noise and bias, (N, n) rad/s.

        Parameters
        ----------
        motion
            Of the body.
        seconds
            (N,) s since the start, as stamped.
        late
            By how much the stamp of each unit lies after its sampling instant, s: a number, (units,) or (N, units).
        """
        shown = np.empty((len(seconds), self.geometry.n))
        every = np.broadcast_to(late, (len(seconds), int(self.unit_of[-1]) + 1))
        for k in range(every.shape[1]):
            own = slice(3 * k, 3 * k + 3)
            shown[:, own] = motion.rate_at(seconds - every[:, k] + self.gyros.delay[3 * k]) @ self.gyros.axes[own].T
        return shown


def made(pipeline: Pipeline, rng: Rng, ideal: bool = False) -> Unit:
    """Make a unit as the monitor expects it: axes, scale factors, sampling instants and biases of small MEMS units.

    Ideal: only the biases are not as they should be.
    """
    errors = GyroErrors(scale_std=0.0, misalignment_std=0.0, delay_std=0.0) if ideal else GyroErrors()
    gyros = errors.draw(pipeline.geometry, rng)
    noise = pipeline.noise.for_channels(pipeline.geometry.n)
    return Unit(pipeline.geometry, gyros, np.asarray(noise.noise_std), pipeline.config.sample_rate)


def simulated(unit: Unit, stamp: Stamps, clean: Array, noise: Array) -> Block:
    """Return samples of sound channels: what they show, and noise in noise_std, both (N, n), and their bias."""
    return Block(stamp, clean + unit.gyros.bias + noise * unit.noise_std)


class Flight(NamedTuple):
    """A simulated unit in motion, before noise and faults."""

    unit: Unit
    stamp: Stamps
    clean: Array
    """(N, n) rad/s: what sound channels show without noise and bias."""

    @property
    def seconds(self) -> Array:
        """(N,) s since the first sample."""
        return seconds_of(self.stamp)

    def block(self, noise: Array) -> Block:
        """Return samples with noise (N, n) in noise_std, and whatever else is added to it."""
        return simulated(self.unit, self.stamp, self.clean, noise)


def flight_of(pipeline: Pipeline, rng: Rng, length: float, ideal: bool = False) -> Flight:
    """Make a unit and move it as a small vehicle does, for so many seconds."""
    unit = made(pipeline, rng, ideal)
    stamp = unit.stamps(length)
    return Flight(unit, stamp, unit.rates(vehicle_motion(length, rng), seconds_of(stamp)))


def seconds_of(stamp: Stamps) -> Array:
    """(N,) s since the first."""
    return np.asarray((stamp - stamp[0]) * 1e-9)


def faulty(output: Output) -> Mask:
    """(N, n) whether a channel is declared by itself."""
    return np.asarray((output.state == ChannelState.FAULTY) | (output.state == ChannelState.STALE))


def in_set(output: Output) -> Mask:
    """(N, n) whether a channel is one of a set that holds a faulty one."""
    return np.asarray(output.state == ChannelState.AMBIGUOUS)


def suspect(output: Output) -> Mask:
    """(N, n) whether a channel is under suspicion."""
    return np.asarray(output.state == ChannelState.SUSPECT)


def unchecked(output: Output) -> Mask:
    """(N, n) whether a fault of a channel would go unseen."""
    return np.asarray(output.state == ChannelState.UNCHECKED)


class Table:
    """A table that is printed row by row, and kept.

    Parameters
    ----------
    formats
        Of each column: its name, with _ for spaces, and the format of its values; text where they do not fit.
    """

    def __init__(self, **formats: str) -> None:
        self.formats = formats
        self.rows: list[dict[str, Any]] = []
        print(" ".join(self._cell(f, name.replace("_", " "), name) for name, f in formats.items()), flush=True)

    def add(self, kept: dict[str, Any] | None = None, /, **values: Any) -> None:
        """Print one row, and keep it with further figures."""
        self.rows.append({**values, **(kept or {})})
        print(" ".join(self._cell(f, values[name], name) for name, f in self.formats.items()), flush=True)

    def write(self, arguments: argparse.Namespace) -> None:
        """Write the rows to the JSON file that is asked for."""
        if arguments.json:
            asked = {name: str(value) for name, value in vars(arguments).items()}
            figures = {"version": str(CONFIGS.parent), "arguments": asked, "rows": self.rows}
            arguments.json.write_text(json.dumps(figures, indent=1, default=_plain), encoding="utf-8")

    @staticmethod
    def _cell(form: str, value: Any, name: str) -> str:
        side, width = ("<" if form[0] == "<" else ">"), max(int(re.findall(r"\d+", form)[0]), len(name))
        text = value if isinstance(value, str) else "-" if value is None else format(value, form.lstrip("<>"))
        return f"{text.strip():{side}{width}}"


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else str(value)
