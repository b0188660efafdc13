# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which flights of a fleet a person should look at, and why."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fdi_ros.fleet.lines import ChannelLine, Row, beside, bias_of, good, median, units_of, worst

OUTLIER = 3.0
"""Noise of a unit beside the others, this many times the usual, is worth a look."""
CLOSE = 0.9
"""So is a statistic that came this close to its threshold."""
MOVED = 1e-5
"""So is a bias that chance would put so far from those of the other flights with less probability (Student)."""
MOSTLY = 0.9
"""So is a flight of which less was judged."""
LONG_GAP = 1.0
"""So is one with a longer time without samples, s."""
MOST_NAMES = 4
"""Channels that are named; more are counted."""
_LOST = ("FAULTY", "AMBIGUOUS", "STALE", "UNCHECKED")


@dataclass(frozen=True)
class Look:
    """One flight that a person should look at."""

    row: Row
    score: float
    why: tuple[str, ...]


def to_look_at(flights: Sequence[Row], channels: Sequence[ChannelLine]) -> list[Look]:
    """Flights with something to look at, the most worrying first."""
    usual = _shares(flights)
    own = {(line.vehicle, line.channel): line for line in channels}
    looks = [_look(row, usual, own) for row in flights]
    return sorted((look for look in looks if look.why), key=lambda look: (-look.score, look.row["path"]))


def _look(row: Row, usual: Mapping[tuple[str, ...], float], channels: Mapping[tuple[str, str], ChannelLine]) -> Look:
    if row["error"]:
        return Look(row, 50.0, (f"not judged: {row['error']}",))
    reasons = [*_judgement(row), *_recording(row)]
    reasons += [(20.0, words) for words in (*_units_of_note(row, usual), *_moved(row, channels))]
    return Look(row, sum(score for score, _ in reasons), tuple(words for _, words in sorted(reasons, reverse=True)))


def _judgement(row: Row) -> list[tuple[float, str]]:
    """Return what the monitor found worth a look: weight and words."""
    alone, sets = row["declared"] - row["sets"], row["sets"]
    lost = _lost(row)
    note = f": {row['note']}" if row["note"] else ""
    close = row["largest"] is not None and row["largest"] > CLOSE and not row["declared"]
    foreign = row["calibration"].startswith("on ") and row["calibration"] != "on itself"
    every = (
        (alone, 100.0 + alone, f"{alone} channel{'s' * (alone > 1)} declared faulty"),
        (sets, 80.0 + sets, f"one of a set declared faulty, {sets} time{'s' * (sets > 1)}"),
        (lost, 70.0, f"at the end: {lost}{note}"),
        (row["judged"] < MOSTLY, 40.0, f"{row['judged']:.1%} of the samples judged{'' if lost else note}"),
        (row["degraded"], 30.0, row["degraded"]),
        (
            close,
            10.0 * min(row["largest"] or 0.0, 3.0),
            f"statistic up to {row['largest'] or 0.0:.2f} of its threshold",
        ),
        (
            row["declared"] and not row["measured"],
            0.0,
            "or the settings are wrong: mounts and axes were not measured (--config, --calibrate)",
        ),
        (row["declared"] and foreign, 0.0, f"or it is another vehicle than that calibrated {row['calibration']}"),
    )
    return [(score, words) for holds, score, words in every if holds]


def _lost(row: Row) -> str:
    """Channels that end in a state that is not a sound one, alike ones together, and why."""
    alike: dict[str, list[str]] = {}
    every = zip(row["channels"], row["state"], row["reason"], strict=True)
    for name, state, reason in sorted((one for one in every if one[1] in _LOST), key=lambda one: _LOST.index(one[1])):
        alike.setdefault(f"{state} ({reason})" if reason else state, []).append(name)
    count = len(row["channels"])
    words = [
        f"{', '.join(names) if len(names) <= MOST_NAMES else f'{len(names)} of {count} channels'} {words}"
        for words, names in alike.items()
    ]
    # Biases that were refused are why channels are not checked.
    unlearned = row["bias_state"].startswith("refused") or "not of" in row["bias_state"]
    why = [f"biases {row['bias_state']}"] if "UNCHECKED" in row["state"] and unlearned else []
    return "; ".join([*words, *why]) if words else ""


def _recording(row: Row) -> list[tuple[float, str]]:
    """Return what is wrong with the recording or its settings: weight and words."""
    gap = row["longest_gap"] or 0.0
    every = (
        (row["calibration"].startswith("refused"), 20.0, f"calibration {row['calibration']}"),
        (gap > LONG_GAP, 15.0, f"{row['gaps']} gap{'s' * (row['gaps'] != 1)}, up to {gap:.1f} s"),
        (row["doubts"], 10.0, row["doubts"]),
        (row["malformed"], 10.0, f"{row['malformed']} malformed messages"),
        (row["damage"], 5.0, f"damaged: {row['damage']}"),
        (row["not_injected"], 1.0, f"faults not injected: {row['not_injected']}"),
    )
    return [(score, words) for holds, score, words in every if holds]


def _shares(flights: Sequence[Row]) -> dict[tuple[str, ...], float]:
    """Return what is usual of each unit beside the same others, by vehicle, unit, kind of noise and all units."""
    found: dict[tuple[str, ...], list[float]] = {}
    for row in good(flights):
        units = units_of(row)
        for unit, own in units.items():
            for name in ("noise_rest", "noise_motion"):
                if math.isfinite(share := beside(row, own, name)):
                    found.setdefault((row["vehicle"], unit, name, *units), []).append(share)
    return {key: median(shares) for key, shares in found.items() if len(shares) > 2}


def _units_of_note(row: Row, usual: Mapping[tuple[str, ...], float]) -> list[str]:
    """Units that are noisier than usual beside the others, or never say anything else."""
    found = []
    units = units_of(row)
    for unit, own in units.items():
        if worst(row["noise_rest"], own) == 0.0:
            found.append(f"{unit}: repeats its values")
        for name, words in (("noise_rest", "noise at rest"), ("noise_motion", "noise in motion")):
            now, before = beside(row, own, name), usual.get((row["vehicle"], unit, name, *units), math.nan)
            if now > OUTLIER * before > 0.0:
                found.append(f"{unit}: {words} {now / before:.1f} times what is usual beside the other units")
    return found


def _moved(row: Row, channels: Mapping[tuple[str, str], ChannelLine]) -> list[str]:
    """Channels whose bias is not what it is in the other flights."""
    from scipy.stats import t as student

    found = []
    for channel, bias in zip(row["channels"], bias_of(row), strict=True):
        line = channels[row["vehicle"], channel]
        others = line.known - 1
        if others < 2 or not math.isfinite(bias):
            continue
        mean = (line.known * line.bias_mean - bias) / others
        squares = line.known * line.bias_std**2 - (bias - line.bias_mean) ** 2 * line.known / others
        std = math.sqrt(max(squares, 0.0) / (others - 1))
        off = abs(bias - mean)
        # Less than the noise of a sample is nothing that a person should look at.
        if off > student.isf(MOVED / 2, others - 1) * std * math.sqrt(1 + 1 / others) and not off < line.noise_rest:
            found.append(f"{channel}: bias {off:.2g} rad/s from that of the other flights")
    return found


def replay_command(row: Row) -> str:
    """Command that shows a flight in detail."""
    if row["error"]:
        return f"fdi inspect {_quoted(row['path'])}"
    return f"fdi replay {_quoted(row['path'])} --config {_quoted(row['config'])} --report flight.html"


def _quoted(path: str) -> str:
    """Quote a path for a shell, on one line and in characters that can be seen."""
    if path.isprintable():
        return shlex.quote(path)
    escaped = "".join(f"\\U{ord(c):08x}" if not c.isprintable() else f"\\{c}" if c in "\\'" else c for c in path)
    # Of bash and zsh.
    return f"$'{escaped}'"
