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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.core.bias import IN_MOTION, RESTORED
from fdi_ros.core.decision import WHY
from fdi_ros.core.subsets import is_in, mask_of
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError
from fdi_ros.estimator.blocks import LONGEST_DELAY
from fdi_ros.estimator.error_states import predict
from fdi_ros.model.samples import Array
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.system import trusted_file

FORMAT = 3
BEGIN = re.compile(rb'\s*\{\s*"format"\s*:')
"""What a state file begins with."""
MAX_BYTES = 1 << 20
"""Bytes of a state file at most; what is longer is damaged."""
PLAUSIBLE = 5.0
"""An error is believed up to so many of the standard deviations that it had beforehand, beside its walk since."""
MOVED = 2.0
"""Errors are saved again when one is off the saved one by so many of its standard deviations, or known so many times
better. In between, the random walk that the age stands for on restoring covers it."""
DIGITS = 9
"""Of the figures saved."""
RETRY = 1.0
"""What could not be saved is tried again after so long, s."""


def configuration_hash(config: Config) -> str:
    """Digest of all settings that stay as they are while the monitor runs."""
    fixed = {name: value for name, value in config.parameters().items() if not PARAMETERS[name].runtime}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class Errors:
    """Estimated errors of the sensors, in the order of `fdi_ros.estimator.error_states.ERROR_KINDS`."""

    value: Array
    """(N,)"""
    covariance: Array
    """(N, N)"""
    late: Array
    """(units,) delays taken off the stamps, s."""

    @classmethod
    def of(cls, detector: Detector) -> Errors | None:
        """Return what a detector has estimated, None if it has not."""
        if not detector.takes_any or not detector.states[0]["begun"]:
            return None
        estimator, count = detector.states[0]["estimator"], int(detector.constants[0]["layout"]["count"])
        states = estimator["states"]
        late = estimator["late"][: len(detector.geometry.units)]
        return cls(states["x"][:count].copy(), states["p"][:count, :count].copy(), late.copy())

    def as_json(self) -> dict[str, object]:
        """Fields of the state file; of the covariance the lower triangle."""
        triangle = self.covariance[np.tril_indices(len(self.value))]
        return {
            "value": [float(f"{value:.{DIGITS}g}") for value in self.value],
            "covariance": [float(f"{value:.{DIGITS}g}") for value in triangle],
            "late": self.late.tolist(),
        }

    @classmethod
    def parsed(cls, saved: Any, detector: Detector) -> Errors | None:
        """Errors from what a file holds; None if it is damaged, or not for this detector."""
        count, units = int(detector.constants[0]["layout"]["count"]), len(detector.geometry.units)
        value, triangle = np.array(saved["value"], dtype=np.float64), np.array(saved["covariance"], dtype=np.float64)
        late = np.array(saved["late"], dtype=np.float64)
        if value.shape != (count,) or triangle.shape != (count * (count + 1) // 2,) or late.shape != (units,):
            return None
        covariance = np.zeros((count, count))
        covariance[np.tril_indices(count)] = triangle
        covariance += np.tril(covariance, -1).T
        if not (np.isfinite(value).all() and np.isfinite(covariance).all() and np.isfinite(late).all()):
            return None
        # Rounding may leave a covariance a little short of one.
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
        whole = np.linalg.eigvalsh(covariance / np.outer(std, std)).min() > -1e-6
        usable = bool((np.diag(covariance) >= 0).all() and whole and (np.abs(late) <= LONGEST_DELAY).all())
        return cls(value, covariance, late) if usable else None

    def doubt(self, detector: Detector, bias: Array, turn_on: float) -> str:
        """Say what is not plausible about errors, beside biases (n,) at the start, rad/s; empty if nothing is."""
        geometry, layout = detector.geometry, detector.constants[0]["layout"]
        n, count = geometry.n, len(self.value)
        limit = PLAUSIBLE * np.sqrt(layout["prior"][:count] ** 2 + np.diag(self.covariance))
        limit[:n] = PLAUSIBLE * np.sqrt(turn_on**2 + np.diag(self.covariance)[:n])
        delays = layout["delays"][1 : len(geometry.units)]
        # Of what was saved before the first sample there are biases only.
        limit[delays[delays < count]] = LONGEST_DELAY
        worst = int(np.argmax(np.abs(self.value) / np.maximum(limit, 1e-300)))
        if abs(self.value[worst]) > limit[worst]:
            return f"error state {worst + 1} is {self.value[worst]:.3g}, expected within {limit[worst]:.3g}"
        common = float(np.abs(geometry.least_squares @ (bias + self.value[:n])).max())
        if common > PLAUSIBLE * turn_on:
            return f"its biases pass for a turn of {common:.3g} rad/s, expected within {PLAUSIBLE * turn_on:.3g}"
        return ""


@dataclass(frozen=True)
class SavedState:
    """What outlives the process, in the fields of the file; channels by name."""

    bias: dict[str, float] | None
    """rad/s; None: being learned."""
    errors: Errors | None
    """What is estimated of the errors of the sensors; None: nothing yet, or by no method."""
    in_motion: bool
    """Whether the biases are as given, after a start in motion."""
    known: list[str]
    """Channels whose bias is known."""
    declared: dict[str, Any]
    """``faulty``: channels declared faulty, and why, one of `WHY`; ``ambiguous``: a set of which one is faulty."""


class StateFile:
    """The file in which one monitor keeps its biases and declarations.

    Parameters
    ----------
    path
        Of the file; its folder must exist.
    max_age
        A state older than this is not taken over, s.

    Raises
    ------
    ConfigError
        If the folder does not exist, or the age is not above zero.
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
        self.words = "not read yet"
        """What became of the file, for people."""
        self.is_rejected = False
        """Whether there is a file that was not taken over; the next save moves it aside."""
        self.failed = False
        """Whether the state could not be saved when that was last tried."""
        self._kept: SavedState | None = None
        self._not_before = 0.0

    def restore(self, pipeline: Pipeline) -> bool:
        """Take over the state in the file, if it fits; return whether it did; `words` has the details.

        Raises
        ------
        ConfigError
            If the file holds something else than a state: the next save must not replace it.
        """
        refusal = ""
        self._check_ours(self.path)
        self._check_ours(self._old)
        try:
            refusal = self._restore_from(json.loads(trusted_file.read(self.path, MAX_BYTES).decode()), pipeline)
        except FileNotFoundError:
            self.is_rejected = False
            self.words = f"no state taken from {self.path}: there is none yet"
            return False
        except trusted_file.DistrustError as error:
            refusal = str(error.strerror)
        except OSError as error:
            refusal = f"cannot be read: {error.strerror}"
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
            refusal = "damaged"
        self.is_rejected = bool(refusal)
        if refusal:
            self.words = f"no state taken from {self.path}: {refusal}; it is kept as {self._old.name}"
        return not refusal

    @property
    def _old(self) -> Path:
        """Where a state that was not taken over is kept."""
        return self.path.with_name(f"{self.path.name}.old")

    def _check_ours(self, path: Path) -> None:
        with contextlib.suppress(OSError):
            kind = path.lstat().st_mode
            if not stat.S_ISREG(kind) and not stat.S_ISLNK(kind):
                raise ConfigError(f"state_file is {str(self.path)!r}, but {str(path)!r} is no regular file")
            with trusted_file.open_regular(path, links=False) as file:
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
        state = _state_of(pipeline)
        if not _changed(state, self._kept) or time.monotonic() < self._not_before:
            return False
        about = {"format": FORMAT, "configuration": configuration_hash(pipeline.config), "saved": time.time()}
        try:
            with trusted_file.replacing(self.path) as file:
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

    def _restore_from(self, saved: Any, pipeline: Pipeline) -> str:
        """Take over a state; return why not, empty if it was."""
        if saved["format"] != FORMAT:
            return f"format {saved['format']!r}, expected {FORMAT}"
        if saved["configuration"] != configuration_hash(pipeline.config):
            return "it was saved with another configuration"
        age = time.time() - float(saved["saved"])
        if not math.isfinite(age):
            return "damaged"
        if age < 0:
            return f"saved {-age:.0f} s ahead of the clock, which was set back"
        if age > self.max_age:
            return f"saved {age:.0f} s ago, expected at most {self.max_age:g} s (state_max_age)"
        names, detector = pipeline.channel_names, pipeline.detector
        state = _parsed(saved, names, detector)
        if state is None:
            return "damaged"
        centre, turn_on = np.array(pipeline.config.bias.fixed or 0.0), pipeline.config.bias.turn_on_std
        if state.bias is not None:
            off = np.array([state.bias[name] for name in names]) - centre
            largest = float(np.abs(off).max())
            if largest > pipeline.config.bias.max_rest_rate:
                bound = pipeline.config.bias.max_rest_rate
                return f"a bias is {largest:.3g} rad/s off the one expected, at most {bound:g} (bias.max_rest_rate)"
            errors = state.errors or Errors(np.zeros(len(names)), np.zeros((len(names),) * 2), np.zeros(0))
            if doubt := errors.doubt(detector, off, turn_on) if detector.takes_any else "":
                return doubt
        _restore(pipeline, state, age)
        restored = [f"{name} FAULTY" for name in state.declared["faulty"]]
        restored += [f"{name} AMBIGUOUS" for name in state.declared["ambiguous"]]
        what = ", ".join(["biases", *restored] if state.bias is not None else restored) or "nothing to restore"
        self.words = f"state of {age:.0f} s ago taken from {self.path}: {what}"
        self._kept = _state_of(pipeline)
        return ""


def _parsed(saved: Any, names: Sequence[str], detector: Detector) -> SavedState | None:
    """State from what a file holds; None, or one of the errors that `StateFile.restore` catches, if it is damaged."""
    faulty, ambiguous, known = dict(saved["declared"]["faulty"]), list(saved["declared"]["ambiguous"]), saved["known"]
    sane = faulty.keys().isdisjoint(ambiguous) and {*faulty, *ambiguous, *known}.issubset(names)
    if not sane or not all(why and why in WHY for why in faulty.values()):
        return None
    declared = {"faulty": faulty, "ambiguous": ambiguous}
    if saved["bias"] is None:
        return SavedState(None, None, False, list(known), declared)
    values = np.array([saved["bias"][name] for name in names])
    if values.dtype != np.float64 or not np.isfinite(values).all():
        return None
    errors = None
    if saved["errors"] is not None and detector.takes_any:
        errors = Errors.parsed(saved["errors"], detector)
        if errors is None:
            return None
    bias = dict(zip(names, values.tolist(), strict=True))
    return SavedState(bias, errors, saved["in_motion"] is True, list(known), declared)


def _restore(pipeline: Pipeline, state: SavedState, age: float) -> None:
    """Write a state that is so many seconds old into the records of a monitor."""
    core, names = pipeline.core[0], pipeline.channel_names
    number = {name: i for i, name in enumerate(names)}
    if state.bias is not None:
        bias = core["bias"]
        bias["value"][: len(names)] = [state.bias[name] for name in names]
        bias["known"], bias["learning"] = mask_of(number[name] for name in state.known), False
        bias["outcome"] = IN_MOTION if state.in_motion else RESTORED
        settings = core["settings"]
        std = settings["turn_on"] if state.in_motion else settings["learned"][: len(names)]
        core["known"]["bias_std"][: len(names)] = np.sqrt(std**2 + pipeline.config.noise.bias_walk[0] ** 2 * age)
        core["remaining"][: len(names)] = core["known"]["bias_std"][: len(names)]
    if state.errors is not None:
        _go_on_estimating(pipeline.detector, state.errors, age)
        core["estimate"]["bias"][: len(names)] = state.errors.value[: len(names)]
    faulty, ambiguous = state.declared["faulty"], state.declared["ambiguous"]
    core["decision"]["faulty"] = mask_of(number[name] for name in faulty)
    core["decision"]["ambiguous"] = core["decision"]["voted"] = mask_of(number[name] for name in ambiguous)
    for name, why in faulty.items():
        core["decision"]["why"][number[name]] = WHY.index(why)


def _go_on_estimating(detector: Detector, errors: Errors, age: float) -> None:
    """Go on from errors as they were, known as well as their walk since then leaves them."""
    state, layout = detector.states, detector.constants[0]["layout"]
    estimator, count = state["estimator"], len(errors.value)
    state["restored"] = True
    estimator["late"][0, : len(errors.late)] = errors.late
    estimator["states"]["x"][0, :count] = errors.value
    estimator["states"]["p"][0, :count, :count] = errors.covariance
    predict(layout, estimator["states"][0], age)


def _changed(state: SavedState, kept: SavedState | None) -> bool:
    """Whether a state is to be saved: estimated errors always change a little."""
    if kept is None or replace(state, errors=None) != replace(kept, errors=None):
        return True
    if state.errors is None or kept.errors is None:
        return state.errors is not kept.errors
    std, then = np.sqrt(np.diag(state.errors.covariance)), np.sqrt(np.diag(kept.errors.covariance))
    moved = np.abs(state.errors.value - kept.errors.value) > MOVED * std
    return bool((moved | (then > MOVED * std)).any() or (state.errors.late != kept.errors.late).any())


def _state_of(pipeline: Pipeline) -> SavedState:
    """Return what is kept: biases, unless they are being learned, and what is declared and why."""
    core, names = pipeline.core[0], pipeline.channel_names
    bias, decision, n = core["bias"], core["decision"], len(names)
    faulty, ambiguous, known = int(decision["faulty"]), int(decision["ambiguous"]), int(bias["known"])
    return SavedState(
        bias=None if bias["learning"] else dict(zip(names, bias["value"][:n].tolist(), strict=True)),
        errors=None if bias["learning"] else Errors.of(pipeline.detector),
        in_motion=bool(bias["outcome"] == IN_MOTION),
        known=[name for i, name in enumerate(names) if is_in(i, known)],
        declared={
            "faulty": {name: WHY[decision["why"][i]] for i, name in enumerate(names) if is_in(i, faulty)},
            "ambiguous": [name for i, name in enumerate(names) if is_in(i, ambiguous)],
        },
    )
