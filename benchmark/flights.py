# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recorded flights: calibrated on one, replayed on the others, as they are and with faults injected into every channel.

    python benchmark/flights.py ../shared/data [--detector NAME] [--noise | --calibrated RECORDING=FILE ...]
        [--only phantom4] [--quick] [--json FILE]

The settings for a flight come from another one of the same vehicle (a recording without a sister is cut in two): from
`fdi calibrate`, in this process; from a file that was calibrated on RECORDING; or, with --noise, from a plain estimate:
the mean of each channel's residual as its bias, and the noise that explains the mean squares of the residuals.

Sound: declared lists the channels that are declared, those of sets in round brackets, those that are not known to be
sound in square ones: solo imu_1.x disagrees with the other units by itself, and counts nowhere else. events counts
declarations (channels declared at one sample are one) where the monitor is cleared after each.

Faults begin at 25, 50 and 75 % of a flight, at every channel, and are watched for 10 s. in 1, 2, 4, 10 s: the channel
alone was named by then; at 4 s the others are: in a set with others; silent; in a false set, without the channel;
wrong: a sound channel was named while the fault was watched; before: something stood declared already when the fault
began, which is no detection.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import nnls
from trials import (
    CONFIGS,
    Array,
    Mask,
    Table,
    arguments_of,
    faulty,
    generator,
    in_set,
    overrides_of,
    renewed,
    seconds_of,
)

from fdi_ros import Block, Config, Geometry, Pipeline
from fdi_ros.bag.samples import read_block
from fdi_ros.calibration.calibrate import calibrate
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import fault_from
from fdi_ros.faults.injection import Injector
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.output import Output

RECORDINGS: dict[str, tuple[str, ...]] = {
    "phantom4": ("phantom4/h02", "phantom4/h04", "phantom4/h05", "phantom4/v01"),
    "solo": ("solo",),
    "mimu": ("mimu_exp1",),
}
"""Of each vehicle, under the folder of the data."""
PARTS: dict[str, tuple[float, ...]] = {"solo": (0.0, 105.0, 145.0), "mimu_exp1": (0.0, 90.0, 180.0, 210.0)}
"""Parts of a recording without a sister, from and to s, with rest and motion in each."""
SHAKEN = "mimu_exp1 180 s to 210 s"
"""Shaken until the gyros saturate: no settings from here, and no faults."""
EXCEPTED = {"solo": ("imu_1.x",)}
"""Channels that are not known to be sound."""
BASE: dict[str, dict[str, Any]] = {
    "phantom4": {"sample_rate": 120.0, "imus.topics": tuple(f"/imu_{k}/data_raw" for k in range(1, 5))},
    "solo": {"sample_rate": 50.0, "imus.topics": tuple(f"/imu_{k}/data_raw" for k in range(1, 4))},
    "mimu": {},
}
"""Settings of each vehicle that no calibration finds out; mounts are the identity. mimu: config/three_imus.yaml."""
FAULTS: dict[str, dict[str, Any]] = {
    "bias 0.05 rad/s": {"kind": "bias", "size": 0.05},
    "bias 0.1 rad/s": {"kind": "bias", "size": 0.1},
    "bias 0.3 rad/s": {"kind": "bias", "size": 0.3},
    "drift 0.01 rad/s^2": {"kind": "drift", "size": 0.01},
    "stuck": {"kind": "stuck"},
    "noise x3": {"kind": "noise", "size": 3.0},
    "noise x10": {"kind": "noise", "size": 10.0},
    "dropout": {"kind": "dropout"},
    "gain 5 %": {"kind": "scale", "size": 0.05},
}
"""Noise is in standard deviations of the channel's own in flight, and comes on top of it."""
WITHIN = (1.0, 2.0, 4.0, 10.0)
"""Times to the name, s; the last is how long a fault is watched."""
STARTS = (0.25, 0.5, 0.75)
MATTERS = 4.0
"""What a set, or silence, is judged by, s."""


@dataclass(frozen=True)
class Recorded:
    """A flight, or a part of one."""

    name: str
    vehicle: str
    block: Block
    base: Config
    excepted: Mask
    """(n,) channels that are not known to be sound."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return float(seconds_of(self.block.stamp)[-1])


def base_config(vehicle: str) -> Config:
    if vehicle == "mimu":
        return Config.from_file(CONFIGS / "three_imus.yaml", {"bias.startup_bias_duration": 0.0})
    return Config.from_parameters({"input": "imus", **BASE[vehicle]})


def recordings(folder: Path, vehicle: str) -> Iterator[Recorded]:
    config = base_config(vehicle)
    names = build_geometry(config).channel_names
    for path in RECORDINGS[vehicle]:
        block = read_block(folder / path, config)
        excepted = np.isin(names, EXCEPTED.get(path, ()))
        if path not in PARTS:
            yield Recorded(path, vehicle, block, config, excepted)
        for start, end in itertools.pairwise(PARTS.get(path, ())):
            row, last = np.searchsorted(seconds_of(block.stamp), (start, end))
            yield Recorded(f"{path} {start:g} s to {end:g} s", vehicle, block[int(row) : int(last)], config, excepted)


def plain_estimate(source: Recorded) -> dict[str, Any]:
    """Biases and noise of the channels, from their residuals over a whole flight."""
    geometry = build_geometry(source.base)
    bias, std = residual_noise(geometry, source.block.z)
    settings: dict[str, Any] = {"noise.noise_std": tuple(std), "bias.fixed": tuple(bias)}
    # Axes as the mounts say them and chips that sample apart: what config/three_imus.yaml allows for.
    return settings | {"noise.scale_std": 0.01, "noise.timing_std": 0.0005, "bias.startup_bias_duration": 0.0}


def residual_noise(geometry: Geometry, z: Array) -> tuple[Array, Array]:
    """Return what channels (N, n) rad/s disagree by on the whole, and standard deviations that explain the rest."""
    residual = z @ geometry.S
    bias = np.median(residual, axis=0)
    variance = nnls(geometry.S**2, ((residual - bias) ** 2).mean(axis=0))[0]
    # A channel that explains nothing of the residuals is no better than a third of the others.
    return bias, np.sqrt(np.maximum(variance, np.median(variance) / 9))


def settings_from(source: Recorded, arguments: argparse.Namespace) -> Config | str:
    """Config that is calibrated on a flight, or why there is none."""
    overrides = overrides_of(arguments)
    files = dict(text.split("=", 1) for text in arguments.calibrated)
    try:
        if source.name in files:
            return Config.from_file(files[source.name], overrides)
        if arguments.noise:
            return source.base.replaced({**plain_estimate(source), **overrides})
        return source.base.replaced({**calibrate(source.block, source.base).settings, **overrides})
    except FdiError as error:
        return str(error)


def declared(output: Output, excepted: Mask) -> tuple[Mask, Mask]:
    """Return (N, n) which channels stand declared by themselves, and which in a set; excepted ones in none.

    A set that holds an excepted channel is no false one.
    """
    alone, among = faulty(output) & ~excepted, in_set(output)
    among[among[:, excepted].any(axis=1)] = False
    return alone, among


def false_events(pipeline: Pipeline, block: Block, excepted: Mask) -> int:
    """Count declarations of a sound flight, by samples that bring one; the monitor is cleared after each."""
    events = 0
    for output in pipeline.steps(block):
        found = [event for event in output.events if event.declares]
        if not found:
            continue
        if any(not excepted[[event.channel, *event.group]].any() for event in found):
            events += 1
            pipeline.reset()
    return events


def judge_sound(table: Table, source: Recorded, target: Recorded, pipeline: Pipeline) -> None:
    output = renewed(pipeline).process(target.block)
    alone, among = declared(output, target.excepted)
    names = np.array(pipeline.channel_names)
    events = false_events(renewed(pipeline), target.block, target.excepted)
    words = [*names[alone.any(axis=0)], *(f"({name})" for name in names[among.any(axis=0) & ~alone.any(axis=0)])]
    excepted = (faulty(output) | in_set(output)).any(axis=0) & target.excepted
    words += [f"[{name}]" for name in names[excepted]]
    table.add(
        {"seconds": target.seconds},
        flight=target.name,
        settings_of=source.name,
        faulty=int(alone.any(axis=0).sum()),
        in_sets=int(among.any(axis=0).sum()),
        events=events,
        an_hour=events / target.seconds * 3600,
        declared=" ".join(words) or "none",
    )


def inject(target: Recorded, pipeline: Pipeline, channel: int, fault: str, onset: float, std: Array) -> Outcome:
    """Replay with one fault, from a share of the flight on; std: (n,) noise of the channels in this flight, rad/s."""
    about = dict(FAULTS[fault])
    name = pipeline.channel_names[channel]
    rng = generator(1, target.name, name, fault, onset)
    if about["kind"] == "noise":
        about["size"] *= float(std[channel])
    elif "size" in about:
        about["size"] *= float(rng.choice([-1.0, 1.0]))
    seconds = seconds_of(target.block.stamp)
    start = onset * seconds[-1]
    part = target.block[: int(np.searchsorted(seconds, start + WITHIN[-1]))]
    struck = fault_from({"channel": name, "start": start, "seed": int(rng.integers(2**31)), **about})
    injected = Injector([struck], pipeline.channel_names)
    alone, among = declared(renewed(pipeline).process(injected.apply(part)), target.excepted)
    return outcome(alone, among, channel, seconds[: len(part)] - start)


class Outcome(NamedTuple):
    """What came of a fault."""

    words: str
    delay: float
    """Until the channel was named, s; inf: it was not."""


def outcome(alone: Mask, among: Mask, channel: int, since: Array) -> Outcome:
    """Say what came of a fault; since: (N,) s from its start."""
    row, soon = int(np.searchsorted(since, 0.0)), (since >= 0) & (since <= MATTERS)
    if (alone | among)[row - 1].any():
        return Outcome("before", np.inf)
    if np.delete(alone[row:], channel, axis=1).any():
        return Outcome("wrong", np.inf)
    delay = float(since[row + alone[row:, channel].argmax()]) if alone[row:, channel].any() else np.inf
    if delay <= MATTERS:
        return Outcome("named", delay)
    return Outcome("in a set" if among[soon, channel].any() else "false set" if among[soon].any() else "silent", delay)


def shares(outcomes: list[Outcome]) -> dict[str, float]:
    """Share of the trials by outcome."""
    delays, words = np.array([o.delay for o in outcomes]), [o.words for o in outcomes]
    named = {f"in_{limit:g}_s": float((delays <= limit).mean()) for limit in WITHIN}
    others = ("in a set", "silent", "false set", "wrong", "before")
    return named | {name.replace(" ", "_"): words.count(name) / len(words) for name in others}


def pairs(flights: list[Recorded], quick: bool) -> Iterator[tuple[Recorded, Recorded]]:
    """Flights whose settings are taken, and flights to be replayed with them; quick: each once."""
    for k, target in enumerate(flights):
        sources = [flight for flight in flights if flight is not target and flight.name != SHAKEN]
        sources = sources[k % len(sources) :][:1] if quick else sources
        yield from ((source, target) for source in sources)


def measured(arguments: argparse.Namespace, table: Table) -> Iterator[tuple[Recorded, Recorded, Pipeline]]:
    """Judge the sound flights; say which flights are to have faults, and with which monitor."""
    for vehicle in RECORDINGS:
        if arguments.only not in vehicle:
            continue
        flights = list(recordings(arguments.folder, vehicle))
        configs = {source.name: settings_from(source, arguments) for source in flights}
        for source, target in pairs(flights, arguments.quick):
            config = configs[source.name]
            if isinstance(config, str):
                empty = dict.fromkeys(("faulty", "in_sets", "events", "an_hour"))
                table.add(flight=target.name, settings_of=source.name, **empty, declared=f"no settings: {config}")
                continue
            pipeline = Pipeline.from_config(config)
            judge_sound(table, source, target, pipeline)
            yield source, target, pipeline


def main() -> None:
    about: dict[str, dict[str, Any]] = {
        "folder": {"nargs": "?", "type": Path, "default": Path("../shared/data"), "help": "of the recordings"},
        "only": {"default": "", "help": "vehicles with this in their name"},
        "noise": {"action": "store_true", "help": "settings by a plain estimate instead of a calibration"},
        "calibrated": {"action": "append", "default": [], "metavar": "RECORDING=FILE", "help": "settings for others"},
    }
    arguments = arguments_of(__doc__, **about)
    counts = dict.fromkeys(("faulty", "in_sets", "events"), ">7d")
    sound = Table(flight="<24", settings_of="<24", **counts, an_hour=">8.1f", declared="<1")
    chosen = list(measured(arguments, sound))
    print()
    columns = dict.fromkeys(shares([Outcome("silent", np.inf)]), ">8.1%")
    table = Table(vehicle="<9", fault="<19", trials=">6d", **columns, took_s=">7.1f")
    for vehicle, fault in itertools.product(RECORDINGS, FAULTS):
        begun, outcomes = time.perf_counter(), {}
        for source, target, pipeline in chosen:
            if target.vehicle != vehicle or target.name == SHAKEN:
                continue
            std = residual_noise(pipeline.geometry, target.block.z)[1]
            channels = np.flatnonzero(~target.excepted).tolist()
            for channel, onset in itertools.product(channels, STARTS[1:2] if arguments.quick else STARTS):
                key = f"{source.name} > {target.name}, {pipeline.channel_names[channel]}, {onset:.0%}"
                outcomes[key] = inject(target, pipeline, channel, fault, onset, std)
        if outcomes:
            found, took = shares(list(outcomes.values())), time.perf_counter() - begun
            kept = {"outcomes": outcomes}
            table.add(kept, vehicle=vehicle, fault=fault, trials=len(outcomes), **found, took_s=took)
    sound.rows += table.rows
    sound.write(arguments)


if __name__ == "__main__":
    main()
