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
from numpy.typing import NDArray

from fdi_ros import own_file
from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.core.bias import IN_MOTION, RESTORED
from fdi_ros.core.channel_set import is_in, mask_of
from fdi_ros.core.decision import WHY
from fdi_ros.errors import ConfigError
from fdi_ros.monitor.pipeline import Pipeline

FORMAT = 2
BEGIN = re.compile(rb'\s*\{\s*"format"\s*:')
"""What a state file begins with."""
LONGEST = 1 << 20
"""Bytes of a state file at most; what is longer is damaged."""
LARGEST_BIAS = 10.0
"""rad/s, the limit of `bias.fixed`."""
MOVED = 2.0
"""A followed bias is saved again when it is off the saved one by so many of its standard deviations, or known so many
times better. In between, the random walk that the age stands for on restoring covers it."""
RETRY = 1.0
"""What could not be saved is tried again after so long, s."""


def configuration_hash(config: Config) -> str:
    """Digest of all settings that stay as they are while the monitor runs."""
    fixed = {name: value for name, value in config.parameters().items() if not PARAMETERS[name].runtime}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class SavedState:
    """What outlives the process; channels by name."""

    bias: dict[str, float] | None
    """rad/s; None: being learned."""
    followed: dict[str, tuple[float, float]] | None
    """What was followed of each bias in flight, and its standard deviation, rad/s; None: biases are being learned."""
    in_motion: bool
    """Whether the biases are as given, after a start in motion."""
    known: list[str]
    """Channels whose bias is known."""
    faulty: dict[str, str]
    """Channels declared faulty, and why: one of `WHY`."""
    ambiguous: list[str]
    """A set of channels one of which is faulty."""

    def as_json(self) -> dict[str, object]:
        """Fields of the state file."""
        return {
            "bias": self.bias,
            "followed": self.followed,
            "in_motion": self.in_motion,
            "known": self.known,
            "declared": {"faulty": self.faulty, "ambiguous": self.ambiguous},
        }


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
        self.left = False
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
            refusal = self._take_over(json.loads(own_file.read(self.path, LONGEST).decode()), pipeline)
        except FileNotFoundError:
            self.left = False
            self.words = f"no state taken from {self.path}: there is none yet"
            return False
        except own_file.DistrustError as error:
            refusal = str(error.strerror)
        except OSError as error:
            refusal = f"cannot be read: {error.strerror}"
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
            refusal = "damaged"
        self.left = bool(refusal)
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
            with own_file.open_regular(path) as file:
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
            with own_file.replacing(self.path) as file:
                file.write(json.dumps({**about, **state.as_json()}, indent=1).encode())
                if self.left:
                    with contextlib.suppress(FileNotFoundError):
                        self.path.replace(self._old)
                    self.left = False
        except OSError as error:
            self.words, self.failed = f"state cannot be saved to {self.path}: {error.strerror}", True
            self._not_before = time.monotonic() + RETRY
        else:
            self._kept, self.failed = state, False
            self.words = f"state saved to {self.path}"
        return True

    def _take_over(self, saved: Any, pipeline: Pipeline) -> str:
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
        core, names = pipeline.core[0], pipeline.channel_names
        state = _parsed(saved, names, float(core["settings"]["tracking"]["limit"]))
        if state is None:
            return "damaged"
        _restore(core, names, state, age)
        restored = [f"{name} FAULTY" for name in state.faulty] + [f"{name} AMBIGUOUS" for name in state.ambiguous]
        what = ", ".join(["biases", *restored] if state.bias is not None else restored) or "nothing to restore"
        self.words = f"state of {age:.0f} s ago taken from {self.path}: {what}"
        self._kept = _state_of(pipeline)
        return ""


def _parsed(saved: Any, names: Sequence[str], limit: float) -> SavedState | None:
    """State from what a file holds; None, or one of the errors that `StateFile.restore` catches, if it is damaged."""
    faulty, ambiguous, known = dict(saved["declared"]["faulty"]), list(saved["declared"]["ambiguous"]), saved["known"]
    sane = faulty.keys().isdisjoint(ambiguous) and {*faulty, *ambiguous, *known}.issubset(names)
    if not sane or not all(why and why in WHY for why in faulty.values()):
        return None
    if saved["bias"] is None:
        return SavedState(None, None, False, list(known), faulty, ambiguous)
    values = np.array([saved["bias"][name] for name in names])
    pairs = np.array([saved["followed"][name] for name in names])
    if values.dtype != np.float64 or pairs.dtype != np.float64 or pairs.shape != (len(names), 2):
        return None
    # NaN and infinity fail these as well.
    small = bool((np.abs(values) <= LARGEST_BIAS).all() and (np.abs(pairs[:, 0]) <= limit).all())
    if not small or not ((pairs[:, 1] >= 0) & np.isfinite(pairs[:, 1])).all():
        return None
    bias = dict(zip(names, values.tolist(), strict=True))
    followed = {name: (value, std) for name, (value, std) in zip(names, pairs.tolist(), strict=True)}
    return SavedState(bias, followed, saved["in_motion"] is True, list(known), faulty, ambiguous)


def _restore(core: Any, names: Sequence[str], state: SavedState, age: float) -> None:
    """Write a state that is so many seconds old into the record of a monitor."""
    number = {name: i for i, name in enumerate(names)}
    if state.bias is not None and state.followed is not None:
        own = core["bias"]
        own["value"][: len(names)] = [state.bias[name] for name in names]
        own["known"], own["learning"] = mask_of(number[name] for name in state.known), False
        own["outcome"] = IN_MOTION if state.in_motion else RESTORED
        _go_on_following(core, np.array([state.followed[name] for name in names]).T, age)
    core["decision"]["faulty"] = mask_of(number[name] for name in state.faulty)
    core["decision"]["ambiguous"] = mask_of(number[name] for name in state.ambiguous)
    for name, why in state.faulty.items():
        core["decision"]["why"][number[name]] = WHY.index(why)


def _go_on_following(core: Any, followed: NDArray[np.float64], age: float) -> None:
    """Follow the biases from where they were, known as well as their walk since then leaves them."""
    settings, n = core["settings"]["tracking"], followed.shape[1]
    variance = followed[1] ** 2 + settings["walk"][:n] ** 2 * age
    core["tracking"]["value"][:n], core["tracking"]["variance"][:n] = followed[0], variance
    core["known"]["bias_std"][:n] = np.sqrt(variance)
    if core["bias"]["outcome"] == IN_MOTION:
        core["remaining"][:n] = settings["turn_on"]
        core["tracking"]["unseen"][:n] = settings["turn_on"] ** 2


def _changed(state: SavedState, kept: SavedState | None) -> bool:
    """Whether a state is to be saved: followed biases always change a little."""
    if kept is None or replace(state, followed=None) != replace(kept, followed=None):
        return True
    if state.followed is None or kept.followed is None:
        return state.followed is not kept.followed
    pairs = zip(state.followed.values(), kept.followed.values(), strict=True)
    return any(abs(now - then) > MOVED * std or then_std > MOVED * std for (now, std), (then, then_std) in pairs)


def _state_of(pipeline: Pipeline) -> SavedState:
    """Return what is kept: biases, unless they are being learned, and what is declared and why."""
    core, names = pipeline.core[0], pipeline.channel_names
    bias, decision, tracking, n = core["bias"], core["decision"], core["tracking"], len(names)
    faulty, ambiguous, known = int(decision["faulty"]), int(decision["ambiguous"]), int(bias["known"])
    values, stds = tracking["value"][:n].tolist(), np.sqrt(tracking["variance"][:n]).tolist()
    return SavedState(
        bias=None if bias["learning"] else dict(zip(names, bias["value"][:n].tolist(), strict=True)),
        followed=None if bias["learning"] else dict(zip(names, zip(values, stds, strict=True), strict=True)),
        in_motion=bool(bias["outcome"] == IN_MOTION),
        known=[name for i, name in enumerate(names) if is_in(i, known)],
        faulty={name: WHY[decision["why"][i]] for i, name in enumerate(names) if is_in(i, faulty)},
        ambiguous=[name for i, name in enumerate(names) if is_in(i, ambiguous)],
    )
