# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Interface of detectors: samples in, verdicts out, without votes or logs.

A method is a class that prepares constants once from geometry and noise, and a compiled
function that judges one sample with them. The module of the method contains

- ``Constants``: a record with first field ``sensors: Sensors``, filled by the class;
- ``State``: a record of the memory between samples, initially zero;
- ``judge(constants, state, sample, verdict)``: compiled, called by address.
"""

from __future__ import annotations

import inspect
from abc import ABC
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    Callback,
    Whole,
    address_of,
    allocate,
    as_input,
    compiled,
    record,
)
from fdi_ros.core.judging import REFUSED, UNPREPARED, judge_sample, present_in
from fdi_ros.core.records import Bank, SampleInput, SampleVerdict
from fdi_ros.core.sensors import describe_sensors
from fdi_ros.core.subsets import flags_of, whole_set
from fdi_ros.errors import DetectorError, FdiError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask

MOST_ROWS = 512  #: Largest number of sets of channels with stored constants.


class Verdict(NamedTuple):
    """Verdicts of a detector on N samples of n channels.

    A sample that could not be judged (too few channels for the method) has NaN as
    statistic and threshold, and no alarm. Such a sample is not healthy, but unknown.
    """

    statistic: Array  #: Figure compared with the threshold, (N,).
    threshold: Array  #: Statistic from which on the method alarms, (N,).
    alarm: Mask  #: At least one channel is faulty, (N,).
    suspects: Mask  #: Channels that may be faulty, (N, n). None without an alarm.
    isolated: Mask
    """Every suspect is faulty, (N,). With an alarm that is not isolated, at least one
    suspect is faulty, and the evidence does not show which."""
    error: Array  #: Estimated error of each suspect, rad/s, otherwise 0, (N, n).
    scores: Array
    """The method's figure per channel, as tabulated in its paper, (N, n). NaN for a
    channel that was not judged."""


@record
class NoState:
    """Memory of a method without memory."""

    unused: Whole


class Detector(ABC):
    """Base of all detectors. Samples with absent channels are judged by those present.

    A channel whose value is NaN or infinite is absent from that sample. For each set of
    present channels, the constants of the method are prepared once, and a separate
    memory is kept.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel.
    options
        Options of the method, also for its detectors on fewer channels.
    """

    name: ClassVar[str]
    Constants: type
    State: type = NoState
    judge: Callback
    takes_any: ClassVar[bool] = False
    """One row of constants and one memory serve all sets of channels. Otherwise each
    set has its own."""
    sample_rate = 100.0  #: Rate of samples without stamps, Hz.

    def __init__(
        self, geometry: Geometry, noise: NoiseModel, options: dict[str, Any]
    ) -> None:
        if refused := self.refuses(geometry.n):
            raise DetectorError(refused)
        self.geometry = geometry
        self.noise = noise.for_channels(geometry.n)
        self.options = options
        self.constants = allocate(
            self.Constants
        )  #: the method's constants for all channels, (1,)
        describe_sensors(self.constants["sensors"][0], geometry, self.noise)
        self._fewer: dict[int, Detector | None] = {}
        self.refusals: dict[
            int, str
        ] = {}  #: why the method cannot run on a set of channels, by its bits

    @classmethod
    def refuses(cls, n: int) -> str:
        """Return why the method cannot run on n channels that span space, or ""."""
        return ""

    @property
    def isolable(self) -> Mask:
        """Channels whose single fault this method isolates, (n,)."""
        return self.geometry.isolable

    def reset(self) -> None:
        """Clear the memory of all samples."""
        self.states[:] = 0

    def clear(self, declared: int = 0) -> None:
        """Clear all suspicions. Estimates of channels that were not declared are kept."""
        self.reset()

    @cached_property
    def _rows(self) -> _Rows:
        return _Rows(self)

    @property
    def bank(self) -> NDArray[Any]:
        """Addresses of constants and memory for each set of channels, (1,)."""
        return self._rows.bank

    @property
    def states(self) -> NDArray[Any]:
        """Memory of the method, one row for each prepared set. Row 0 is for all channels."""
        return self._rows.states

    @property
    def memory(self) -> NDArray[np.uint8]:
        """The bytes of `states`. Zeros clear the memory."""
        return self.states.view(np.ndarray).view(np.uint8)

    def prepare(self, mask: int) -> None:
        """Prepare the constants for a set of channels, if not yet prepared."""
        if not self.takes_any and self.bank["row"][0, mask] == UNPREPARED:
            self._rows.add(mask, self.fewer(mask))

    def fewer(self, mask: int) -> Detector | None:
        """Return the same method on a set of channels, or None if it cannot run on them."""
        n = self.geometry.n
        if mask == whole_set(n):
            return self
        if mask not in self._fewer:
            kept = flags_of(mask, n)
            try:
                self._fewer[mask] = type(self)(
                    self.geometry.subset(kept), self.noise.subset(kept), **self.options
                )
            except (FdiError, ValueError, np.linalg.LinAlgError) as error:
                # With nearly parallel axes some methods cannot be built.
                self._fewer[mask] = None
                self.refusals[mask] = str(error)
            if len(self._fewer) > MOST_ROWS:
                # Random absences must not fill the memory. The oldest set is built
                # again when needed.
                self._fewer.pop(next(iter(self._fewer)))
        return self._fewer[mask]

    def detect(self, z: Array, acceleration: Array | None = None) -> Verdict:
        """Judge a block of samples.

        Parameters
        ----------
        z
            Measured channels, (N, n), rad/s. NaN or infinite: absent from that sample.
            Finite values are limited to `LARGEST_RATE`.
        acceleration
            Body angular acceleration, (N, 3), rad/s^2, for noise models with a timing
            term. None: zero.

        Returns
        -------
        Verdict
            Verdict on each sample. Verdicts do not depend on the division of a stream
            into blocks.

        Raises
        ------
        DetectorError
            If z does not have n columns.
        """
        z = self._checked(z)
        rows = len(z)
        turning = (
            np.zeros((1, 3))
            if acceleration is None
            else as_input(acceleration, np.float64)
        )
        if acceleration is not None and turning.shape != (rows, 3):
            raise DetectorError(
                f"acceleration has shape {turning.shape}, expected ({rows}, 3)"
            )
        verdicts = allocate(SampleVerdict, rows)
        sample = allocate(SampleInput)
        sample["bias_std"][0, : self.geometry.n] = self.noise.bias_std
        done = 0
        while (
            done := judge_rows(self.bank, z, turning, sample, verdicts, done)
        ) < rows:
            self.prepare(present_in(z[done], self.geometry.n))
        return as_verdict(verdicts, self.geometry.n)

    def _checked(self, z: Array) -> Array:
        z = as_input(z, np.float64)
        if z.ndim != 2 or z.shape[1] != self.geometry.n:
            raise DetectorError(
                f"z has shape {z.shape}, expected (N, {self.geometry.n})"
            )
        return z


class _Rows:
    """Constants and memory of a detector and of its variants on fewer channels.

    Compiled code has their addresses, so the arrays never move. The operating system
    provides memory for rows only when they are used.
    """

    def __init__(self, detector: Detector) -> None:
        n = detector.geometry.n
        room = 1 if detector.takes_any else min(MOST_ROWS, 1 << n)
        self.constants = allocate(detector.Constants, room)
        self.states = allocate(detector.State, room)
        self.bank = allocate(Bank)
        self._masks = [whole_set(n)]
        self._oldest = 1
        bank = self.bank[0]
        bank["n"] = n
        bank["judge"] = detector.judge.address
        bank["rows"] = 1
        bank["constants"], bank["states"] = (
            address_of(self.constants),
            address_of(self.states),
        )
        bank["constants_size"] = self.constants.itemsize
        bank["states_size"] = self.states.itemsize
        bank["takes_any"] = detector.takes_any
        bank["period"] = round(1e9 / detector.sample_rate)
        bank["row"] = UNPREPARED
        bank["row"][self._masks[0]] = 0
        self.constants[0] = detector.constants[0]

    def add(self, mask: int, detector: Detector | None) -> None:
        """Add the constants for a set of channels."""
        if detector is None:
            self.bank["row"][0, mask] = REFUSED
            return
        row = len(self._masks)
        if row < len(self.constants):
            self._masks.append(mask)
            self.bank["rows"] = row + 1
        else:
            row = self._oldest
            self._oldest = self._oldest % (len(self.constants) - 1) + 1
            self.bank["row"][0, self._masks[row]] = UNPREPARED
            self._masks[row] = mask
        self.constants[row] = detector.constants[0]
        self.states[row] = 0
        self.bank["row"][0, mask] = row


@compiled
def judge_rows(
    bank: NDArray[Any],
    z: Array,
    acceleration: Array,
    sample: NDArray[Any],
    verdicts: NDArray[Any],
    start: int,
) -> int:
    """Judge samples z (N, n) from row `start` on, with acceleration (N, 3) or (1, 3).

    Return the first row whose set of channels is not prepared, or N at the end.
    """
    for k in range(start, len(z)):
        sample[0].mask = present_in(z[k], bank[0].n)
        sample[0].stamp = bank[0].clock
        bank[0].clock += bank[0].period
        for a in range(3):
            sample[0].acceleration[a] = acceleration[
                k if len(acceleration) > 1 else 0, a
            ]
        if not judge_sample(bank[0], sample[0], z[k], verdicts[k]):
            bank[0].clock -= bank[0].period
            return k
    return len(z)


def as_verdict(verdicts: NDArray[Any], n: int) -> Verdict:
    """Return the verdict on N samples of n channels from their records, (N,)."""
    flags = np.dtype(np.bool_)
    return Verdict(
        verdicts["statistic"],
        verdicts["threshold"],
        verdicts["alarm"].view(flags),
        verdicts["suspects"][:, :n].view(flags),
        verdicts["isolated"].view(flags),
        verdicts["error"][:, :n],
        verdicts["scores"][:, :n],
    )


def accepted_options(method: type[Detector]) -> tuple[str, ...]:
    """Return the names of the options of a detector class."""
    names: list[str] = []
    for kind in method.__mro__:
        parameters = inspect.signature(kind).parameters.values()
        names += [
            one.name
            for one in parameters
            if one.kind == one.KEYWORD_ONLY and one.name not in names
        ]
        # Options that a class does not name go to its base.
        if all(one.kind != one.VAR_KEYWORD for one in parameters):
            break
    return tuple(names)


def built(
    method: Any, geometry: Geometry, noise: NoiseModel, options: Mapping[str, Any]
) -> Any:
    """Build a method.

    Raise `DetectorError` for an unknown option, or if the method cannot run on this
    geometry.
    """
    for option in options:
        if option not in accepted_options(method):
            known = ", ".join(accepted_options(method)) or "none"
            raise DetectorError(
                f"detector {method.name} has no option {option!r}, expected one of: {known}"
            )
    return method(geometry, noise, **options)
