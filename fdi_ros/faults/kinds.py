# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Kinds of faults: one class per kind, with its options and its effect on channels.

The name of a class registers the kind in `FAULT_KINDS`. The first line of its docstring
is the description for users. Options are fields declared with `setting` and checked
against bounds. A kind implements `Memoryless.faulty` or, if earlier samples or chance
matter, `FaultKind.strike`. A random kind draws one number per active sample and
channel, so the cut of a stream into blocks does not change the draws.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fdi_ros.config.settings import REQUIRED, Field, check, fields_of, setting
from fdi_ros.errors import FaultError
from fdi_ros.model.samples import Array, Mask


class ChannelSamples(NamedTuple):
    """N samples of the c struck channels; a kind changes z and received in place."""

    #: (N,) since the first sample of the stream, s
    time: Array
    #: (N,) since the start of the fault, s
    since: Array
    #: (N,) whether the fault is active
    active: Mask
    #: (N, c) rad/s
    z: Array
    #: (N, c)
    received: Mask


#: values that a kind keeps between blocks; empty at the start of a stream
Memory = dict[str, Any]


def check_fields(owner: Any, called: str) -> None:
    """Check the `setting` fields of a frozen dataclass and convert them (`FaultError`)."""
    for name, field in fields_of(owner).items():
        value = getattr(owner, name)
        if value is REQUIRED:
            raise FaultError(
                f"{called} needs {name}" + (f" in {field.unit}" if field.unit else "")
            )
        if value is not None or field.default is not None:
            object.__setattr__(
                owner, name, check(field, value, f"{called}: {name}", FaultError)
            )


#: every kind of fault by name
FAULT_KINDS: dict[str, type[FaultKind]] = {}


class FaultKind(ABC):
    """One kind of fault with its options. `FaultError` if one is missing or out of range."""

    name: ClassVar[str]
    study_size: ClassVar[float | None] = None
    """Default size in simulated flights: well above the noise, too small to be obvious."""
    #: whether the fault always strikes all three channels of a unit
    whole_unit: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        if "name" in vars(cls):
            FAULT_KINDS[cls.name] = cls

    def __post_init__(self) -> None:
        check_fields(self, f"fault {self.name}")
        if getattr(self, "size", None) == 0 and self.has_signed_size():
            raise FaultError(
                f"fault {self.name}: size is 0{self.options()['size'].unit_suffix}, which changes nothing"
            )

    @classmethod
    def options(cls) -> dict[str, Field]:
        """Options of the kind, by name."""
        return fields_of(cls)

    @classmethod
    def has_signed_size(cls) -> bool:
        """Whether the kind has a required size of either sign, where 0 changes nothing."""
        size = cls.options().get("size")
        return size is not None and size.default is REQUIRED and size.low < 0

    @abstractmethod
    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Change the next samples in place, with a generator that only this fault uses."""


class Memoryless(FaultKind):
    """A kind that depends only on the time since its start and on the true values."""

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Replace the active samples."""
        active = samples.active
        samples.z[active] = self.faulty(samples.since[active, None], samples.z[active])

    @abstractmethod
    def faulty(self, since: Array, z: Array) -> Array:
        """Return faulty values (k, c), rad/s.

        ``since``: time since the start (k, 1), s. ``z``: true values (k, c), rad/s.
        """


@dataclass(frozen=True)
class Bias(Memoryless):
    """Adds size."""

    name = "bias"
    study_size = 0.05
    size: float = setting(REQUIRED, "what is added", "rad/s", -100.0, 100.0)

    def faulty(self, since: Array, z: Array) -> Array:
        """Add the size."""
        return z + self.size


@dataclass(frozen=True)
class Drift(Memoryless):
    """Adds size times the time since start."""

    name = "drift"
    study_size = 0.02
    size: float = setting(REQUIRED, "slope of what is added", "rad/s^2", -10.0, 10.0)

    def faulty(self, since: Array, z: Array) -> Array:
        """Add a ramp that grows since the start."""
        return z + self.size * since


@dataclass(frozen=True)
class Scale(Memoryless):
    """Multiplies by 1 + size."""

    name = "scale"
    study_size = 0.2
    size: float = setting(REQUIRED, "error of the scale factor", "", -10.0, 10.0)

    def faulty(self, since: Array, z: Array) -> Array:
        """Multiply."""
        return z * (1 + self.size)


@dataclass(frozen=True)
class Stuck(FaultKind):
    """Repeats size, or without size the last value."""

    name = "stuck"
    size: float | None = setting(
        None,
        "value that is repeated; without it the last finite one",
        "rad/s",
        -100.0,
        100.0,
    )

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Hold the given value, or the last finite one before the start."""
        active = samples.active
        z = samples.z
        first = int(np.argmax(active)) if active.any() else len(active)
        last = memory.setdefault("last", z[0].copy())
        for column, values in enumerate(z[:first].T):
            finite = np.flatnonzero(np.isfinite(values))
            if len(finite):
                last[column] = values[finite[-1]]
        z[active] = last if self.size is None else self.size


@dataclass(frozen=True)
class Dropout(FaultKind):
    """Gives NaN, or no value at all with missing=1."""

    name = "dropout"
    missing: int = setting(0, "1: gives nothing", "", 0, 1)

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Take the values out, and with them that anything was received."""
        samples.z[samples.active] = np.nan
        if self.missing:
            samples.received[samples.active] = False


@dataclass(frozen=True)
class Intermittent(Memoryless):
    """Adds size for the share duty of every period."""

    name = "intermittent"
    study_size = 0.1
    size: float = setting(REQUIRED, "what is added", "rad/s", -100.0, 100.0)
    period: float = setting(1.0, "from one beginning to the next", "s", 1e-3, 3600.0)
    duty: float = setting(
        0.5, "share of the period with the fault, from its beginning", "", 1e-3, 0.999
    )

    def faulty(self, since: Array, z: Array) -> Array:
        """Add the size in the first part of every period."""
        phase = np.mod(since, self.period) / self.period
        return z + np.where(phase < self.duty, self.size, 0.0)


@dataclass(frozen=True)
class Noise(FaultKind):
    """Adds white noise of standard deviation size."""

    name = "noise"
    study_size = 0.05
    size: float = setting(REQUIRED, "standard deviation", "rad/s", 1e-9, 100.0)

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Add a normal number to every sample."""
        count = int(samples.active.sum())
        drawn = random.standard_normal((count, samples.z.shape[1]))
        samples.z[samples.active] += self.size * drawn


@dataclass(frozen=True)
class Spike(FaultKind):
    """Adds size with either sign to single samples, rate times per second on average."""

    name = "spike"
    study_size = 0.5
    size: float = setting(REQUIRED, "height of a spike", "rad/s", 1e-9, 100.0)
    rate: float = setting(1.0, "mean number of spikes per second", "1/s", 1e-3, 1e4)

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Strike a sample with probability 1 - exp(-rate dt) for an interval dt."""
        time = samples.time
        active = samples.active
        before = memory.get("last", time[0])
        probability = -np.expm1(-self.rate * np.diff(time, prepend=before)[active])[
            :, None
        ]
        drawn = random.random((int(active.sum()), samples.z.shape[1]))
        # One draw decides both: below half the probability a spike down, below the whole a spike up.
        spike = np.where(drawn < probability / 2, -self.size, self.size)
        samples.z[active] += np.where(drawn < probability, spike, 0.0)
        memory["last"] = float(time[-1])


@dataclass(frozen=True)
class Saturation(Memoryless):
    """Clips at +-size."""

    name = "saturation"
    study_size = 0.3
    size: float = setting(REQUIRED, "largest value", "rad/s", 1e-9, 100.0)

    def faulty(self, since: Array, z: Array) -> Array:
        """Clip."""
        return np.clip(z, -self.size, self.size)


@dataclass(frozen=True)
class Sign(Memoryless):
    """Reverses the sign."""

    name = "sign"

    def faulty(self, since: Array, z: Array) -> Array:
        """Reverse the sign."""
        return -z


@dataclass(frozen=True)
class Delay(FaultKind):
    """Repeats the value measured size samples ago."""

    name = "delay"
    study_size = 10.0
    size: int = setting(
        REQUIRED, "by how much the values are late", "samples", 1, 100_000
    )

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Return delayed samples; before enough are known, repeat the first one."""
        active = samples.active
        for name, now in (("z", samples.z), ("received", samples.received)):
            past = memory.get(name, np.repeat(now[:1], self.size, axis=0))
            known = np.concatenate([past, now])
            now[active] = known[: len(now)][active]
            memory[name] = known[len(now) :]


@dataclass(frozen=True)
class Oscillation(Memoryless):
    """Adds a sine of amplitude size."""

    name = "oscillation"
    study_size = 0.1
    size: float = setting(REQUIRED, "amplitude", "rad/s", 1e-9, 100.0)
    frequency: float = setting(
        1.0, "of the sine, which begins at zero", "Hz", 1e-3, 1e4
    )

    def faulty(self, since: Array, z: Array) -> Array:
        """Add the sine."""
        return z + self.size * np.sin(2 * np.pi * self.frequency * since)


@dataclass(frozen=True)
class TriadLoss(FaultKind):
    """Loses the unit, three channels: they give nothing."""

    name = "triad_loss"
    whole_unit = True

    def strike(
        self, samples: ChannelSamples, memory: Memory, random: np.random.Generator
    ) -> None:
        """Do as a dropout with missing=1."""
        Dropout(missing=1).strike(samples, memory, random)
