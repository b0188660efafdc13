# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a fleet shows, from the rows of its dataset: rates of declarations, units, and what a person should look at."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.experiments.tally import Estimate, share

Row = Mapping[str, Any]
"""Columns of `fdi_ros.fleet.rows` by name."""

OUTLIER = 3.0
"""Noise of a unit this many times the median of its vehicle's other flights is worth a look."""
CLOSE = 0.9
"""So is a statistic that came this close to its threshold."""
LATE = 1e-3
"""Stamps that late, s, are said where that is certain."""
MOVED = 1e-5
"""So is a bias that chance would put so far from those of the other flights with less probability (Student)."""
FEW, UNLIKELY = 5, 0.02
"""A drift is told where so many flights show it, and chance would give one in a whole fleet with less probability."""
TO_STD = 1.4826
"""From the median deviation to the standard deviation, of a normal distribution."""
MOSTLY = 0.9
"""So is a flight of which less was judged."""
LONG_GAP = 1.0
"""So is one with a longer time without samples, s."""
MOST_NAMES = 4
"""Channels that are named; more are counted."""
GIVEN = "fixed"
_NOT_LEARNED = (GIVEN, "zero", "refused", "learning")
"""How the state of biases begins that say nothing of the gyros."""
_LOST = ("FAULTY", "AMBIGUOUS", "STALE", "UNCHECKED")


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


@dataclass(frozen=True)
class Totals:
    """The whole fleet."""

    flights: int
    failed: int
    vehicles: int
    hours: float
    """Judged."""
    declaring: int
    """Flights in which something was declared."""
    declarations: Rate
    """Episodes (a set, and then the name of the channel, are one), in the time that nothing stood declared."""
    unmeasured: int
    """Flights of which mounts and axes are what `fdi inspect` assumes."""


@dataclass(frozen=True)
class UnitLine:
    """One unit of one vehicle over its flights; medians over flights, of a flight the worst channel."""

    vehicle: str
    unit: str
    flights: int
    noise_rest: float
    """rad/s."""
    noise_motion: float
    vibration: float
    bias: float
    """Largest, rad/s."""
    bias_spread: float
    """Largest difference of one channel's bias between two flights, rad/s."""
    late: float
    """Certain delay of largest size, s; NaN: none is."""
    suspected: int
    declared: int
    """Times that a channel of it was declared, or was in a set that was."""


@dataclass(frozen=True)
class ChannelLine:
    """One channel of one vehicle over its flights; medians over flights."""

    vehicle: str
    channel: str
    flights: int
    noise_rest: float
    """rad/s."""
    noise_motion: float
    bias: float
    bias_spread: float
    """Largest difference of its bias between two flights, rad/s."""
    known: int
    """Flights of which the bias is known."""
    bias_mean: float
    bias_std: float
    """Mean and standard deviation of these, rad/s."""
    drift: float
    """What its bias has changed by from the first flight to the last, steadily, rad/s; NaN: it has not."""
    suspected: int
    declared: int


@dataclass(frozen=True)
class Look:
    """One flight that a person should look at."""

    row: Row
    score: float
    why: tuple[str, ...]


def good(flights: Sequence[Row]) -> list[Row]:
    """Those that could be judged."""
    return [row for row in flights if not row["error"]]


def totals(flights: Sequence[Row]) -> Totals:
    """Sum up."""
    judged = good(flights)
    hours = sum(row["judged_time"] for row in judged) / 3600.0
    return Totals(
        len(flights),
        len(flights) - len(judged),
        len({row["vehicle"] for row in flights}),
        hours,
        sum(row["declared"] > 0 for row in judged),
        Rate(sum(row["episodes"] for row in judged), sum(row["watched"] for row in judged) / 3600.0),
        sum(not row["measured"] for row in judged),
    )


def unit_of(channel: str) -> str:
    """Name of the unit of a channel, as its name says."""
    return channel.rpartition(".")[0] or channel


def unit_lines(flights: Sequence[Row], events: Sequence[Row]) -> list[UnitLine]:
    """One line per vehicle and unit, in their order."""
    groups: dict[tuple[str, str], list[tuple[Row, list[int]]]] = {}
    for row in good(flights):
        units: dict[str, list[int]] = {}
        for k, channel in enumerate(row["channels"]):
            units.setdefault(unit_of(channel), []).append(k)
        for unit, own in units.items():
            groups.setdefault((row["vehicle"], unit), []).append((row, own))
    told: dict[tuple[str, str], list[Row]] = {}
    for event in events:
        told.setdefault((event["vehicle"], unit_of(event["channel"])), []).append(event)
    return [_unit_line(key, rows, told.get(key, ())) for key, rows in sorted(groups.items())]


def _unit_line(key: tuple[str, str], rows: Sequence[tuple[Row, list[int]]], events: Sequence[Row]) -> UnitLine:
    vehicle, unit = key
    bias = [bias_of(row)[own] for row, own in rows]
    same = len({len(one) for one in bias}) == 1
    late = [value for row, _ in rows if (value := delay_of(row, unit)) is not None]
    noise = {
        name: _median([_worst(row[name], own) for row, own in rows])
        for name in ("noise_rest", "noise_motion", "vibration")
    }
    return UnitLine(
        vehicle,
        unit,
        len(rows),
        noise["noise_rest"],
        noise["noise_motion"],
        noise["vibration"],
        max((_worst(np.abs(one), range(len(one))) for one in bias), key=_or_zero),
        max((_spread(one) for one in np.array(bias).T), key=_or_zero) if same else math.nan,
        max(late, key=abs, default=math.nan),
        sum(event["after"] == "SUSPECT" for event in events),
        len({(event["flight"], event["stamp"]) for event in events if event["declares"]}),
    )


def bias_of(row: Row) -> NDArray[np.float64]:
    """Biases (n,) of a flight, rad/s: as learned or followed, else the mean at the quietest, else as given; or NaN."""
    bias, mean = (np.array(row[name], dtype=np.float64) for name in ("bias", "mean_rest"))
    if row["bias_state"].startswith(_NOT_LEARNED):
        given = bias if row["bias_state"].startswith(GIVEN) else np.full(len(bias), np.nan)
        return np.where(np.isfinite(mean), mean, given)
    return np.where(np.isfinite(bias), bias, mean)


def units_of(row: Row) -> dict[str, list[int]]:
    """Channels of each unit."""
    units: dict[str, list[int]] = {}
    for k, channel in enumerate(row["channels"]):
        units.setdefault(unit_of(channel), []).append(k)
    return units


def beside(row: Row, own: Sequence[int], name: str) -> float:
    """Noise of a unit as a share of that of the other units, which fly through the same vibration."""
    others = [value for k, value in enumerate(row[name]) if k not in own and value]
    return _worst(row[name], own) / float(np.median(others)) if others else math.nan


def _spread(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else math.nan


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def channel_lines(flights: Sequence[Row], events: Sequence[Row]) -> list[ChannelLine]:
    """One line per vehicle and channel, in their order."""
    groups: dict[tuple[str, str], list[tuple[Row, int]]] = {}
    for row in good(flights):
        for k, channel in enumerate(row["channels"]):
            groups.setdefault((row["vehicle"], channel), []).append((row, k))
    told: dict[tuple[str, str], list[Row]] = {}
    for event in events:
        told.setdefault((event["vehicle"], event["channel"]), []).append(event)
    # So often over all channels, not for each of them.
    unlikely = UNLIKELY / max(len(groups), 1)
    return [_channel_line(key, rows, told.get(key, ()), unlikely) for key, rows in sorted(groups.items())]


def _channel_line(
    key: tuple[str, str], rows: Sequence[tuple[Row, int]], events: Sequence[Row], unlikely: float
) -> ChannelLine:
    rows = sorted(rows, key=lambda one: int(one[0]["start"]))
    bias = np.array([bias_of(row)[k] for row, k in rows])
    bias = bias[np.isfinite(bias)]
    middle, noise = _median(bias.tolist()), _median([_worst(row["noise_rest"], [k]) for row, k in rows])
    return ChannelLine(
        *key,
        len(rows),
        noise,
        _median([_worst(row["noise_motion"], [k]) for row, k in rows]),
        middle,
        _spread(bias),
        len(bias),
        float(bias.mean()) if len(bias) else math.nan,
        float(bias.std()) if len(bias) else math.nan,
        _drift(bias, noise, unlikely),
        sum(event["after"] == "SUSPECT" for event in events),
        sum(event["declares"] for event in events),
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
    scatter = TO_STD * float(np.median(np.abs(bias - intercept - slope * number)))
    return change if abs(change) > max(3 * scatter, _or_zero(noise)) else math.nan


def delay_of(row: Row, unit: str) -> float | None:
    """Delay of the stamps of a unit in a flight, s; None: there is none for certain."""
    if unit not in row["units"] or not row["delay"]:
        return None
    k = row["units"].index(unit)
    value, std = row["delay"][k], row["delay_std"][k]
    return value if value is not None and abs(value) > max(LATE, 4 * (std or math.inf)) else None


def _worst(values: Sequence[float] | Any, own: Sequence[int] | range) -> float:
    known = [values[k] for k in own if values[k] is not None and math.isfinite(values[k])]
    return max(known, default=math.nan)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


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
    return {key: _median(shares) for key, shares in found.items() if len(shares) > 2}


def _units_of_note(row: Row, usual: Mapping[tuple[str, ...], float]) -> list[str]:
    """Units that are noisier than usual beside the others, or never say anything else."""
    found = []
    units = units_of(row)
    for unit, own in units.items():
        if _worst(row["noise_rest"], own) == 0.0:
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


def fleet_figures(whole: Totals, looks: Sequence[Look], unread: Sequence[str]) -> dict[str, Any]:
    """Figures of the whole by name, for JSON; rows of flights are in the dataset."""
    rate = whole.declarations
    return {
        "flights": whole.flights,
        "failed": whole.failed,
        "vehicles": whole.vehicles,
        "hours": whole.hours,
        "flights_with_declarations": whole.declaring,
        "unmeasured": whole.unmeasured,
        "declarations": {"count": rate.count, "per_hour": rate.value, "interval": list(rate.interval)},
        "not_searched": list(unread),
        "to_look_at": [{"path": look.row["path"], "why": list(look.why)} for look in looks],
    }


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


FAULT_HEAD = ("fault", "injected", "named", "95 % interval", "in a set", "silent", "wrong", "median delay")


def fault_rows(faults: Sequence[Row]) -> list[tuple[str, ...]]:
    """One row per fault: what came of it over the whole fleet."""
    kinds: dict[tuple[str, float, str], list[Row]] = {}
    for fault in faults:
        kinds.setdefault((fault["kind"], fault["size"] or 0.0, fault["fault"]), []).append(fault)
    rows: list[tuple[str, ...]] = []
    for (_, _, words), own in sorted(kinds.items()):
        count = {outcome: sum(fault["outcome"] == outcome for fault in own) for outcome in OUTCOMES}
        flights: dict[str, list[Row]] = {}
        for fault in own:
            flights.setdefault(fault["flight"], []).append(fault)
        named = clustered_share([(_count(faults, "named"), len(faults)) for faults in flights.values()])
        delays = sorted(fault["named_after"] for fault in own if fault["outcome"] == "named")
        wrong = sum(_count(faults, "wrong", "false set") > 0 for faults in flights.values())
        rows.append(
            (
                words,
                str(len(own)),
                f"{count['named'] / len(own):.1%}",
                "one flight" if named is None else f"{named.low:.1%} to {named.high:.1%}",
                f"{count['in a set'] / len(own):.1%}",
                f"{count['silent'] / len(own):.1%}",
                f"{count['wrong'] + count['false set']}, in {wrong} of {len(flights)} flights",
                f"{delays[len(delays) // 2]:.2f} s" if delays else "-",
            )
        )
    return rows


def _count(faults: Sequence[Row], *outcomes: str) -> int:
    return sum(fault["outcome"] in outcomes for fault in faults)


OUTCOMES = ("named", "in a set", "silent", "false set", "wrong")
