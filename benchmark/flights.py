# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recorded flights through a replay, as they are and with a bias injected into every channel.

Settings: "calibrated": by `fdi calibrate` on another flight of the vehicle (a recording without a sister is cut in
two); "inspected": what `fdi inspect` writes for the recording itself. --trials: starts of the faults in
each flight, evenly spread (1: the middle).

Healthy: faulty, in_sets count channels that are declared, `words` tells which and when (s); solo imu_1.x disagrees with
the others by itself and counts nowhere. late off: largest difference of the estimated delays between units from those
of a cross-correlation, ms; late sigmas: in their stated standard deviations.

Faults are watched for 10 s: named in 1, 4, 10 s; at 4 s else in a set with others, missed, or in a false set without
the channel; wrong: a healthy channel was named while it was watched; before: something stood declared already.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from trials import CONFIGS, Array, Asked, Mask, Row, faulty, is_state, seconds_of

from fdi_ros import Block, Config, FdiError, Pipeline
from fdi_ros.bag.samples import read_block
from fdi_ros.faults.fault import fault_from
from fdi_ros.inspection.starting_config import starting_config_of
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.replay.run import Sink, replay
from fdi_ros.setup.calibrate import calibrate

WITHIN = (
    1.0,
    4.0,
    10.0,
)  # times to the name, s; the last is how long a fault is watched
MATTERS = 4.0  # what a set, or a miss, is judged by, s
OTHERS = ("in a set", "missed", "false set", "wrong", "before")
FIGURES = {
    **dict.fromkeys(("faulty", "in_sets", "trials"), "d"),
    **dict.fromkeys(
        (
            *(f"in_{limit:g}_s" for limit in WITHIN),
            *(name.replace(" ", "_") for name in OTHERS),
        ),
        ".1%",
    ),
    **dict.fromkeys(("late_off", "late_sigmas"), ".2f"),
}
GROUPS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "phantom4, units together": tuple(
        (f"phantom4/{name}", 0.0, np.inf) for name in ("h02", "h04", "h05", "v01")
    ),
    "phantom4, units 20 to 44 ms apart": tuple(
        (f"phantom4/{name}", 0.0, np.inf) for name in ("h20", "h24", "v09")
    ),
    "solo": (("solo", 0.0, 105.0), ("solo", 105.0, 145.0)),
    "mimu": (("mimu_exp1", 0.0, 180.0), ("mimu_exp6", 0.0, np.inf)),
    "mimu, shaken": (("mimu_exp1", 180.0, 210.0),),
}
"""Recordings, or parts of one from and to s, under the folder of the data."""
NO_FAULTS = ("mimu, shaken",)  # until the gyros saturate
EXCEPTED = {"solo": "imu_1.x"}  # channels that are not known to be healthy
BASE: dict[str, dict[str, Any]] = {
    "phantom4": {
        "sample_rate": 120.0,
        "imus.topics": tuple(f"/imu_{k}/data_raw" for k in range(1, 5)),
    },
    "solo": {
        "sample_rate": 50.0,
        "imus.topics": tuple(f"/imu_{k}/data_raw" for k in range(1, 4)),
    },
}
"""Settings that no calibration finds out; mounts are the identity. mimu: config/three_imus.yaml."""
BIASES = (0.03, 0.1, 0.3)  # rad/s
LAG = 0.08  # largest delay that the cross-correlation looks for, s


@dataclass(frozen=True)
class Recorded:
    """A recording, or a part of one."""

    group: str
    path: Path
    start: float
    end: float

    @property
    def vehicle(self) -> str:
        """First word of its group."""
        return self.group.split(",")[0]

    @property
    def name(self) -> str:
        """For labels."""
        return self.path.name + (
            f" {self.start:g}-{self.end:g} s" if np.isfinite(self.end) else ""
        )

    def base(self) -> Config:
        """Return the settings before any calibration."""
        if self.vehicle == "mimu":
            return Config.from_file(
                CONFIGS / "three_imus.yaml", {"bias.startup_bias_duration": 0.0}
            )
        return Config.from_parameters({"input": "imus", **BASE[self.vehicle]})

    def block(self) -> Block:
        """Read it, aligned with the settings before any calibration."""
        return read_block(self.path, self.base(), self.start, self.end)


@dataclass
class Kept(Sink):
    """Keeps what the monitor gave."""

    outputs: list[Output] = field(default_factory=list)
    pipeline: Pipeline | None = None

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Keep one more output."""
        self.outputs.append(output)
        self.pipeline = pipeline


@dataclass(frozen=True)
class Replayed:
    """States of a replay."""

    seconds: Array  # (N,) s from the first sample
    alone: Mask  # (N, n) channels that stand declared by themselves, or are lost; those that are excepted do not
    named: Mask  # (N, n) of them, those that are FAULTY: a hole in the recording loses channels, and names none
    among: Mask  # (N, n) channels that stand declared in a set; a set with an excepted channel is none
    pipeline: Pipeline


def replayed(
    recorded: Recorded,
    config: Config,
    faults: tuple[Any, ...] = (),
    end: float = np.inf,
) -> Replayed:
    """Replay a recording, or its beginning."""
    kept = Kept()
    replay(
        recorded.path,
        config,
        faults,
        recorded.start,
        min(end, recorded.end),
        sinks=[kept],
    )
    assert kept.pipeline is not None
    stamp = np.concatenate([output.stamp for output in kept.outputs])
    alone = np.concatenate([faulty(output) for output in kept.outputs])
    named = np.concatenate(
        [is_state(output, ChannelState.FAULTY) for output in kept.outputs]
    )
    among = np.concatenate(
        [is_state(output, ChannelState.AMBIGUOUS) for output in kept.outputs]
    )
    excepted = np.array(
        [name == EXCEPTED.get(recorded.vehicle) for name in kept.pipeline.channel_names]
    )
    among[among[:, excepted].any(axis=1)] = False
    return Replayed(
        seconds_of(stamp), alone & ~excepted, named & ~excepted, among, kept.pipeline
    )


@functools.cache
def inspected(recorded: Recorded) -> Config:
    """Return what `fdi inspect` writes, with the mounts that are known."""
    found = starting_config_of(
        recorded.path, f"{recorded.path}: no settings for it"
    ).parameters
    return Config.from_parameters({**found, "imus.mounts": recorded.base().imus.mounts})


@functools.cache
def calibrated(recorded: Recorded) -> Config:
    """Return what `fdi calibrate` gives."""
    return recorded.base().replaced(
        calibrate(recorded.block(), recorded.base()).settings
    )


def cross_correlated(recorded: Recorded, geometry: Any) -> Array:
    """By how much the stamps of each unit are late against those of the first, (units,) s."""
    block = recorded.block()
    t = seconds_of(block.stamp)
    rate = 1 / float(np.median(np.diff(t)))
    smooth = sosfiltfilt(
        butter(4, 8.0, fs=rate, output="sos"),
        np.where(np.isfinite(block.z), block.z, 0.0),
        axis=0,
    )
    body = [
        smooth[:, k : k + 3] @ geometry.axes[k : k + 3] for k in range(0, geometry.n, 3)
    ]
    inside = (t > LAG) & (t < t[-1] - LAG)
    lags = np.arange(-LAG, LAG, 1e-3)
    first, late = CubicSpline(t, body[0]), [0.0]
    for unit in body[1:]:
        own = unit[inside] - unit[inside].mean(axis=0)
        score = [
            float(
                (own * (w := first(t[inside] - lag))).sum()
                / np.linalg.norm(w - w.mean(axis=0))
            )
            for lag in lags
        ]
        k = int(np.clip(np.argmax(score), 1, len(lags) - 2))
        a, b, c = score[k - 1 : k + 2]
        late.append(lags[k] + 1e-3 * 0.5 * (a - c) / (a - 2 * b + c))
    return np.array(late)


def delays_of(flown: Replayed, true: Array) -> dict[str, Any]:
    """Return how the estimated delays differ from those of the cross-correlation, where any are estimated."""
    status = flown.pipeline.status()
    delays, std = np.array(status.delays), np.array(status.delay_std)
    if len(delays) != len(true):
        return {}
    off = np.abs(delays + (status.config.imus.delays or 0.0) - true)[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "late_off": 1e3 * float(off.max()),
            "late_sigmas": float((off / std[1:]).max()),
        }


def healthy(recorded: Recorded, config: Config) -> dict[str, Any]:
    """Replay as it is; say what is declared."""
    flown = replayed(recorded, config)
    names, words = flown.pipeline.channel_names, []
    alone, among = flown.named.any(axis=0), flown.among.any(axis=0)
    for i in np.flatnonzero(alone | among):
        rows = flown.named[:, i] if alone[i] else flown.among[:, i]
        words.append(
            ("{}@{:.1f}" if alone[i] else "({}@{:.1f})").format(
                names[i], flown.seconds[rows.argmax()]
            )
        )
    true = cross_correlated(recorded, flown.pipeline.geometry)
    said = " ".join(f"{1e3 * late:.1f}" for late in true[1:])
    counts = {"faulty": int(alone.sum()), "in_sets": int((among & ~alone).sum())}
    return {
        **counts,
        **delays_of(flown, true),
        "words": f"late {said} ms; {' '.join(words)}",
    }


def struck(
    recorded: Recorded, config: Config, channel: str, size: float, at: float
) -> list[Any]:
    """Replay with a bias, rad/s, from a time on, s; return what came of it, and the time to the name, s."""
    struck = fault_from(
        {"channel": channel, "start": recorded.start + at, "kind": "bias", "size": size}
    )
    flown = replayed(recorded, config, (struck,), recorded.start + at + WITHIN[-1])
    i = list(flown.pipeline.channel_names).index(channel)
    row, since = int(np.searchsorted(flown.seconds, at)), flown.seconds - at
    if (flown.alone | flown.among)[row - 1].any():
        return ["before", np.inf]
    if np.delete(flown.alone[row:], i, axis=1).any():
        return ["wrong", np.inf]
    delay = (
        float(since[row + flown.alone[row:, i].argmax()])
        if flown.alone[row:, i].any()
        else np.inf
    )
    if delay <= MATTERS:
        return ["named", delay]
    soon = flown.among[(since >= 0) & (since <= MATTERS)]
    return [
        "in a set" if soon[:, i].any() else "false set" if soon.any() else "missed",
        delay,
    ]


def shares(outcomes: list[list[Any]]) -> dict[str, Any]:
    """Shares of the trials."""
    words, delays = [o[0] for o in outcomes], np.array([o[1] for o in outcomes])
    named = {f"in_{limit:g}_s": float((delays <= limit).mean()) for limit in WITHIN}
    others = {name.replace(" ", "_"): words.count(name) / len(words) for name in OTHERS}
    return {"trials": len(words), **named, **others}


def measure(asked: Asked) -> Iterator[Row]:
    """Healthy flights one by one, then faults by vehicle."""
    groups = {
        g: [Recorded(g, asked.data / p, a, b) for p, a, b in parts]
        for g, parts in GROUPS.items()
    }
    for way in ("calibrated", "inspected"):
        for group, flights in groups.items():
            if not asked.wants(f"{way}, {group}"):
                continue
            sisters = [
                s
                for s in itertools.chain(*groups.values())
                if s.vehicle == flights[0].vehicle
            ]
            sisters = [
                s
                for s in sisters
                if s.group not in NO_FAULTS and "apart" not in s.group
            ]
            ready = []
            for k, target in enumerate(flights):
                sources = (
                    [s for s in sisters if s is not target]
                    if way == "calibrated"
                    else [target]
                )
                for n, source in enumerate(sources):
                    label = f"{way}, {target.name}" + (
                        f" < {source.name}" if source is not target else ""
                    )
                    try:
                        config = (calibrated if way == "calibrated" else inspected)(
                            source
                        ).replaced(asked.settings)
                    except FdiError as error:
                        yield label, {"words": f"no settings: {str(error)[:60]}"}
                        continue
                    yield label, healthy(target, config)
                    if n == k % len(sources):
                        ready.append((target, config))
            for size in BIASES if group not in NO_FAULTS and ready else ():
                yield f"{way}, {group}, {size:g} rad/s", injected(asked, ready, size)


def injected(
    asked: Asked, ready: list[tuple[Recorded, Config]], size: float
) -> dict[str, Any]:
    """Inject a bias of either sign, rad/s, into every channel of some flights, at several times."""
    outcomes, count = [], asked.count(1)
    for target, config in ready:
        length = float(seconds_of(target.block().stamp)[-1])
        for name in Pipeline.from_config(config).channel_names:
            for k in range(count if name != EXCEPTED.get(target.vehicle) else 0):
                sign = float(
                    asked.rng("flight", target.name, name, k).choice([-1.0, 1.0])
                )
                outcomes.append(
                    struck(
                        target,
                        config,
                        name,
                        sign * size,
                        (k + 1) / (count + 1) * length,
                    )
                )
    return shares(outcomes)
