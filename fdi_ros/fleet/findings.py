# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the rows of a fleet say: units and channels over their flights, which flights to look at, and the whole."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.replay.outcomes import Estimate, OutcomeKind, share
from fdi_ros.report.layout import first_of
from fdi_ros.setup.blocks import MEDIAN_TO_RMS

Row = Mapping[str, Any]
"""Columns of `fdi_ros.fleet.flights` by name."""

LATE = 1e-3
"""Stamps that late, s, are said where that is certain."""
FEW, UNLIKELY = 5, 0.02
"""A drift is told where so many flights show it, and chance would give one in a whole fleet with less probability."""
_GIVEN = "fixed"
_NOT_LEARNED = (_GIVEN, "zero", "refused", "learning")
"""How the state of biases begins that say nothing of the gyros."""


class Fleet:
    """All that is found in the rows of some flights: once, for the page, the terminal and the figures.

    Parameters
    ----------
    flights, episodes, events, faults
        Rows of the tables.
    """

    def __init__(
        self,
        flights: Sequence[Row],
        episodes: Sequence[Row] = (),
        events: Sequence[Row] = (),
        faults: Sequence[Row] = (),
    ) -> None:
        judged = [row for row in flights if not row["error"]]
        self.flights, self.judged = in_order(flights), in_order(judged)
        """All, and those that could be judged, by vehicle and date."""
        self.episodes, self.faults = episodes, faults
        self.units = _lines(self.judged, events, units=True)
        self.channels = _lines(self.judged, events, units=False)
        self.looks = to_look_at(judged, self.channels)
        self.not_judged = not_judged(flights)
        self.names = short_names(row["vehicle"] for row in self.flights)
        """What each vehicle is called."""
        self.failed = len(flights) - len(judged)
        """Flights that could not be judged."""
        self.hours = sum(row["judged_time"] for row in judged) / 3600.0
        """Judged."""
        self.declarations = Rate(sum(row["episodes"] for row in judged), sum(row["watched"] for row in judged) / 3600.0)
        """Episodes (a set, and then the name of the channel, are one), in the time that nothing stood declared."""
        self.declaring = sum(row["declared"] > 0 for row in judged)
        """Flights in which something was declared."""
        self.unmeasured = sum(not row["measured"] for row in judged)
        """Flights of which mounts and axes are what `fdi inspect` assumes."""


@dataclass(frozen=True)
class Rate:
    """Events per hour, with the exact 95 % interval of a Poisson process (Garwood 1936)."""

    count: int
    hours: float

    @property
    def value(self) -> float:
        """Per hour; NaN of no time."""
        return self.count / self.hours if self.hours > 0 else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Per hour."""
        from scipy.stats import chi2

        if not self.hours > 0:
            return 0.0, math.inf
        low = float(chi2.ppf(0.025, 2 * self.count)) / 2 if self.count else 0.0
        return low / self.hours, float(chi2.ppf(0.975, 2 * self.count + 2)) / 2 / self.hours

    def __str__(self) -> str:
        if not self.hours > 0:
            return "nothing was judged"
        low, high = self.interval
        return f"{self.value:.3g} per hour (95 %: {low:.2g} to {high:.2g})"


def in_order(flights: Sequence[Row]) -> list[Row]:
    """Sort flights by vehicle and date; one without a date follows the one before it in the order of file names."""
    keys: dict[str, tuple[str, int, int]] = {}
    last: dict[str, int] = {}
    for number, row in enumerate(sorted(flights, key=lambda row: _natural(row["path"]))):
        if row["date"]:
            last[row["vehicle"]] = row["start"]
        # Among those of one date, the dated one is the first.
        keys[row["flight"]] = row["vehicle"], last.get(row["vehicle"], -1), number if not row["date"] else -1
    return sorted(flights, key=lambda row: (keys[row["flight"]], row["path"]))


def _natural(path: str) -> list[tuple[int, str]]:
    """Key that sorts names with numbers as a person would: 9 comes before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", path)]


def short_names(vehicles: Iterable[str]) -> dict[str, str]:
    """Return the shortest end of the path of each vehicle that no other has."""
    paths, found = list(dict.fromkeys(vehicles)), {}
    for path in paths:
        parts = path.strip("/").split("/")
        ends = ("/".join(parts[-k:]) for k in range(1, len(parts) + 1))
        others = [f"/{other.strip('/')}" for other in paths if other != path]
        found[path] = next((end for end in ends if not any(one.endswith(f"/{end}") for one in others)), path)
    return found


def unit_of(channel: str) -> str:
    """Name of the unit of a channel, as its name says."""
    return channel.rpartition(".")[0] or channel


def grouped(row: Row, name_of: Callable[[str], str] = unit_of) -> dict[str, list[int]]:
    """Channels of each unit, or by another name."""
    groups: dict[str, list[int]] = {}
    for k, channel in enumerate(row["channels"]):
        groups.setdefault(name_of(channel), []).append(k)
    return groups


# Units and channels over their flights -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A unit, or a channel, of one vehicle over its flights; medians over flights, of a flight the worst channel."""

    vehicle: str
    name: str
    flights: int
    noise_rest: float
    """rad/s."""
    noise_motion: float
    vibration: float
    largest_bias: float
    biases: NDArray[np.float64]
    """Of a channel: those that are known, rad/s."""
    bias_spread: float
    """Largest difference of one channel's bias between two flights, rad/s."""
    drift: float
    """Of a channel: what its bias has changed by from the first flight to the last, steadily, rad/s; NaN: not."""
    late: float
    """Of a unit: certain delay of largest size, s; NaN: none is."""
    suspected: int
    declared: int
    """Times that it, or a channel of it, was declared, or was in a set that was."""


def _lines(flights: Sequence[Row], events: Sequence[Row], units: bool) -> list[Line]:
    """One line per vehicle and unit, or channel, in their order."""
    name_of: Callable[[str], str] = unit_of if units else str
    groups: dict[tuple[str, str], list[tuple[Row, list[int]]]] = {}
    for row in flights:
        for name, own in grouped(row, name_of).items():
            groups.setdefault((row["vehicle"], name), []).append((row, own))
    told: dict[tuple[str, str], list[Row]] = {}
    for event in events:
        told.setdefault((event["vehicle"], name_of(event["channel"])), []).append(event)
    # So often over all channels, not for each of them.
    unlikely = 0.0 if units else UNLIKELY / max(len(groups), 1)
    return [_line(key, rows, told.get(key, ()), unlikely) for key, rows in sorted(groups.items())]


def _line(key: tuple[str, str], rows: Sequence[tuple[Row, list[int]]], events: Sequence[Row], unlikely: float) -> Line:
    """Sum up a unit, or a channel, of which a drift that chance gives with less probability than this is told."""
    noise_rest, noise_motion, vibration = (
        median([worst(row[name], own) for row, own in rows]) for name in ("noise_rest", "noise_motion", "vibration")
    )
    every = [bias_of(row)[own] for row, own in rows]
    same = len({len(one) for one in every}) == 1
    known = np.concatenate(every)
    known = known[np.isfinite(known)]
    return Line(
        *key,
        len(rows),
        noise_rest,
        noise_motion,
        vibration,
        largest_bias=worst(np.abs(known), range(len(known))),
        biases=known,
        bias_spread=max((_spread(one) for one in np.array(every).T), key=_or_zero) if same else math.nan,
        drift=_drift(known, noise_rest, unlikely) if unlikely else math.nan,
        late=max((late for row, _ in rows if (late := delay_of(row, key[1])) is not None), key=abs, default=math.nan),
        suspected=sum(event["after"] == "SUSPECT" for event in events),
        declared=len({(event["flight"], event["stamp"]) for event in events if event["declares"]}),
    )


def _drift(bias: NDArray[np.float64], noise: float, unlikely: float) -> float:
    """Steady change of a bias (k,) from the first of k flights to the last; NaN: there is none that is plain.

    Theil and Sen's slope, where Kendall's test says that there is one, and it is more than the noise of a sample and
    three times what the flights scatter by.
    """
    if len(bias) < FEW:
        return math.nan
    from scipy.stats import kendalltau, theilslopes

    number = np.arange(len(bias))
    if not kendalltau(number, bias).pvalue < unlikely:
        return math.nan
    slope, intercept, _, _ = theilslopes(bias, number)
    change = float(slope) * (len(bias) - 1)
    scatter = MEDIAN_TO_RMS * float(np.median(np.abs(bias - intercept - slope * number)))
    return change if abs(change) > max(3 * scatter, _or_zero(noise)) else math.nan


def bias_of(row: Row) -> NDArray[np.float64]:
    """Biases (n,) of a flight, rad/s: as learned or followed, else the mean at the quietest, else as given; or NaN."""
    bias, mean = (np.array(row[name], dtype=np.float64) for name in ("bias", "mean_rest"))
    if row["bias_state"].startswith(_NOT_LEARNED):
        given = bias if row["bias_state"].startswith(_GIVEN) else np.full(len(bias), np.nan)
        return np.where(np.isfinite(mean), mean, given)
    return np.where(np.isfinite(bias), bias, mean)


def beside(row: Row, own: Sequence[int], name: str) -> float:
    """Noise of a unit as a share of that of the other units, which fly through the same vibration."""
    others = [value for k, value in enumerate(row[name]) if k not in own and value]
    return worst(row[name], own) / float(np.median(others)) if others else math.nan


def delay_of(row: Row, unit: str) -> float | None:
    """Delay of the stamps of a unit in a flight, s; None: there is none for certain."""
    if unit not in row["units"] or not row["delay"]:
        return None
    k = row["units"].index(unit)
    value, std = row["delay"][k], row["delay_std"][k]
    return value if value is not None and abs(value) > max(LATE, 4 * (std or math.inf)) else None


def worst(values: Sequence[float] | Any, own: Sequence[int] | range) -> float:
    """Return the largest of some of the values, as far as they are known; NaN: none is."""
    known = [values[k] for k in own if values[k] is not None and math.isfinite(values[k])]
    return max(known, default=math.nan)


def median(values: Sequence[float]) -> float:
    """Return the median of the values that are known; NaN: none is."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


def _spread(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else math.nan


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


# Flights to look at --------------------------------------------------------------------------------------------------


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


class Reason(NamedTuple):
    """Why a person should look at a flight."""

    score: float
    kind: str
    """What flights of like reasons are counted by."""
    words: str


class Look(NamedTuple):
    """One flight that a person should look at."""

    row: Row
    reasons: Sequence[Reason]
    """The most worrying first."""

    @property
    def why(self) -> tuple[str, ...]:
        """The reasons in words."""
        return tuple(reason.words for reason in self.reasons)


def to_look_at(flights: Sequence[Row], channels: Sequence[Line]) -> list[Look]:
    """Flights that were judged, with something to look at, the most worrying first."""
    usual = _shares(flights)
    lines = {(line.vehicle, line.name): line for line in channels}
    looks = []
    for row in flights:
        found = [*_judgement(row), *_units_of_note(row, usual), *_moved(row, lines)]
        looks.append(Look(row, sorted(found, key=lambda one: -one.score)))
    worrying = [(-sum(reason.score for reason in look.reasons), look) for look in looks if look.reasons]
    return [look for _, look in sorted(worrying, key=lambda one: (one[0], one[1].row["path"]))]


def reasons(looks: Sequence[Look]) -> list[tuple[str, list[Row]]]:
    """Kinds of reasons and the flights that have each, the most worrying first."""
    found: dict[str, tuple[float, list[Row]]] = {}
    for look in looks:
        for reason in look.reasons:
            score, rows = found.setdefault(reason.kind, (reason.score, []))
            found[reason.kind] = max(score, reason.score), rows if look.row in rows else [*rows, look.row]
    return [(kind, rows) for kind, (_, rows) in sorted(found.items(), key=lambda one: -one[1][0])]


def _judgement(row: Row) -> list[Reason]:
    """Return what the monitor found worth a look, and what is wrong with the recording or its settings."""
    alone, sets = row["declared"] - row["sets"], row["sets"]
    lost, wrong, calibration = _lost(row), "settings may be wrong", row["calibration"]
    note = f": {row['note']}" if row["note"] else ""
    largest, gap = row["largest"] or 0.0, row["longest_gap"] or 0.0
    name, told = row["path"].rpartition("/")[2], first_of(row["happened"], MOST_TOLD, "; ", "; and")
    declared = f"{alone} channel{'s' * (alone > 1)} declared faulty" if alone else "one of a set declared faulty"
    judged = f"{row['judged']:.1%} of the samples judged{'' if lost else note}"
    foreign = row["declared"] and calibration.startswith("on ") and calibration not in ("on itself", f"on {name}")
    every = (
        (
            row["declared"],
            (100.0 + alone) * bool(alone) + 80.0 * bool(sets),
            "a gyro was declared faulty, or one of a set",
            told or declared,
        ),
        (lost, 70.0, "a channel does not end in state OK", f"at the end: {lost}{note}"),
        (row["judged"] < MOSTLY, 40.0, "much was not judged", judged),
        (row["degraded"], 30.0, "noise, delay or drift beyond the settings", row["degraded"]),
        (
            largest > CLOSE and not row["declared"],
            10.0 * min(largest, 3.0),
            "the statistic came close to its threshold",
            f"statistic up to {largest:.2f} of its threshold",
        ),
        (
            row["declared"] and not row["measured"],
            0.0,
            wrong,
            "or the settings are wrong: mounts and axes were not measured (--config, --calibrate)",
        ),
        (foreign, 0.0, wrong, f"or it is another vehicle than that calibrated {calibration}"),
        (calibration.startswith("refused"), 20.0, "calibration refused", f"calibration {calibration}"),
        (
            gap > LONG_GAP,
            15.0,
            "gaps in the recording",
            f"{row['gaps']} gap{'s' * (row['gaps'] != 1)}, up to {gap:.1f} s",
        ),
        (row["doubts"], 10.0, "settings do not fit the recording", row["doubts"]),
        (row["malformed"], 10.0, "malformed messages", f"{row['malformed']} malformed messages"),
        (row["damage"], 5.0, "the recording is damaged, or parts of it are left out", row["damage"]),
        (row["not_injected"], 1.0, "faults not injected", f"faults not injected: {row['not_injected']}"),
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


def _shares(flights: Sequence[Row]) -> dict[tuple[str, ...], float]:
    """Return what is usual of each unit beside the same others, by vehicle, unit, kind of noise and all units."""
    found: dict[tuple[str, ...], list[float]] = {}
    for row in flights:
        units = grouped(row)
        for unit, own in units.items():
            for name in ("noise_rest", "noise_motion"):
                if math.isfinite(share := beside(row, own, name)):
                    found.setdefault((row["vehicle"], unit, name, *units), []).append(share)
    return {key: median(shares) for key, shares in found.items() if len(shares) > 2}


def _units_of_note(row: Row, usual: Mapping[tuple[str, ...], float]) -> Iterator[Reason]:
    """Find units that are noisier than usual beside the others, or never say anything else."""
    units, kind = grouped(row), "a unit is noisier than usual, or repeats itself"
    for unit, own in units.items():
        if worst(row["noise_rest"], own) == 0.0:
            yield Reason(20.0, kind, f"{unit}: repeats its values")
        for name, words in (("noise_rest", "noise at rest"), ("noise_motion", "noise in motion")):
            now, before = beside(row, own, name), usual.get((row["vehicle"], unit, name, *units), math.nan)
            if now > OUTLIER * before > 0.0:
                times = f"{now / before:.1f} times what is usual beside the other units"
                yield Reason(20.0, kind, f"{unit}: {words} {times}")


def _moved(row: Row, lines: Mapping[tuple[str, str], Line]) -> Iterator[Reason]:
    """Find channels whose bias is not what it is in the other flights."""
    from scipy.stats import t as student

    for channel, bias in zip(row["channels"], bias_of(row), strict=True):
        line = lines[row["vehicle"], channel]
        known, others = len(line.biases), len(line.biases) - 1
        if others < 2 or not math.isfinite(bias):
            continue
        mean, std = float(line.biases.mean()), float(line.biases.std())
        off = abs(bias - (known * mean - bias) / others)
        squares = known * std**2 - (bias - mean) ** 2 * known / others
        std = math.sqrt(max(squares, 0.0) / (others - 1))
        # Less than the noise of a sample is nothing that a person should look at.
        if off > student.isf(MOVED / 2, others - 1) * std * math.sqrt(1 + 1 / others) and not off < line.noise_rest:
            words = f"{channel}: bias {off:.2g} rad/s from that of the other flights"
            yield Reason(20.0, "a bias is not that of the other flights", words)


class NotJudged(NamedTuple):
    """Recordings that could not be judged for one reason."""

    why: str
    paths: tuple[str, ...]


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


# Injected faults -----------------------------------------------------------------------------------------------------


WRONG = (OutcomeKind.FALSE_ISOLATION, OutcomeKind.FALSE_GROUP)


def counted(faults: Iterable[Row], *outcomes: str) -> int:
    """Count the faults that had one of these outcomes."""
    return sum(fault["outcome"] in outcomes for fault in faults)


def clustered_share(counts: Sequence[tuple[int, int]]) -> Estimate | None:
    """Share over flights with its 95 % interval; None: one flight says nothing of others.

    Faults in one flight are alike. As many independent ones as give the scatter between the flights take the place of
    all (Rao and Scott 1992) in Wilson's interval, with Student's quantile for that many flights. Where there is no
    scatter, as all or none of the faults are meant, each flight counts as one.

    Parameters
    ----------
    counts
        Of each flight: how many of how many.
    """
    from scipy.stats import t as student

    hits, trials, flights = sum(one[0] for one in counts), sum(one[1] for one in counts), len(counts)
    if flights < 2:
        return None
    p = hits / trials
    scatter = sum((count - p * number) ** 2 for count, number in counts) * flights / (flights - 1) / trials**2
    effect = max(1.0, scatter / (p * (1 - p) / trials)) if 0 < p < 1 else trials / flights
    return share(hits / effect, trials / effect, float(student.isf(0.025, flights - 1)))
