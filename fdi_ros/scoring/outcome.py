# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What came of one injected fault: isolated, in an ambiguity group, missed, or answered by a false one."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from fdi_ros.arrays import Array, Mask
from fdi_ros.core.states import ChannelState
from fdi_ros.monitor.output import Output

ALONE = (ChannelState.FAULTY, ChannelState.STALE)
"""States by which a channel is declared by itself."""


class Outcome(str, Enum):
    """What came of one injected fault; the values are the words of the files that hold outcomes."""

    ISOLATED = "named"
    """The faulty channel was declared by itself."""
    AMBIGUOUS = "in a set"
    """It was one of an ambiguity group, and not declared by itself."""
    MISSED = "silent"
    """Nothing was declared."""
    FALSE_GROUP = "false set"
    """Only groups without it were declared."""
    FALSE_ISOLATION = "wrong"
    """A healthy channel was declared by itself."""


class Scored(NamedTuple):
    """What came of one fault, and when."""

    outcome: Outcome
    isolated_after: float
    """Until the channel was declared by itself, s; inf: it was not."""
    detected_after: float
    """Until it was declared by itself or in a group, s; inf: it was not."""


def standing(output: Output) -> tuple[Mask, Mask]:
    """(N, n) whether a channel stands declared by itself, or silent; and whether it stands in an ambiguity group."""
    return np.isin(output.state, ALONE), np.asarray(output.state == ChannelState.AMBIGUOUS)


def score(alone: Mask, among: Mask, channel: int | None, since: Array, within: float = np.inf) -> Scored:
    """Say what came of a fault.

    Parameters
    ----------
    alone, among
        (N, n) as of `standing`.
    channel
        That is faulty; None: none is.
    since
        (N,) s from the start of the fault.
    within
        A fault is isolated, or in a group, if it is by then, s; a false isolation counts at any time.
    """
    if channel is None:
        isolated = detected = np.inf
        own = np.zeros(len(since), dtype=bool)
    else:
        own = among[:, channel]
        isolated, detected = _first(alone[:, channel], since), _first(alone[:, channel] | own, since)
    soon = since <= within
    others = alone if channel is None else np.delete(alone, channel, axis=1)
    if others.any():
        outcome = Outcome.FALSE_ISOLATION
    elif isolated <= within and channel is not None and alone[:, channel].any():
        outcome = Outcome.ISOLATED
    elif own[soon].any():
        outcome = Outcome.AMBIGUOUS
    else:
        outcome = Outcome.FALSE_GROUP if among[soon].any() else Outcome.MISSED
    return Scored(outcome, isolated, detected)


def _first(declared: Mask, since: Array) -> float:
    return float(since[declared.argmax()]) if declared.any() else np.inf
