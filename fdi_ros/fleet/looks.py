# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which flights of a fleet a person should look at, and why."""

from __future__ import annotations

import math
import re
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
MOST_TOLD = 3
"""Episodes that are told of a flight; the table has all."""
MOST_NAMES = 4
"""Channels that are named; more are counted."""
_LOST = ("FAULTY", "AMBIGUOUS", "STALE", "UNCHECKED")


@dataclass(frozen=True)
class Reason:
    """Why a person should look at a flight."""

    score: float
    kind: str
    """What flights of like reasons are counted by."""
    words: str


@dataclass(frozen=True)
class Look:
    """One flight that a person should look at."""

    row: Row
    reasons: tuple[Reason, ...]
    """The most worrying first."""

    @property
    def score(self) -> float:
        """How worrying it is."""
        return sum(reason.score for reason in self.reasons)

    @property
    def why(self) -> tuple[str, ...]:
        """The reasons in words."""
        return tuple(reason.words for reason in self.reasons)


@dataclass(frozen=True)
class NotJudged:
    """Recordings that could not be judged for one reason."""

    why: str
    paths: tuple[str, ...]


DECLARED = "a gyro was declared faulty, or one of a set"
"""Kind of the reasons that `fdi_ros.fleet.report` tells episode by episode."""


def to_look_at(flights: Sequence[Row], channels: Sequence[ChannelLine]) -> list[Look]:
    """Flights that were judged, with something to look at, the most worrying first."""
    judged = good(flights)
    usual = _shares(judged)
    own = {(line.vehicle, line.channel): line for line in channels}
    looks = [_look(row, usual, own) for row in judged]
    return sorted((look for look in looks if look.reasons), key=lambda look: (-look.score, look.row["path"]))


def not_judged(flights: Sequence[Row]) -> list[NotJudged]:
    """Return the recordings that could not be judged, alike reasons together, those of most recordings first."""
    alike: dict[str, list[tuple[str, str]]] = {}
    for row in flights:
        if row["error"]:
            words = row["error"].replace(row["path"], "").replace(row["path"].rpartition("/")[2], "").strip(" :")
            # What differs in figures alone, or in what is there where the same is needed, is one reason.
            needed = words[words.find("; needed:") :] if "; needed:" in words else words
            alike.setdefault(re.sub(r"[0-9]+(\.[0-9]+)?", "#", needed), []).append((row["path"], words))
    found = [NotJudged(own[0][1], tuple(path for path, _ in own)) for own in alike.values()]
    return sorted(found, key=lambda one: (-len(one.paths), one.why))


def reasons(looks: Sequence[Look]) -> list[tuple[str, list[Row]]]:
    """Kinds of reasons and the flights that have each, the most worrying first."""
    found: dict[str, tuple[float, list[Row]]] = {}
    for look in looks:
        for reason in look.reasons:
            score, rows = found.setdefault(reason.kind, (reason.score, []))
            found[reason.kind] = max(score, reason.score), rows if look.row in rows else [*rows, look.row]
    return [(kind, rows) for kind, (_, rows) in sorted(found.items(), key=lambda one: -one[1][0])]


def _look(row: Row, usual: Mapping[tuple[str, ...], float], channels: Mapping[tuple[str, str], ChannelLine]) -> Look:
    found = [*_judgement(row), *_recording(row)]
    found += [
        Reason(20.0, "a unit is noisier than usual, or repeats itself", one) for one in _units_of_note(row, usual)
    ]
    found += [Reason(20.0, "a bias is not that of the other flights", one) for one in _moved(row, channels)]
    return Look(row, tuple(sorted(found, key=lambda one: -one.score)))


def _judgement(row: Row) -> list[Reason]:
    """Return what the monitor found worth a look."""
    alone, sets = row["declared"] - row["sets"], row["sets"]
    lost = _lost(row)
    note = f": {row['note']}" if row["note"] else ""
    close = row["largest"] is not None and row["largest"] > CLOSE and not row["declared"]
    foreign = row["calibration"].startswith("on ") and row["calibration"] != "on itself"
    foreign = foreign and row["calibration"].removeprefix("on ") != row["path"].rpartition("/")[2]
    wrong, count = "settings may be wrong", len(row["happened"]) - MOST_TOLD
    told = "; ".join([*row["happened"][:MOST_TOLD], *([f"and {count} more"] if count > 0 else [])])
    words = f"{alone} channel{'s' * (alone > 1)} declared faulty" if alone else "one of a set declared faulty"
    every = (
        (row["declared"], (100.0 + alone) * bool(alone) + 80.0 * bool(sets), DECLARED, told or words),
        (lost, 70.0, "a channel does not end in state OK", f"at the end: {lost}{note}"),
        (
            row["judged"] < MOSTLY,
            40.0,
            "much was not judged",
            f"{row['judged']:.1%} of the samples judged{'' if lost else note}",
        ),
        (row["degraded"], 30.0, "noise, delay or drift beyond the settings", row["degraded"]),
        (
            close,
            10.0 * min(row["largest"] or 0.0, 3.0),
            "the statistic came close to its threshold",
            f"statistic up to {row['largest'] or 0.0:.2f} of its threshold",
        ),
        (
            row["declared"] and not row["measured"],
            0.0,
            wrong,
            "or the settings are wrong: mounts and axes were not measured (--config, --calibrate)",
        ),
        (
            row["declared"] and foreign,
            0.0,
            wrong,
            f"or it is another vehicle than that calibrated {row['calibration']}",
        ),
    )
    return [Reason(score, kind, words) for holds, score, kind, words in every if holds]


def _lost(row: Row) -> str:
    """Channels that end in a state that is not a healthy one, alike ones together, and why; not what was declared."""
    alike: dict[str, list[str]] = {}
    every = zip(row["channels"], row["state"], row["reason"], strict=True)
    lost = _LOST[2:] if row["declared"] else _LOST
    for name, state, reason in sorted((one for one in every if one[1] in lost), key=lambda one: _LOST.index(one[1])):
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


def _recording(row: Row) -> list[Reason]:
    """Return what is wrong with the recording or its settings."""
    gap = row["longest_gap"] or 0.0
    gaps = f"{row['gaps']} gap{'s' * (row['gaps'] != 1)}, up to {gap:.1f} s"
    every = (
        (row["calibration"].startswith("refused"), 20.0, "calibration refused", f"calibration {row['calibration']}"),
        (gap > LONG_GAP, 15.0, "gaps in the recording", gaps),
        (row["doubts"], 10.0, "settings do not fit the recording", row["doubts"]),
        (row["malformed"], 10.0, "malformed messages", f"{row['malformed']} malformed messages"),
        (row["damage"], 5.0, "the recording is damaged, or parts of it are left out", row["damage"]),
        (row["not_injected"], 1.0, "faults not injected", f"faults not injected: {row['not_injected']}"),
    )
    return [Reason(score, kind, words) for holds, score, kind, words in every if holds]


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
    return f"fdi replay {_quoted(row['path'])} --config {_quoted(row['config'])} --report flight.html"


def _quoted(path: str) -> str:
    """Quote a path for a shell, on one line and in characters that can be seen."""
    if path.isprintable():
        return shlex.quote(path)
    escaped = "".join(f"\\U{ord(c):08x}" if not c.isprintable() else f"\\{c}" if c in "\\'" else c for c in path)
    # Of bash and zsh.
    return f"$'{escaped}'"
