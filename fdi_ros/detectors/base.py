"""The contract of a detector: samples in, verdicts out; it never latches, votes, logs or resets itself."""

from __future__ import annotations

import copy
import inspect
import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import DetectorError, FdiError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHUNK = 4096
"""Rows judged at once: the intermediate arrays of so many rows stay in the processor's cache."""

LARGEST_RATE = 1e6
"""rad/s. No gyro measures so much: a larger finite value is taken for this, so that squares stay finite."""

MOST_FEWER = 512
"""Detectors of fewer channels that are kept at most."""


class Verdict(NamedTuple):
    """What a detector says of each of N samples of n channels.

    A sample it could not judge (too few channels present for this method) has a NaN statistic and threshold and
    no alarm: not judged is not healthy.
    """

    statistic: Array
    """(N,) the figure compared with the threshold."""
    threshold: Array
    """(N,) alarm where the statistic reaches it."""
    alarm: Mask
    """(N,) at least one channel is faulty."""
    suspects: Mask
    """(N, n) the channels that may be faulty; none without alarm."""
    isolated: Mask
    """(N,) every suspect is faulty. With alarm and not isolated: at least one is, the evidence cannot tell which."""
    error: Array
    """(N, n) estimated error of each suspect, rad/s; 0 elsewhere."""
    scores: Array
    """(N, n) the method's own figure per channel, as its paper tabulates it; NaN for a channel not judged."""

    @classmethod
    def silent(cls, rows: int, n: int) -> Verdict:
        """Verdict on samples that were not judged."""
        return cls(
            np.full(rows, np.nan),
            np.full(rows, np.nan),
            np.zeros(rows, dtype=bool),
            np.zeros((rows, n), dtype=bool),
            np.zeros(rows, dtype=bool),
            np.zeros((rows, n)),
            np.full((rows, n), np.nan),
        )


class Detector(ABC):
    """Base of all detectors: checks the shape, and judges a sample with absent channels by the channels left.

    A channel whose value is NaN or infinite is absent from that sample. For each pattern of absence a detector of
    the same method and options is built once for the channels left, and kept.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a sound channel.
    options
        Options of the method, as given; passed on to the detectors of fewer channels.
    """

    name: ClassVar[str]
    min_channels: ClassVar[int] = 4
    """Fewest channels with which the method can at least detect."""

    def __init__(self, geometry: Geometry, noise: NoiseModel, options: dict[str, Any]) -> None:
        self.geometry = geometry
        self.noise = noise.for_channels(geometry.n)
        self.options = options
        self._fewer: dict[bytes, Detector | None] = {}
        self.refusals: dict[bytes, str] = {}
        self._memory: Any = None
        """All that the method keeps of the samples before; None for a method without memory."""

    @property
    def isolable(self) -> Mask:
        """Channels whose fault this method names without another one beside it, (n,)."""
        return self.geometry.isolable

    @abstractmethod
    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        """Judge samples z (N >= 1, n), all finite."""

    def reset(self) -> None:
        """Forget all samples seen; only methods with a memory of their own have something to forget."""
        for detector in self._fewer.values():
            if detector is not None:
                detector.reset()

    def snapshot(self) -> tuple[Any, dict[bytes, Any]]:
        """Copy of all memory, for `restore`: to judge samples and then take part of them back."""
        fewer = {key: detector.snapshot() for key, detector in self._fewer.items() if detector is not None}
        return copy.deepcopy(self._memory), fewer

    def restore(self, snapshot: tuple[Any, dict[bytes, Any]]) -> None:
        """Go back to a snapshot."""
        self._memory, fewer = snapshot
        for key, detector in self._fewer.items():
            if detector is not None and key in fewer:
                detector.restore(fewer[key])
            elif detector is not None:
                detector.reset()

    def detect(self, z: Array, acceleration: Array | None = None) -> Verdict:
        """Judge a block of samples.

        Parameters
        ----------
        z
            Measured channels, (N, n) rad/s; NaN or infinite: absent from that sample. A finite value beyond
            `LARGEST_RATE` counts as that.
        acceleration
            Body angular acceleration, (N, 3) rad/s^2, for noise models with a timing term; None is zero.

        Returns
        -------
        Verdict on each sample. However a stream is cut into blocks, the verdicts are the same to the last bit.

        Raises
        ------
        DetectorError
            If z does not have n columns.
        """
        z = np.asarray(z, dtype=np.float64)
        if z.ndim != 2 or z.shape[1] != self.geometry.n:
            raise DetectorError(f"z has shape {z.shape}, expected (N, {self.geometry.n})")
        rows = len(z)
        if rows == 1 and _is_ordinary(z[0].tolist()):
            return self._judge(z, acceleration)
        if rows <= CHUNK:
            return self._judge_any(z, acceleration)
        verdict = Verdict.silent(rows, self.geometry.n)
        for start in range(0, rows, CHUNK):
            part = slice(start, start + CHUNK)
            judged = self._judge_any(z[part], None if acceleration is None else acceleration[part])
            for whole, piece in zip(verdict, judged, strict=True):
                whole[part] = piece
        return verdict

    def fewer(self, mask: Mask) -> Detector | None:
        """Return the same method on the channels marked in mask (n,), None where it cannot run on them.

        The reason is kept in `refusals`, by ``mask.tobytes()``.
        """
        if mask.all():
            return self
        key = mask.tobytes()
        if key not in self._fewer:
            if len(self._fewer) >= MOST_FEWER:
                # A stream of random absences must not fill the memory: the oldest pattern is built again if it comes.
                self._fewer.pop(next(iter(self._fewer)))
            try:
                reduced = self.geometry.subset(mask)
                self._fewer[key] = type(self)(reduced, self.noise.subset(mask), **self.options)
            except FdiError as error:
                self._fewer[key] = None
                self.refusals[key] = str(error)
        return self._fewer[key]

    def _judge_any(self, z: Array, acceleration: Array | None) -> Verdict:
        """Judge rows (N, n) in which any channel may be absent."""
        if len(z) == 0:
            return Verdict.silent(0, self.geometry.n)
        present = np.isfinite(z)
        z = np.clip(z, -LARGEST_RATE, LARGEST_RATE)
        if present.all():
            return self._judge(z, acceleration)
        if len(z) == 1 or (present == present[0]).all():
            return self._judge_present(z, present[0], acceleration)
        verdict = Verdict.silent(len(z), self.geometry.n)
        patterns, which = np.unique(present, axis=0, return_inverse=True)
        for k, mask in enumerate(patterns):
            rows = np.flatnonzero(which.reshape(-1) == k)
            part = self._judge_present(z[rows], mask, None if acceleration is None else acceleration[rows])
            for whole, piece in zip(verdict, part, strict=True):
                whole[rows] = piece
        return verdict

    def _judge_present(self, z: Array, mask: Mask, acceleration: Array | None) -> Verdict:
        """Judge rows (N, n) of which just the channels in mask (n,) are present."""
        rows, n = z.shape
        detector = self.fewer(mask)
        if detector is None:
            return Verdict.silent(rows, n)
        part = detector._judge(np.ascontiguousarray(z[:, mask]), acceleration)
        suspects, error, scores = np.zeros((rows, n), dtype=bool), np.zeros((rows, n)), np.full((rows, n), np.nan)
        suspects[:, mask], error[:, mask], scores[:, mask] = part.suspects, part.error, part.scores
        return part._replace(suspects=suspects, error=error, scores=scores)


def _is_ordinary(values: list[float]) -> bool:
    """Whether all values are finite, and none is to be clipped."""
    return math.isfinite(sum(values)) and max(values) <= LARGEST_RATE and min(values) >= -LARGEST_RATE


def accepted_options(method: type[Detector]) -> tuple[str, ...]:
    """Names of the options that a detector class takes."""
    parameters = inspect.signature(method).parameters
    return tuple(name for name in parameters if name not in ("geometry", "noise"))
