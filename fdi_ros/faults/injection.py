"""Injection of faults into a stream: the same to the last bit however the stream is cut into blocks.

The injector is used on whole recordings and, one sample at a time, live. Random kinds draw one number per active
sample from a generator of their own, so that neither the cut nor another fault changes the draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import FaultError
from fdi_ros.faults.kinds import Fault
from fdi_ros.model.block import Block

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def _number(value: float | None) -> float:
    # The validation of Fault has filled in every number that its kind needs.
    return math.nan if value is None else value


def _intermittent(fault: Fault, since: Array, z: Array) -> Array:
    phase = np.mod(since, _number(fault.period)) / _number(fault.period)
    return z + np.where(phase < _number(fault.duty), _number(fault.size), 0.0)[:, None]


def _oscillation(fault: Fault, since: Array, z: Array) -> Array:
    return z + _number(fault.size) * np.sin(2 * np.pi * _number(fault.frequency) * since)[:, None]


_MEMORYLESS: dict[str, Callable[[Fault, Array, Array], Array]] = {
    "bias": lambda fault, since, z: z + _number(fault.size),
    "drift": lambda fault, since, z: z + _number(fault.size) * since[:, None],
    "scale": lambda fault, since, z: z * (1 + _number(fault.size)),
    "saturation": lambda fault, since, z: np.clip(z, -_number(fault.size), _number(fault.size)),
    "sign": lambda fault, since, z: -z,
    "intermittent": _intermittent,
    "oscillation": _oscillation,
}
"""Kinds whose output depends on the time since start (k,) s and the true channels z (k, c) rad/s alone."""


class _Memoryless:
    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self.function = _MEMORYLESS[fault.kind]

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        z[active] = self.function(self.fault, time[active] - self.fault.start, z[active])


class _Dropout:
    def __init__(self, fault: Fault) -> None:
        self.silent = fault.kind == "triad_loss" or fault.missing == 1

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        z[active] = np.nan
        if self.silent:
            received[active] = False


class _Stuck:
    """Holds a given value, or the last finite one before the start."""

    def __init__(self, fault: Fault) -> None:
        self.size = fault.size
        self.last: Array | None = None

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        first = int(np.argmax(active)) if active.any() else len(active)
        if self.last is None:
            self.last = z[0].copy()
        for column, values in enumerate(z[:first].T):
            finite = np.flatnonzero(np.isfinite(values))
            if len(finite):
                self.last[column] = values[finite[-1]]
        z[active] = self.last if self.size is None else self.size


class _Delay:
    """Keeps the last samples; before there are enough of them it repeats the first."""

    def __init__(self, fault: Fault) -> None:
        self.samples = int(_number(fault.size))
        self.past: tuple[Array, Mask] | None = None

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        if self.past is None:
            self.past = np.repeat(z[:1], self.samples, axis=0), np.repeat(received[:1], self.samples, axis=0)
        values = np.concatenate([self.past[0], z])
        arrived = np.concatenate([self.past[1], received])
        z[active] = values[: len(z)][active]
        received[active] = arrived[: len(z)][active]
        self.past = values[len(z) :], arrived[len(z) :]


class _Noise:
    def __init__(self, fault: Fault, random: np.random.Generator) -> None:
        self.size = _number(fault.size)
        self.random = random

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        z[active] += self.size * self.random.standard_normal((int(active.sum()), z.shape[1]))


class _Spike:
    """A spike falls on a sample with the probability 1 - exp(-rate dt), dt the time since the sample before."""

    def __init__(self, fault: Fault, random: np.random.Generator) -> None:
        self.size = _number(fault.size)
        self.rate = _number(fault.rate)
        self.random = random
        self.before: float | None = None

    def __call__(self, time: Array, active: Mask, z: Array, received: Mask) -> None:
        before = time[0] if self.before is None else self.before
        probability = -np.expm1(-self.rate * np.diff(time, prepend=before)[active])[:, None]
        drawn = self.random.random((int(active.sum()), z.shape[1]))
        # One draw decides both: below half the probability a spike down, below the whole a spike up.
        z[active] += np.where(drawn < probability, np.where(drawn < probability / 2, -self.size, self.size), 0.0)
        self.before = float(time[-1])


Effect = Callable[[Array, Mask, Array, Mask], None]
"""Changes z and received (N, c) of the channels struck, in place, where active (N,); time (N,) s."""


def _effect(fault: Fault, position: int) -> Effect:
    if fault.kind in ("noise", "spike"):
        random = np.random.default_rng([fault.seed, position])
        return _Noise(fault, random) if fault.kind == "noise" else _Spike(fault, random)
    others: dict[str, Callable[[Fault], Effect]] = {
        "stuck": _Stuck,
        "delay": _Delay,
        "dropout": _Dropout,
        "triad_loss": _Dropout,
    }
    return others.get(fault.kind, _Memoryless)(fault)


def _named(fault: Fault) -> str:
    return f"fault {fault.kind} on {fault.channel}"


class Injector:
    """Injects faults into a stream of blocks, in the order of the list.

    Parameters
    ----------
    faults
        What to inject; several on one channel act one after the other.
    channel_names
        Names of the n channels of the stream.
    start_stamp
        Stamp that the times of the faults count from, ns; None: that of the first sample.

    Raises
    ------
    FaultError
        If a fault strikes a channel that is not there.
    """

    def __init__(self, faults: Sequence[Fault], channel_names: Sequence[str], start_stamp: int | None = None) -> None:
        self.faults = tuple(faults)
        self.channel_names = tuple(channel_names)
        self.channels = tuple(fault.channels(channel_names) for fault in self.faults)
        self.start_stamp = start_stamp
        self._effects = [_effect(fault, k) for k, fault in enumerate(self.faults)]

    def time(self, stamp: NDArray[np.int64]) -> Array:
        """Seconds since the first sample, (N,), of stamps (N,) ns."""
        if self.start_stamp is None:
            raise FaultError("no sample has been seen yet: the time of a fault has no origin")
        return np.asarray((stamp - self.start_stamp) * 1e-9)

    def active(self, stamp: NDArray[np.int64]) -> Mask:
        """Ground truth: (N, faults) whether each fault is active at stamps (N,) ns."""
        time = self.time(stamp)
        columns = [(time >= fault.start) & (time < fault.stop) for fault in self.faults]
        return np.column_stack(columns) if columns else np.zeros((len(stamp), 0), dtype=bool)

    def struck(self, stamp: NDArray[np.int64]) -> Mask:
        """Ground truth: (N, n) whether each channel carries an active fault at stamps (N,) ns."""
        truth = np.zeros((len(stamp), len(self.channel_names)), dtype=bool)
        for column, struck in zip(self.active(stamp).T, self.channels, strict=True):
            truth[:, struck] |= column[:, None]
        return truth

    def check_start(self, start: float, first: int, learned: float) -> None:
        """Refuse faults that begin before they can be found.

        Parameters
        ----------
        start
            Beginning of the part that is read, s.
        first
            Stamp of its first sample, ns.
        learned
            Time from then on over which biases are learned, s.

        Raises
        ------
        FaultError
            Naming the first time that is allowed.
        """
        least, why = start, "there the part that is read begins"
        if learned > 0:
            least, why = float(self.time(np.array([first]))[0]) + learned, "until then the biases are learned"
        for fault in self.faults:
            if fault.start < least:
                raise FaultError(
                    f"{_named(fault)} starts at {fault.start:g} s, expected at least {least:.12g} s: {why}"
                )

    def check_end(self, last: int) -> None:
        """Refuse faults that begin after the last sample.

        Parameters
        ----------
        last
            Its stamp, ns.

        Raises
        ------
        FaultError
            Naming the last time that is allowed.
        """
        most = float(self.time(np.array([last]))[0])
        for fault in self.faults:
            if fault.start > most:
                raise FaultError(
                    f"{_named(fault)} starts at {fault.start:g} s, expected at most {most:.12g} s, the last sample"
                )

    def apply(self, block: Block) -> Block:
        """Return the next block of the stream with the faults in it; the block given is left as it is."""
        if len(block) == 0 or not self.faults:
            return block
        if self.start_stamp is None:
            self.start_stamp = int(block.stamp[0])
        time = self.time(block.stamp)
        active = self.active(block.stamp)
        z = block.z.copy()
        received = np.ones(z.shape, dtype=bool) if block.received is None else block.received.copy()
        for effect, struck, rows in zip(self._effects, self.channels, active.T, strict=True):
            index = list(struck)
            values, arrived = z[:, index], received[:, index]
            # What is recorded may be infinite, and so may be what is added.
            with np.errstate(invalid="ignore", over="ignore"):
                effect(time, rows, values, arrived)
            z[:, index], received[:, index] = values, arrived
        return Block(block.stamp, z, None if block.received is None and received.all() else received)
