"""A snapshot of the monitor, from its record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bias import FIXED, LEARNED, LEARNING, LEAST_ROWS, RESTORED, TOO_FEW
from fdi_ros.core.health import Condition
from fdi_ros.core.output import REASONS, ChannelState
from fdi_ros.core.record import is_in, mask_of
from fdi_ros.detectors.base import Detector
from fdi_ros.monitor.capability import capability_of
from fdi_ros.monitor.integrity import NO_LEVEL, Integrity
from fdi_ros.monitor.output import ChannelStatus, Status

LOST = (ChannelState.FAULTY, ChannelState.STALE, ChannelState.EXCLUDED)


def status_of(
    core: Any, subsets: NDArray[Any], names: Sequence[str], detector: Detector, integrity: Integrity
) -> Status:
    """Snapshot of a monitor after its last sample.

    Parameters
    ----------
    core
        Record of the monitor.
    subsets
        What every set of channels can do.
    names
        Of the channels.
    detector, integrity
        Of the monitor.
    """
    n, last, begun = len(names), core["last"], bool(core["samples"])
    state = core["state"][:n]
    capability = capability_of(detector, ~np.isin(state, LOST))
    seen = capability.detectable & (state != ChannelState.UNCHECKED)
    well = mask_of(np.flatnonzero((state == ChannelState.OK) | (state == ChannelState.UNCHECKED)))
    valid = begun and bool(last["valid"])
    x, y, z = last["level"].tolist()
    return Status(
        stamp=int(last["stamp"]) if begun else 0,
        samples=int(core["samples"]),
        detector=detector.name,
        channels=tuple(_channel(core, i, names) for i in range(n)),
        statistic=float(last["statistic"]) if begun else math.nan,
        threshold=float(last["threshold"]) if begun else math.nan,
        has_rate=valid,
        can_detect=tuple(names[i] for i in np.flatnonzero(seen).tolist()),
        can_isolate=tuple(names[i] for i in np.flatnonzero(capability.isolable & seen).tolist()),
        bias=tuple(core["bias"]["value"][:n].tolist()),
        bias_state=_bias_words(core["bias"], names),
        note=capability.note,
        protection_level=(x, y, z) if valid else NO_LEVEL,
        protection_level_after_loss=integrity.after_loss(subsets, int(core["fused"]) & well) if valid else NO_LEVEL,
    )


def _channel(core: Any, i: int, names: Sequence[str]) -> ChannelStatus:
    health, state = core["health"], ChannelState(core["state"][i])
    count, begun = health["counts"][:, i], bool(core["samples"])
    group = int(core["group"]) if state == ChannelState.AMBIGUOUS else 0
    return ChannelStatus(
        name=names[i],
        state=state,
        reason=REASONS[core["reason"][i]],
        since=int(core["since"][i]),
        group=tuple(name for j, name in enumerate(names) if is_in(j, group)),
        error=float(core["error"][i]),
        residual=float(core["last"]["residual"][i]) if begun else math.nan,
        last_received=int(health["received_stamp"][i]) if health["samples"][i] else 0,
        samples=int(health["samples"][i]),
        non_finite=int(count[Condition.NON_FINITE] + count[Condition.NON_FINITE_LASTING]),
        out_of_range=int(count[Condition.OUT_OF_RANGE]),
        stuck=int(health["stuck"][i] + count[Condition.FROZEN]),
        missing=int(count[Condition.MISSING] + count[Condition.SILENT]),
    )


def _bias_words(bias: Any, names: Sequence[str]) -> str:
    """Say where the biases come from, or why a time was refused as rest."""
    outcome = bias["outcome"]
    if outcome == FIXED:
        return "fixed" if bias["given"] else "zero"
    if outcome == LEARNING:
        return "learning"
    if outcome in (LEARNED, RESTORED):
        words = "learned" if outcome == LEARNED else "restored from the state file"
        missed = [name for i, name in enumerate(names) if not is_in(i, int(bias["known"]))]
        return f"{words}, but not of {', '.join(missed)}" if missed else words
    if outcome == TOO_FEW:
        heard = int(bias["heard"]).bit_count()
        return f"refused: {heard} channels gave {bias['rows']} samples, expected 3 and {LEAST_ROWS} at least"
    mean, std, max_std = bias["average"], bias["scatter"], bias["max_std"]
    excess = [
        abs(mean[i]) / bias["max_rate"] + std[i] / max_std[i] if is_in(i, int(bias["restless"])) else 0.0
        for i in range(len(names))
    ]
    worst = int(np.argmax(excess))
    return (
        f"refused, not at rest: {names[worst]} had mean {mean[worst]:.3g} rad/s (at most {bias['max_rate']:g})"
        f" and standard deviation {std[worst]:.3g} rad/s (at most {max_std[worst]:.3g})"
    )
