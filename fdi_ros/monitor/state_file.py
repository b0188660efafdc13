# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Biases and declarations of gyros and accelerometers that outlive the process, in one small file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
import stat
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.config.settings import BiasConfig
from fdi_ros.core.bias import IN_MOTION, RESTORED
from fdi_ros.core.decision import WHY
from fdi_ros.core.subsets import mask_of, members
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError
from fdi_ros.estimator.delays import LONGEST_DELAY
from fdi_ros.estimator.error_states import places_of, predict
from fdi_ros.model.samples import Array
from fdi_ros.monitor.accelerometers import possible_units
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.system.files import DistrustError, open_regular, read_trusted, replacing


class _StateFileRules(NamedTuple):
    """When a state file is written, and which saved errors are believed."""

    #: number of the format of the file
    format: int = 3
    #: largest file, bytes. Longer files are damaged
    max_bytes: int = 1 << 20
    #: expected standard deviations within which a saved error is believed, beside
    #: its walk since
    plausible: float = 5.0
    #: standard deviations by which an error differs from its saved value, or times
    #: by which it is known better, when it is saved again. A smaller change is
    #: covered by the random walk that is added for the age of the file when it is
    #: restored
    change: float = 2.0
    #: time until a failed save is tried again, s
    retry: float = 1.0


_FILE = _StateFileRules()

FILE_BEGIN = re.compile(rb'\s*\{\s*"format"\s*:')  # what a state file begins with


def configuration_hash(config: Config) -> str:
    """Digest of all settings that stay as they are while the monitor runs."""
    fixed = {
        name: value
        for name, value in config.parameters().items()
        if not PARAMETERS[name].runtime
    }
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


class RefusalError(Exception):
    """Why a state is refused, in words. Damaged states raise one of `DAMAGED`."""


DAMAGED = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
)


def _content(pipeline: Pipeline) -> dict[str, Any]:
    """Return the lasting state of the gyros, in the fields of the file, with channels by name and biases in rad/s."""
    core = pipeline.core[0]
    names = pipeline.geometry.channel_names
    bias = core["bias"]
    decision = core["decision"]
    learned = not core["bias"]["learning"]
    return {
        "bias": dict(zip(names, bias["value"][: len(names)].tolist(), strict=True))
        if learned
        else None,
        "errors": _errors(pipeline.guard) if learned else None,
        "in_motion": bool(bias["outcome"] == IN_MOTION),  # biases as given
        "known": [names[i] for i in members(int(bias["channels_known"]))],
        "declared": {
            "faulty": {
                names[i]: WHY[decision["why"][i]]
                for i in members(int(decision["faulty"]))
            },
            "ambiguous": [names[i] for i in members(int(decision["ambiguous"]))],
        },
    }


def _whole_content(pipeline: Pipeline) -> dict[str, Any]:
    """Return the lasting state of gyros, and of accelerometers in units of `FORCE.natural`."""
    other = pipeline.accelerometers
    felt = {"units": list(pipeline.felt)}
    accelerometers = None if other is None else {**_content(other), **felt}
    return {**_content(pipeline), "accelerometers": accelerometers}


def _errors(detector: Detector) -> dict[str, Array] | None:
    """Return the estimates of ``ERROR_KINDS``, (N,), (N, N), and corrected delays, s, or None."""
    if not detector.states[0]["begun"]:
        return None
    estimator = detector.states[0]["estimator"]
    count = int(detector.constants[0]["layout"]["count"])
    x = estimator["states"]["x"][:count]
    p = estimator["states"]["p"][:count, :count].copy()
    units = len(detector.geometry.units)
    late = estimator["late"][:units]
    # What vibration may have taught of delays is not saved by itself.
    delays = [place for (place,) in places_of("delay", detector.geometry.n, units)]
    p[delays, delays] += estimator["taught_delay"][1:units] ** 2
    return {"value": x.copy(), "covariance": p, "late": late.copy()}


def _as_json(figures: Array) -> list[float]:
    """Return figures in the form of the file. Covariances are lower triangles."""
    values = figures if figures.ndim == 1 else figures[np.tril_indices(len(figures))]
    return [float(f"{one:.9g}") for one in values]


def _differs(state: dict[str, Any], kept: dict[str, Any] | None) -> bool:
    """Whether a state is to be saved, with another one kept: estimated errors always change a little."""
    if kept is None:
        return True
    own = state.keys() - {"errors", "accelerometers"}
    if any(state[name] != kept[name] for name in own):
        return True
    other = state.get("accelerometers")
    if other is not None and _differs(other, kept["accelerometers"]):
        return True
    now = state["errors"]
    then = kept["errors"]
    if now is None or then is None:
        return now is not then
    std, std_then = (np.sqrt(np.diag(errors["covariance"])) for errors in (now, then))
    moved = np.abs(now["value"] - then["value"]) > _FILE.change * std
    return bool(
        (moved | (std_then > _FILE.change * std)).any()
        or (now["late"] != then["late"]).any()
    )


def _parsed(saved: Any, pipeline: Pipeline) -> dict[str, Any]:
    """Return the state in a file's content, if plausible and of this monitor.

    Raise a refusal, or one of `DAMAGED`.
    """
    names = pipeline.geometry.channel_names
    detector = pipeline.guard
    settings = pipeline.config.bias
    faulty = dict(saved["declared"]["faulty"])
    ambiguous = list(saved["declared"]["ambiguous"])
    sane = faulty.keys().isdisjoint(ambiguous) and {
        *faulty,
        *ambiguous,
        *saved["known"],
    }.issubset(names)
    known = all(why and why in WHY for why in faulty.values())
    if not sane or not known:
        raise ValueError
    state = {
        "bias": None,
        "errors": None,
        "known": saved["known"],
        "in_motion": saved["in_motion"] is True,
    }
    state["declared"] = {"faulty": faulty, "ambiguous": ambiguous}
    if saved["bias"] is None:
        return state
    values = np.array([saved["bias"][name] for name in names])
    if values.dtype != np.float64 or not np.isfinite(values).all():
        raise ValueError
    state["bias"] = dict(zip(names, values.tolist(), strict=True))
    off = values - np.array(settings.fixed or 0.0)
    bound = settings.max_rest_rate
    if saved["errors"] is not None:
        state["errors"] = _parsed_errors(saved["errors"], detector)
    if (largest := float(np.abs(off).max())) > bound:
        raise RefusalError(
            f"a bias is {largest:.3g} rad/s off the one expected, at most {bound:g} (bias.max_rest_rate)"
        )
    n = len(names)
    _check(
        state["errors"] or {"value": np.zeros(n), "covariance": np.zeros((n, n))},
        detector,
        off,
        settings,
    )
    return state


def _parsed_accelerometers(
    saved: Any, pipeline: Pipeline
) -> tuple[Pipeline, dict[str, Any]]:
    """Return the monitor of the accelerometers that were judged, and their state in a file's content.

    They are judged once samples show the same units. Errors as of `_parsed`.
    """
    units = tuple(map(int, saved["units"]))
    if not set(units) <= set(possible_units(pipeline.config, pipeline.geometry.n)):
        raise ValueError
    half = pipeline.build_accelerometers(units)
    try:
        return half, _parsed(saved, half)
    except RefusalError:
        raise RefusalError("biases of accelerometers are not plausible") from None


def _parsed_errors(saved: Any, detector: Detector) -> dict[str, Array]:
    """Return the errors in a file's content.

    Raise one of `DAMAGED` if they are invalid or of another detector.
    """
    count = int(detector.constants[0]["layout"]["count"])
    units = len(detector.geometry.units)
    value, triangle, late = (
        np.array(saved[name], dtype=np.float64)
        for name in ("value", "covariance", "late")
    )
    if (
        value.shape != (count,)
        or triangle.shape != (count * (count + 1) // 2,)
        or late.shape != (units,)
    ):
        raise ValueError
    covariance = np.zeros((count, count))
    covariance[np.tril_indices(count)] = triangle
    covariance += np.tril(covariance, -1).T
    if (
        not np.isfinite([*value, *triangle]).all()
        or not (np.abs(late) <= LONGEST_DELAY).all()
    ):
        raise ValueError
    # Rounding may leave a covariance a little short of one.
    variance = np.diag(covariance)
    std = np.sqrt(np.maximum(variance, 1e-30))
    correlation = covariance / np.outer(std, std)
    if (variance < 0).any() or np.linalg.eigvalsh(correlation).min() <= -1e-6:
        raise ValueError
    return {"value": value, "covariance": covariance, "late": late}


def _check(
    errors: dict[str, Array], detector: Detector, bias: Array, settings: BiasConfig
) -> None:
    """Refuse errors that are not plausible beside biases (n,) at the start, rad/s."""
    geometry = detector.geometry
    layout = detector.constants[0]["layout"]
    value = errors["value"]
    n = geometry.n
    count = len(value)
    turn_on_std = settings.turn_on_std
    prior = layout["prior"][:count].copy()
    prior[:n] = turn_on_std
    limit = _FILE.plausible * np.sqrt(prior**2 + np.diag(errors["covariance"]))
    delays = layout["delays"][1 : len(geometry.units)]
    # A state from before the first sample has only biases.
    limit[delays[delays < count]] = LONGEST_DELAY
    relative = np.abs(value) / np.maximum(limit, 1e-300)
    worst = int(np.argmax(relative))
    if abs(value[worst]) > limit[worst]:
        raise RefusalError(
            f"error state {worst + 1} is {value[worst]:.3g}, expected within {limit[worst]:.3g}"
        )
    of_rate = geometry.least_squares @ (bias + value[:n])
    common = float(np.abs(of_rate).max())
    most = _FILE.plausible * turn_on_std
    if common > most:
        raise RefusalError(
            f"its biases pass for a turn of {common:.3g} rad/s, expected within {most:.3g}"
        )


def _restore(state: dict[str, Any], pipeline: Pipeline, age: float) -> None:
    """Write a state of a certain age, s, into the records of a monitor."""
    core = pipeline.core[0]
    n = pipeline.geometry.n
    names = pipeline.geometry.channel_names
    settings = core["settings"]
    faulty = state["declared"]["faulty"]
    ambiguous = state["declared"]["ambiguous"]
    if state["bias"] is not None:
        bias = core["bias"]
        bias["value"][:n] = list(state["bias"].values())
        bias["channels_known"] = mask_of(map(names.index, state["known"]))
        bias["learning"] = False
        bias["outcome"] = IN_MOTION if state["in_motion"] else RESTORED
        std = settings["turn_on_std"] if state["in_motion"] else settings["learned"][:n]
        walk = np.array(pipeline.config.noise.bias_walk)
        core["sample"]["bias_std"][:n] = np.sqrt(std**2 + walk**2 * age)
        core["remaining"][:n] = core["sample"]["bias_std"][:n]
    if state["errors"] is not None:
        # Known as well as their walk since then leaves them.
        detector, (value, covariance, late) = (
            pipeline.guard,
            state["errors"].values(),
        )
        detector.states["restored"] = True
        estimator = detector.states["estimator"][0]
        count = len(value)
        estimator["late"][: len(late)] = late
        estimator["states"]["x"][:count] = value
        estimator["states"]["p"][:count, :count] = covariance
        predict(
            detector.constants[0]["layout"],
            detector.states["estimator"]["states"][0],
            age,
        )
        core["sample"]["estimate"]["bias"][:n] = value[:n]
    decision = core["decision"]
    decision["faulty"] = mask_of(map(names.index, faulty))
    decision["ambiguous"] = decision["voted"] = mask_of(map(names.index, ambiguous))
    for name, why in faulty.items():
        decision["why"][names.index(name)] = WHY.index(why)


class StateFile:
    """The file in which one monitor keeps its biases and declarations. States older than ``max_age``, s, are refused.

    `ConfigError` if its folder does not exist, or the age is not above zero.
    """

    def __init__(self, path: Path, max_age: float) -> None:
        if path.is_dir() or not path.name:
            raise ConfigError(f"state_file is {str(path)!r}, a folder, expected a file")
        if not path.parent.is_dir():
            raise ConfigError(
                f"state_file is {str(path)!r}, but there is no folder {str(path.parent)!r}"
            )
        if not max_age > 0:
            raise ConfigError(f"state_max_age is {max_age:g} s, expected > 0 s")
        self.path = path
        self.max_age = max_age
        self.words = "not read yet"  # what became of the file, for people
        self.is_rejected = (
            False  # whether a file was refused. The next save renames that file
        )
        self.failed = (
            False  # whether the state could not be saved when that was last tried
        )
        self._kept: dict[str, Any] | None = None
        self._not_before = 0.0

    def restore(self, pipeline: Pipeline) -> bool:
        """Take over the state in the file, if it fits, and return whether it did.

        Raise `ConfigError` if the file is no state.
        """
        self._check_ours(self.path)
        self._check_ours(self._old)
        self.is_rejected = True
        try:
            self._restore_from(
                json.loads(read_trusted(self.path, _FILE.max_bytes).decode()), pipeline
            )
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
                raise ConfigError(
                    f"state_file is {str(self.path)!r}, but {str(path)!r} is no regular file"
                )
            with open_regular(path, links=False) as file:
                begin = file.read(64)
            if begin and not FILE_BEGIN.match(begin):
                raise ConfigError(
                    f"state_file is {str(self.path)!r}, but {str(path)!r} holds no state of a monitor:"
                    " name another file, or move it away"
                )

    def save(self, pipeline: Pipeline) -> bool:
        """Write a changed state, whole or not at all. Return whether a write was tried."""
        state = _whole_content(pipeline)
        if not _differs(state, self._kept) or time.monotonic() < self._not_before:
            return False
        about = {
            "format": _FILE.format,
            "configuration": configuration_hash(pipeline.config),
            "saved": time.time(),
        }
        try:
            with replacing(self.path) as file:
                file.write(
                    json.dumps({**about, **state}, indent=1, default=_as_json).encode()
                )
                if self.is_rejected:
                    with contextlib.suppress(FileNotFoundError):
                        self.path.replace(self._old)
                    self.is_rejected = False
        except OSError as error:
            self.words = f"state cannot be saved to {self.path}: {error.strerror}"
            self.failed = True
            self._not_before = time.monotonic() + _FILE.retry
        else:
            self._kept = state
            self.failed = False
            self.words = f"state saved to {self.path}"
        return True

    def _restore_from(self, saved: Any, pipeline: Pipeline) -> None:
        if saved["format"] != _FILE.format:
            raise RefusalError(f"format {saved['format']!r}, expected {_FILE.format}")
        if saved["configuration"] != configuration_hash(pipeline.config):
            raise RefusalError("it was saved with another configuration")
        age = time.time() - float(saved["saved"])
        if not math.isfinite(age):
            raise ValueError
        if age < 0:
            raise RefusalError(
                f"saved {-age:.0f} s ahead of the clock, which was set back"
            )
        if age > self.max_age:
            raise RefusalError(
                f"saved {age:.0f} s ago, expected at most {self.max_age:g} s (state_max_age)"
            )
        parts = [(pipeline, _parsed(saved, pipeline))]
        if given := saved.get("accelerometers"):
            parts.append(_parsed_accelerometers(given, pipeline))
        for half, state in parts:
            _restore(state, half, age)
        state = parts[0][1]
        restored = ["biases"] if state["bias"] is not None else []
        restored += [
            f"{name} {kind.upper()}"
            for _, part in parts
            for kind, names in part["declared"].items()
            for name in names
        ]
        what = ", ".join(restored) or "nothing to restore"
        self.words = f"state of {age:.0f} s ago taken from {self.path}: {what}"
        self._kept = _whole_content(pipeline)
