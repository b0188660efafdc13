# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults to inject, and their injection into a stream.

`fault_from` validates the words of the command line and of scenario files. Times are
seconds since the first sample of the stream, so the same sample is struck whatever part
of a recording is replayed. The result does not depend on how the stream is cut into
blocks; a live stream has one sample per block.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.settings import setting
from fdi_ros.errors import FaultError
from fdi_ros.faults.kinds import (
    FAULT_KINDS,
    ChannelSamples,
    FaultKind,
    Memory,
    check_fields,
)
from fdi_ros.model.quantity import FORCE, RATE
from fdi_ros.model.samples import Array, Block, Mask
from fdi_ros.system.text import did_you_mean
from fdi_ros.system.yaml_file import read_yaml

ACCELEROMETERS = ".accel"  # stands behind the unit in names of its accelerometers
ACCELEROMETER = f"{ACCELEROMETERS}_"  # then the axis


@dataclass(frozen=True)
class Fault:
    """One fault. `FaultError` if a value is out of range."""

    #: channel (``imu_2.y``, ``imu_2.accel_y``), gyros or accelerometers of a unit
    #: (``imu_2``, ``imu_2.accel``), or several with commas
    channel: str
    #: kind of the fault with its options
    kind: FaultKind
    start: float = setting(0.0, "from here on, since the first sample", "s", 0.0, 1e12)
    stop: float = setting(math.inf, "and before this", "s", 0.0)
    seed: int = setting(0, "of the random kinds", "", 0)

    def __post_init__(self) -> None:
        check_fields(self, f"fault {self.kind.name}")
        if not self.stop > self.start:
            expected = f"expected more than start {self.start:g} s"
            raise FaultError(
                f"fault {self.kind.name}: stop is {self.stop:g} s, {expected}"
            )

    @property
    def size(self) -> float | None:
        """Size of the fault in the unit of its kind, None if the kind has no size."""
        size = getattr(self.kind, "size", None)
        return None if size is None else float(size)

    def channels(self, channel_names: Sequence[str]) -> tuple[int, ...]:
        """Return the indices of the channels that the fault strikes.

        `FaultError` if a channel or unit does not exist.
        """
        struck: list[int] = []
        for name in self.channel.split(","):
            found = [
                i
                for i, known in enumerate(channel_names)
                if self._is_meant(name, known)
            ]
            if not found:
                raise FaultError(
                    f"fault on unknown channel {name!r}, {did_you_mean(name, channel_names)}"
                )
            struck += [i for i in found if i not in struck]
        gyros = [i for i in struck if ACCELEROMETER not in channel_names[i]]
        if self.kind.whole_unit and len(gyros) != 3:
            raise FaultError(
                f"fault {self.kind.name} on {self.channel!r} strikes {len(gyros)} channels, expected 3"
            )
        return tuple(struck)

    def _is_meant(self, name: str, known: str) -> bool:
        """Whether a name means a channel: a unit stands for its gyros, and for all of it where the unit is lost."""
        if name == known or known.startswith(
            f"{name.removesuffix(ACCELEROMETERS)}{ACCELEROMETER}"
        ):
            is_unit = name != known and not name.endswith(ACCELEROMETERS)
            return not is_unit or self.kind.whole_unit
        return known.startswith(f"{name}.")

    def __str__(self) -> str:
        words = [
            f"channel={self.channel}",
            f"kind={self.kind.name}",
            f"start={self.start:.12g}",
        ]
        words += [] if self.stop == math.inf else [f"stop={self.stop:.12g}"]
        words += [f"seed={self.seed}"] if self.seed else []
        options = {name: getattr(self.kind, name) for name in self.kind.options()}
        return " ".join(
            words
            + [
                f"{name}={value:.12g}"
                for name, value in options.items()
                if value is not None
            ]
        )


#: options of every fault, besides those of its kind
_KEYS = (
    "channel",
    "kind",
    "start",
    "stop",
    "seed",
)


def create_kind(name: str, /, **options: float | str | None) -> FaultKind:
    """Build a kind of fault from its name in `FAULT_KINDS` and its options.

    None means that an option is not given. `FaultError` if the kind is unknown, or an
    option is missing, unknown or out of range.
    """
    if name not in FAULT_KINDS:
        raise FaultError(
            f"unknown fault kind {name!r}, {did_you_mean(name, tuple(FAULT_KINDS))}"
        )
    kind = FAULT_KINDS[name]
    given = {option: value for option, value in options.items() if value is not None}
    taken = kind.options()
    for option in given:
        if option not in taken:
            hint = did_you_mean(option, (*_KEYS, *taken))
            raise FaultError(f"fault {name} takes no {option!r}, {hint}")
    return kind(
        **{option: given.get(option, field.default) for option, field in taken.items()}
    )


def fault_from(items: Mapping[str, Any]) -> Fault:
    """Build a fault from names and values of a scenario file or the command line.

    `FaultError` if a name is unknown or a value does not fit.
    """
    for name in ("channel", "kind"):
        if not isinstance(items.get(name), str) or not items[name]:
            words = " ".join(f"{key}={value}" for key, value in items.items())
            others = [str(key) for key in items if key not in _KEYS]
            close = difflib.get_close_matches(name, others, n=1)
            hint = f"; did you mean {name!r} instead of {close[0]!r}?" if close else ""
            raise FaultError(f"fault needs {name}=..., got: {words}{hint}")
    when = {name: items[name] for name in _KEYS[2:] if name in items}
    # A key of a YAML file may be anything.
    own = {name: value for name, value in items.items() if name not in _KEYS}
    options = {str(name): value for name, value in own.items()}
    try:
        kind = create_kind(items["kind"], **options)
    except FaultError as error:
        if ACCELEROMETERS not in items["channel"]:
            raise
        # Sizes have the same bounds in the unit of accelerometers.
        raise FaultError(str(error).replace(RATE.unit, FORCE.unit)) from error
    return Fault(items["channel"], kind, **when)


def parse_fault(text: str) -> Fault:
    """Parse a fault such as ``channel=imu_2.y kind=bias size=0.2 start=30 stop=60``."""
    return fault_from(key_values(text))


def key_values(text: str) -> dict[str, str]:
    """Parse words ``key=value``. `FaultError` if a word has another form or a key repeats."""
    items: dict[str, str] = {}
    for word in text.split():
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise FaultError(f"fault {text!r}: {word!r} is not of the form key=value")
        if name in items:
            raise FaultError(f"fault {text!r}: {name} is given twice")
        if "," in value and "=" in value:
            parts = " ".join(text.replace(",", " ").split())
            raise FaultError(f"fault {text!r}: expected blanks between, {parts!r}")
        items[name] = value
    return items


def load_scenario(path: str | Path) -> tuple[Fault, ...]:
    """Read the faults of a scenario file: a mapping with a list ``faults``.

    `FaultError` if the file is missing or is not a scenario, or a fault is wrong.
    """
    document = read_yaml(path, "scenario", FaultError)
    entries = document.get("faults") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise FaultError(f"scenario {path} has no list 'faults'")
    faults = []
    for number, entry in enumerate(entries, 1):
        if not isinstance(entry, dict):
            raise FaultError(
                f"scenario {path}, fault {number}: expected keys and values, got {entry!r}"
            )
        try:
            faults.append(fault_from(entry))
        except FaultError as error:
            raise FaultError(f"scenario {path}, fault {number}: {error}") from error
    return tuple(faults)


class Injector:
    """Injects faults into a stream of blocks, one after the other in the order of the list.

    ``channel_names``: names of the channels of the stream, gyros first. ``start_stamp``: origin of
    the times of the faults, ns; None means the first sample. `FaultError` if a fault is
    on a channel outside the stream.
    """

    def __init__(
        self,
        faults: Sequence[Fault],
        channel_names: Sequence[str],
        start_stamp: int | None = None,
    ) -> None:
        self.faults = tuple(faults)
        self.channel_names = tuple(channel_names)
        self.channels = tuple(fault.channels(channel_names) for fault in self.faults)
        self.start_stamp = start_stamp
        self._memories: list[Memory] = [{} for _ in self.faults]
        self._random = [
            np.random.default_rng([fault.seed, k])
            for k, fault in enumerate(self.faults)
        ]

    def time(self, stamp: NDArray[np.int64]) -> Array:
        """Seconds since the first sample, of stamps, ns."""
        if self.start_stamp is None:
            raise FaultError(
                "no sample has been seen yet: the time of a fault has no origin"
            )
        return np.asarray((stamp - self.start_stamp) * 1e-9)

    def active(self, stamp: NDArray[np.int64]) -> Mask:
        """Ground truth: (N, faults) whether each fault is active at stamps (N,) ns."""
        time = self.time(stamp)
        columns = [(time >= fault.start) & (time < fault.stop) for fault in self.faults]
        return (
            np.column_stack(columns)
            if columns
            else np.zeros((len(stamp), 0), dtype=bool)
        )

    def struck(self, stamp: NDArray[np.int64]) -> Mask:
        """Return the ground truth (N, n): channels with an active fault at stamps (N,), ns."""
        truth = np.zeros((len(stamp), len(self.channel_names)), dtype=bool)
        for column, struck in zip(self.active(stamp).T, self.channels, strict=True):
            truth[:, struck] |= column[:, None]
        return truth

    def refuse_between(self, low: float, high: float, why: str) -> None:
        """Refuse faults that begin between two times, s (`FaultError`)."""
        allowed = [f"at most {low:.6g} s"] if low >= 0 else []
        allowed += [f"at least {high:.6g} s"] if high < math.inf else []
        for fault in self.faults:
            if low < fault.start < high:
                raise FaultError(
                    f"fault {fault.kind.name} on {fault.channel} starts at {fault.start:g} s,"
                    f" expected {' or '.join(allowed)}: {why}"
                )

    def apply(self, block: Block) -> Block:
        """Return a copy of the next block with the faults applied."""
        if len(block) == 0 or not self.faults:
            return block
        if self.start_stamp is None:
            self.start_stamp = int(block.stamp[0])
        time = self.time(block.stamp)
        active = self.active(block.stamp)
        z = np.hstack([half.z for half in block.halves])
        received = np.hstack([half.delivered for half in block.halves])
        for k, fault in enumerate(self.faults):
            index = list(self.channels[k])
            since = time - fault.start
            struck = ChannelSamples(
                time, since, active[:, k], z[:, index], received[:, index]
            )
            # Both the recorded value and the added one may be infinite.
            with np.errstate(invalid="ignore", over="ignore"):
                fault.kind.strike(struck, self._memories[k], self._random[k])
            z[:, index] = struck.z
            received[:, index] = struck.received
        n = block.z.shape[1]
        all_came = block.received is None and received[:, :n].all()
        came = None if all_came else received[:, :n]
        faulty = Block(block.stamp, z[:, :n], came)
        if block.acceleration is None:
            return faulty
        return replace(
            faulty, acceleration=Block(block.stamp, z[:, n:], received[:, n:])
        )
