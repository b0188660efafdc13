# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Biases and declarations that outlive the process, in one small file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
import stat
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.core.bias import IN_MOTION, RESTORED
from fdi_ros.core.decision import WHY
from fdi_ros.core.subsets import mask_of, members
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError
from fdi_ros.estimator.blocks import LONGEST_DELAY
from fdi_ros.estimator.error_states import predict
from fdi_ros.model.samples import Array
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.system.files import DistrustError, open_regular, read_trusted, replacing

FORMAT = 3
BEGIN = re.compile(rb'\s*\{\s*"format"\s*:')  # what a state file begins with
MAX_BYTES = 1 << 20  # bytes of a state file at most; what is longer is damaged
PLAUSIBLE = 5.0
"""An error is believed up to so many of the standard deviations that it had beforehand, beside its walk since."""
MOVED = 2.0
"""Errors are saved again when one is off the saved one by so many of its standard deviations, or known so many times
better. In between, the random walk that the age stands for on restoring covers it."""
DIGITS = 9  # of the figures saved
RETRY = 1.0  # what could not be saved is tried again after so long, s


def configuration_hash(config: Config) -> str:
    """Digest of all settings that stay as they are while the monitor runs."""
    fixed = {name: value for name, value in config.parameters().items() if not PARAMETERS[name].runtime}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


class RefusalError(Exception):
    """Why a state is not taken over, in words; what is merely damaged shows as one of `DAMAGED`."""


DAMAGED = (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError)


@dataclass(frozen=True, eq=False)
class Errors:
    """Estimated errors of the sensors, in the order of `fdi_ros.estimator.error_states.ERROR_KINDS`."""

    value: Array  # (N,)
    covariance: Array  # (N, N)
    late: Array  # (units,) delays taken off the stamps, s

    @classmethod
    def of(cls, detector: Detector) -> Errors | None:
        """Return what a detector has estimated, None if it has not."""
        if not detector.takes_any or not detector.states[0]["begun"]:
            return None
        estimator, count = detector.states[0]["estimator"], int(detector.constants[0]["layout"]["count"])
        x, p = estimator["states"]["x"][:count], estimator["states"]["p"][:count, :count]
        return cls(x.copy(), p.copy(), estimator["late"][: len(detector.geometry.units)].copy())

    def as_json(self) -> dict[str, object]:
        """Fields of the state file; of the covariance the lower triangle."""
        figures = {"value": self.value, "covariance": self.covariance[np.tril_indices(len(self.value))]}
        rounded = {name: [float(f"{one:.{DIGITS}g}") for one in values] for name, values in figures.items()}
        return {**rounded, "late": self.late.tolist()}

    @classmethod
    def parsed(cls, saved: Any, detector: Detector) -> Errors:
        """Errors from what a file holds; one of `DAMAGED` if they are none, or not of this detector."""
        count, units = int(detector.constants[0]["layout"]["count"]), len(detector.geometry.units)
        value, triangle, late = (np.array(saved[name], dtype=np.float64) for name in ("value", "covariance", "late"))
        if value.shape != (count,) or triangle.shape != (count * (count + 1) // 2,) or late.shape != (units,):
            raise ValueError
        covariance = np.zeros((count, count))
        covariance[np.tril_indices(count)] = triangle
        covariance += np.tril(covariance, -1).T
        if not np.isfinite([*value, *triangle]).all() or not (np.abs(late) <= LONGEST_DELAY).all():
            raise ValueError
        # Rounding may leave a covariance a little short of one.
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
        if (np.diag(covariance) < 0).any() or np.linalg.eigvalsh(covariance / np.outer(std, std)).min() <= -1e-6:
            raise ValueError
        return cls(value, covariance, late)

    def check(self, detector: Detector, bias: Array, turn_on: float) -> None:
        """Refuse errors that are not plausible beside biases (n,) at the start, rad/s."""
        geometry, layout = detector.geometry, detector.constants[0]["layout"]
        n, count = geometry.n, len(self.value)
        prior = layout["prior"][:count].copy()
        prior[:n] = turn_on
        limit = PLAUSIBLE * np.sqrt(prior**2 + np.diag(self.covariance))
        delays = layout["delays"][1 : len(geometry.units)]
        # Of what was saved before the first sample there are biases only.
        limit[delays[delays < count]] = LONGEST_DELAY
        worst = int(np.argmax(np.abs(self.value) / np.maximum(limit, 1e-300)))
        if abs(self.value[worst]) > limit[worst]:
            raise RefusalError(
                f"error state {worst + 1} is {self.value[worst]:.3g}, expected within {limit[worst]:.3g}"
            )
        common = float(np.abs(geometry.least_squares @ (bias + self.value[:n])).max())
        if common > PLAUSIBLE * turn_on:
            most = PLAUSIBLE * turn_on
            raise RefusalError(f"its biases pass for a turn of {common:.3g} rad/s, expected within {most:.3g}")


@dataclass(frozen=True)
class SavedState:
    """What outlives the process, in the fields of the file; channels by name."""

    bias: dict[str, float] | None  # rad/s; None: being learned.
    errors: Errors | None  # what is estimated of the errors of the sensors; None: nothing yet, or by no method.
    in_motion: bool  # whether the biases are as given, after a start in motion
    known: list[str]  # channels whose bias is known
    declared: dict[str, Any]
    """``faulty``: channels declared faulty, and why, one of `WHY`; ``ambiguous``: a set of which one is faulty."""

    @classmethod
    def of(cls, pipeline: Pipeline) -> SavedState:
        """Return what is to be kept of a monitor."""
        core, names = pipeline.core[0], pipeline.channel_names
        bias, decision, learned = core["bias"], core["decision"], not core["bias"]["learning"]
        return cls(
            bias=dict(zip(names, bias["value"][: len(names)].tolist(), strict=True)) if learned else None,
            errors=Errors.of(pipeline.detector) if learned else None,
            in_motion=bool(bias["outcome"] == IN_MOTION),
            known=[names[i] for i in members(int(bias["known"]))],
            declared={
                "faulty": {names[i]: WHY[decision["why"][i]] for i in members(int(decision["faulty"]))},
                "ambiguous": [names[i] for i in members(int(decision["ambiguous"]))],
            },
        )

    @classmethod
    def parsed(cls, saved: Any, pipeline: Pipeline) -> SavedState:
        """State from what a file holds, if it fits and is plausible; else a refusal, or one of `DAMAGED`."""
        names, detector, settings = pipeline.channel_names, pipeline.detector, pipeline.config.bias
        faulty, ambiguous = dict(saved["declared"]["faulty"]), list(saved["declared"]["ambiguous"])
        known, declared = list(saved["known"]), {"faulty": faulty, "ambiguous": ambiguous}
        sane = faulty.keys().isdisjoint(ambiguous) and {*faulty, *ambiguous, *known}.issubset(names)
        if not sane or not all(why and why in WHY for why in faulty.values()):
            raise ValueError
        if saved["bias"] is None:
            return cls(None, None, False, known, declared)
        values = np.array([saved["bias"][name] for name in names])
        if values.dtype != np.float64 or not np.isfinite(values).all():
            raise ValueError
        follows = detector.takes_any
        errors = Errors.parsed(saved["errors"], detector) if saved["errors"] is not None and follows else None
        off, bound = values - np.array(settings.fixed or 0.0), settings.max_rest_rate
        if (largest := float(np.abs(off).max())) > bound:
            raise RefusalError(
                f"a bias is {largest:.3g} rad/s off the one expected, at most {bound:g} (bias.max_rest_rate)"
            )
        if follows:
            n = len(names)
            (errors or Errors(np.zeros(n), np.zeros((n, n)), np.zeros(0))).check(detector, off, settings.turn_on_std)
        bias = dict(zip(names, values.tolist(), strict=True))
        return cls(bias, errors, saved["in_motion"] is True, known, declared)

    def restore(self, pipeline: Pipeline, age: float) -> None:
        """Write the state, which is so many seconds old, into the records of a monitor."""
        core, names, n = pipeline.core[0], pipeline.channel_names, pipeline.geometry.n
        number, settings = {name: i for i, name in enumerate(names)}, core["settings"]
        if self.bias is not None:
            bias = core["bias"]
            bias["value"][:n] = [self.bias[name] for name in names]
            bias["known"], bias["learning"] = mask_of(number[name] for name in self.known), False
            bias["outcome"] = IN_MOTION if self.in_motion else RESTORED
            std = settings["turn_on"] if self.in_motion else settings["learned"][:n]
            core["known"]["bias_std"][:n] = np.sqrt(std**2 + pipeline.config.noise.bias_walk[0] ** 2 * age)
            core["remaining"][:n] = core["known"]["bias_std"][:n]
        if self.errors is not None:
            # Known as well as their walk since then leaves them.
            detector, count = pipeline.detector, len(self.errors.value)
            detector.states["restored"] = True
            estimator = detector.states["estimator"][0]
            estimator["late"][: len(self.errors.late)] = self.errors.late
            estimator["states"]["x"][:count] = self.errors.value
            estimator["states"]["p"][:count, :count] = self.errors.covariance
            predict(detector.constants[0]["layout"], detector.states["estimator"]["states"][0], age)
            core["estimate"]["bias"][:n] = self.errors.value[:n]
        decision = core["decision"]
        decision["faulty"] = mask_of(number[name] for name in self.declared["faulty"])
        decision["ambiguous"] = decision["voted"] = mask_of(number[name] for name in self.declared["ambiguous"])
        for name, why in self.declared["faulty"].items():
            decision["why"][number[name]] = WHY.index(why)

    def differs(self, kept: SavedState | None) -> bool:
        """Whether it is to be saved, with another one kept: estimated errors always change a little."""
        if kept is None or replace(self, errors=None) != replace(kept, errors=None):
            return True
        if self.errors is None or kept.errors is None:
            return self.errors is not kept.errors
        std, then = np.sqrt(np.diag(self.errors.covariance)), np.sqrt(np.diag(kept.errors.covariance))
        moved = np.abs(self.errors.value - kept.errors.value) > MOVED * std
        return bool((moved | (then > MOVED * std)).any() or (self.errors.late != kept.errors.late).any())


class StateFile:
    """The file in which one monitor keeps its biases and declarations; what is older than ``max_age``, s, is left.

    `ConfigError` if its folder does not exist, or the age is not above zero.
    """

    def __init__(self, path: Path, max_age: float) -> None:
        if path.is_dir() or not path.name:
            raise ConfigError(f"state_file is {str(path)!r}, a folder, expected a file")
        if not path.parent.is_dir():
            raise ConfigError(f"state_file is {str(path)!r}, but there is no folder {str(path.parent)!r}")
        if not max_age > 0:
            raise ConfigError(f"state_max_age is {max_age:g} s, expected > 0 s")
        self.path = path
        self.max_age = max_age
        self.words = "not read yet"  # what became of the file, for people
        self.is_rejected = False  # whether there is a file that was not taken over; the next save moves it aside
        self.failed = False  # whether the state could not be saved when that was last tried
        self._kept: SavedState | None = None
        self._not_before = 0.0

    def restore(self, pipeline: Pipeline) -> bool:
        """Take over the state in the file, if it fits; return whether it did; `words` has the details.

        `ConfigError` if the file holds something else than a state: the next save must not replace it.
        """
        self._check_ours(self.path)
        self._check_ours(self._old)
        self.is_rejected = True
        try:
            self._restore_from(json.loads(read_trusted(self.path, MAX_BYTES).decode()), pipeline)
        except FileNotFoundError:
            self.is_rejected = False
            self.words = f"no state taken from {self.path}: there is none yet"
            return False
        except DistrustError as error:
            refusal = str(error.strerror)
        except OSError as error:
            refusal = f"cannot be read: {error.strerror}"
        except RefusalError as error:
            refusal = str(error)
        except DAMAGED:
            refusal = "damaged"
        else:
            self.is_rejected = False
            return True
        self.words = f"no state taken from {self.path}: {refusal}; it is kept as {self._old.name}"
        return False

    @property
    def _old(self) -> Path:
        """Where a state that was not taken over is kept."""
        return self.path.with_name(f"{self.path.name}.old")

    def _check_ours(self, path: Path) -> None:
        with contextlib.suppress(OSError):
            kind = path.lstat().st_mode
            if not stat.S_ISREG(kind) and not stat.S_ISLNK(kind):
                raise ConfigError(f"state_file is {str(self.path)!r}, but {str(path)!r} is no regular file")
            with open_regular(path, links=False) as file:
                begin = file.read(64)
            if begin and not BEGIN.match(begin):
                raise ConfigError(
                    f"state_file is {str(self.path)!r}, but {str(path)!r} holds no state of a monitor:"
                    " name another file, or move it away"
                )

    def save(self, pipeline: Pipeline) -> bool:
        """Write the state if it has changed since it was last written; return whether that was tried.

        The file is replaced as a whole or not at all; what goes wrong is in `words`.
        """
        state = SavedState.of(pipeline)
        if not state.differs(self._kept) or time.monotonic() < self._not_before:
            return False
        about = {"format": FORMAT, "configuration": configuration_hash(pipeline.config), "saved": time.time()}
        try:
            with replacing(self.path) as file:
                file.write(json.dumps({**about, **vars(state)}, indent=1, default=Errors.as_json).encode())
                if self.is_rejected:
                    with contextlib.suppress(FileNotFoundError):
                        self.path.replace(self._old)
                    self.is_rejected = False
        except OSError as error:
            self.words, self.failed = f"state cannot be saved to {self.path}: {error.strerror}", True
            self._not_before = time.monotonic() + RETRY
        else:
            self._kept, self.failed = state, False
            self.words = f"state saved to {self.path}"
        return True

    def _restore_from(self, saved: Any, pipeline: Pipeline) -> None:
        if saved["format"] != FORMAT:
            raise RefusalError(f"format {saved['format']!r}, expected {FORMAT}")
        if saved["configuration"] != configuration_hash(pipeline.config):
            raise RefusalError("it was saved with another configuration")
        age = time.time() - float(saved["saved"])
        if not math.isfinite(age):
            raise ValueError
        if age < 0:
            raise RefusalError(f"saved {-age:.0f} s ahead of the clock, which was set back")
        if age > self.max_age:
            raise RefusalError(f"saved {age:.0f} s ago, expected at most {self.max_age:g} s (state_max_age)")
        state = SavedState.parsed(saved, pipeline)
        state.restore(pipeline, age)
        restored = ["biases"] if state.bias is not None else []
        restored += [f"{name} {kind.upper()}" for kind, names in state.declared.items() for name in names]
        what = ", ".join(restored) or "nothing to restore"
        self.words = f"state of {age:.0f} s ago taken from {self.path}: {what}"
        self._kept = SavedState.of(pipeline)
