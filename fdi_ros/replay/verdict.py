"""What came out, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

RATE_TOLERANCE = 0.1
"""Share by which the rate of a recording may differ from the configured one."""
_UNCHECKED = ("STALE", "UNCHECKED")
"""States of a channel that nothing checks, and that no fault was declared of."""


def verdict(summary: Mapping[str, Any]) -> list[str]:
    """Return the sentences that stand at the top of a report.

    Parameters
    ----------
    summary
        Of a replay.
    """
    return [*_checked(summary), *_ending(summary), *_injected(summary["faults"]), *_declared(summary)]


def unchecked(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the channels that end without being checked, but for those that a fault is injected into up to the end."""
    ends = summary["start_s"] + summary["duration_s"]
    struck = {
        name
        for fault in summary["faults"]
        for name in fault["channels"]
        if fault["stop_s"] is None or fault["stop_s"] >= ends
    }
    return [one for one in summary["channels"] if one["state"] in _UNCHECKED and one["name"] not in struck]


def unchecked_words(channels: Sequence[Mapping[str, Any]]) -> str:
    """Say which channels end how, from when on and why."""
    alike: dict[str, list[str]] = {}
    for one in channels:
        since = "from the start" if one["since_s"] is None else f"from {one['since_s']:.3f} s on"
        why = f" ({one['reason']})" if one["reason"] else ""
        alike.setdefault(f"{one['state']} {since}{why}", []).append(one["name"])
    return "; ".join(f"{', '.join(names)} {words}" for words, names in alike.items())


def notes(summary: Mapping[str, Any]) -> list[str]:
    """Return what else a reader must know: damage, what was left out, what the monitor could not do."""
    lines = [f"damaged recording: {line}" for line in summary["damage"]]
    lines += sample_rate_notes(**summary["sample_rate"])
    lines += [f"{count} malformed messages on {topic}" for topic, count in summary["malformed"].items() if count]
    if summary["disordered"]:
        lines.append(f"{summary['disordered']} messages left out: recorded after later ones")
    for topic, counters in summary["alignment"].items():
        odd = ", ".join(f"{count} {name}" for name, count in counters.items() if count and name != "received")
        lines += [f"{topic}: {odd}"] if odd else []
    missing = summary["samples"] - summary["samples_with_rate"]
    if missing:
        lines.append(f"{missing} samples without a fused rate; bias {summary['bias']['state']}")
    return [*lines, summary["note"]] if summary["note"] else lines


def sample_rate_notes(configured_hz: float, recorded_hz: float | None) -> list[str]:
    """Say so where the configured sample rate is not that of the recording."""
    if recorded_hz is None or abs(recorded_hz / configured_hz - 1) <= RATE_TOLERANCE:
        return []
    return [
        f"sample_rate is {configured_hz:g} Hz in the config, the recording has {recorded_hz:.4g} Hz: the false-alarm"
        " rate is wrong by as much"
    ]


def _checked(summary: Mapping[str, Any]) -> list[str]:
    samples, judged = summary["samples"], summary["samples_judged"]
    if judged == 0:
        return [f"NOTHING WAS CHECKED: not one of {samples} samples was judged; bias {summary['bias']['state']}."]
    if judged < 0.5 * samples:
        return [f"ONLY {100 * judged / samples:.1f} % of {samples} samples were judged."]
    return []


def _ending(summary: Mapping[str, Any]) -> list[str]:
    lost, total = unchecked(summary), len(summary["channels"])
    return [f"{len(lost)} OF {total} CHANNELS END UNCHECKED: {unchecked_words(lost)}."] if lost else []


def _injected(faults: Sequence[Mapping[str, Any]]) -> list[str]:
    if not faults:
        return []
    found = [fault for fault in faults if fault["detected_at_s"] is not None]
    named = sum(fault["isolated"] for fault in faults)
    plural = "fault" if len(faults) == 1 else "faults"
    lines = [f"{len(found)} of {len(faults)} injected {plural} detected, {named} isolated."]
    lines += [f"{fault['kind']} on {fault['channel']}: {_found(fault)}." for fault in found]
    for fault in faults:
        if fault["detected_at_s"] is None:
            why = "its channels had been declared before" if fault["declared_before"] else "not detected"
            lines.append(f"{fault['kind']} on {fault['channel']}: {why}.")
    return lines


def _found(fault: Mapping[str, Any]) -> str:
    """Say when a fault was detected and when it was isolated, of what set it was one meanwhile."""
    words = f"detected after {_time(fault['delay_s'])}"
    if fault["isolated_at_s"] == fault["detected_at_s"]:
        return f"{words}, isolated"
    if others(fault):
        words += f" as one of {', '.join(fault['declared_channels'])}"
    elif len(fault["channels"]) > 1:
        words += f", named: {', '.join(fault['declared_channels'])}"
    return (
        f"{words}, isolated after {_time(fault['isolation_delay_s'])}"
        if fault["isolated"]
        else f"{words}, not isolated"
    )


def others(fault: Mapping[str, Any]) -> list[str]:
    """Channels that were named with a fault and are not struck by it."""
    return [name for name in fault["declared_channels"] if name not in fault["channels"]]


def _declared(summary: Mapping[str, Any]) -> list[str]:
    declared = summary["declared"]
    if declared:
        first = declared[0]
        number = f"{len(declared)} declaration{'s' if len(declared) > 1 else ''}"
        return [
            f"{number} that no injected fault explains, the first: {first['channel']} {first['state']}"
            f" at {first['at_s']:.3f} s, {first['reason']}."
        ]
    if summary["samples_judged"] == 0:
        return []
    faults = summary["faults"]
    struck = {name for fault in faults for name in fault["channels"]}
    doubted = list(dict.fromkeys(name for fault in faults for name in others(fault) if name not in struck))
    if doubted:
        return [f"No other channel was declared faulty by itself; under doubt with them: {', '.join(doubted)}."]
    other, before = "other " if faults else "", " while it was checked" if unchecked(summary) else ""
    return [f"No {other}channel was declared faulty{before}."]


def _time(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.1f} s"
