# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a monitor declares, as short texts for the ground station: STATUSTEXT, no more of them than a link bears.

Severities as ArduPilot uses them: CRITICAL for what the pilot must know now (as its "EKF variance"), WARNING for what
has gone and may come back, INFO for good news. Suspicions are not announced. What changes while texts wait is said as
it stands when its turn comes; channels of a unit that stand alike are one text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from fdi_ros.mavlink.clock import NS

CRITICAL, WARNING, INFO = 2, 4, 6
"""MAV_SEVERITY."""
LENGTH = 50
"""Characters of a STATUSTEXT."""
EVERY = NS
"""Between two texts, ns."""
AT_ONCE = 5
"""Texts that may follow one another at once after a quiet time."""
SETTLE = NS // 5
"""What changes within so long is put together, ns."""
SILENT = 3 * NS
"""A monitor that reports nothing for so long is silent, ns."""
WHOLE = ""
"""In place of a channel: the monitor as a whole."""
_STATES = {
    "FAULTY": (CRITICAL, "faulty, left out"),
    "AMBIGUOUS": (CRITICAL, "one of them faulty"),
    "STALE": (WARNING, "no data"),
}
"""By the state of a channel that is announced."""
_FINE = ("OK", "UNCHECKED", "EXCLUDED")


class Text(NamedTuple):
    """One STATUSTEXT."""

    severity: int
    text: str


class Report(NamedTuple):
    """What a monitor reports of one channel, or of the whole."""

    name: str
    """Of the channel; `WHOLE`."""
    state: str
    """Of a channel: its state; of the whole: its message."""
    group: str = ""
    """Channels of which one is faulty, if the state says so."""
    apart: str = ""
    """By how much the two channels of a group differ, rad/s, as "0.100 +- 0.002"."""


def whole_state(message: str, level: int) -> str:
    """Return what of a monitor's own status is announced; empty: nothing."""
    if level == 3:
        return "no samples"
    if message.startswith("no fused rate: the biases are being learned"):
        return ""
    if message.startswith("no fused rate"):
        return "no fused rate"
    return "no further fault would be seen" if "no further fault would be seen" in message else ""


class Announcer:
    """Decides which texts are sent, and when.

    Parameters
    ----------
    channels
        Names of the channels, in units of three; others are not listened to.
    """

    def __init__(self, channels: Sequence[str]) -> None:
        self._units = [tuple(channels[k : k + 3]) for k in range(0, len(channels), 3)]
        self._now: dict[str, tuple[str, str]] = dict.fromkeys(channels, ("OK", ""))
        self._said = dict(self._now)
        """State and group of each channel: as it stands, and as the ground station knows it."""
        self._apart = dict.fromkeys(channels, "")
        """By how much each channel and the other of its pair differ now, rad/s: said with the pair, not its changes."""
        self._whole = self._whole_said = ""
        self._heard = 0
        self._changed: int | None = None
        """When the first of what has changed since the last texts did, ns."""
        self._tokens, self._filled = float(AT_ONCE), 0

    def hear(self, reports: Sequence[Report], now: int) -> None:
        """Take reports of the monitor at a time, ns."""
        self._heard = now
        for report in reports:
            if report.name == WHOLE:
                self._change_whole(report.state, now)
            elif report.name in self._now and (report.state in _STATES or report.state in _FINE):
                state = report.state if report.state in _STATES else "OK"
                found = (state, report.group if state == "AMBIGUOUS" else "")
                self._apart[report.name] = report.apart.partition(" ")[0]
                if found != self._now[report.name]:
                    self._now[report.name] = found
                    self._note_change(now)

    def _change_whole(self, state: str, now: int) -> None:
        if state != self._whole:
            self._whole = state
            self._note_change(now)

    def _note_change(self, now: int) -> None:
        if self._changed is None:
            self._changed = now

    def due(self, now: int) -> list[Text]:
        """Return the texts to be sent now, ns."""
        if self._heard and now - self._heard > SILENT:
            self._change_whole("the monitor is silent", now)
        self._tokens = min(AT_ONCE, self._tokens + (now - self._filled) / EVERY)
        self._filled = now
        if self._changed is not None and now - self._changed < SETTLE:
            return []
        self._changed = None
        texts = []
        for text, names in self._pending():
            if self._tokens < 1.0:
                break
            self._tokens -= 1.0
            texts.append(text)
            if not names:
                self._whole_said = self._whole
            for name in names:
                self._said[name] = self._now[name]
        return texts

    def _pending(self) -> list[tuple[Text, tuple[str, ...]]]:
        """Texts that the ground station is to know, each with the channels it is about; the gravest first."""
        found: list[tuple[Text, tuple[str, ...]]] = []
        if self._whole != self._whole_said:
            text = Text(CRITICAL, f"FDI: {self._whole}") if self._whole else Text(INFO, "FDI: all is judged again")
            found.append((text, ()))
        changed = {name: now for name, now in self._now.items() if now != self._said[name]}
        for names in self._alike(changed):
            state, group = changed[names[0]]
            if state == "AMBIGUOUS":
                members = tuple(name for name in names if changed[name] == (state, group))
                found.append((Text(CRITICAL, self._set_text(group)), members))
                continue
            unit = names[0].rpartition(".")[0] if len(names) > 1 else names[0]
            severity, words = _STATES.get(state, (INFO, "in use again"))
            found.append((Text(severity, f"FDI: {unit} {words}"[:LENGTH]), names))
        return sorted(found, key=lambda one: one[0].severity)

    def _alike(self, changed: Mapping[str, tuple[str, str]]) -> list[tuple[str, ...]]:
        """Channels that have changed, together where they stand alike: those of a set, those of a whole unit."""
        groups = dict.fromkeys(now for now in changed.values() if now[0] == "AMBIGUOUS")
        left = dict(changed)
        found = [tuple(name for name in left if left[name] == group) for group in groups]
        for names in found:
            for name in names:
                del left[name]
        for unit in self._units:
            if len(unit) == 3 and len({left.get(name, ("", "")) for name in unit}) == 1 and unit[0] in left:
                found.append(unit)
                for name in unit:
                    del left[name]
        return found + [(name,) for name in left]

    def _set_text(self, group: str) -> str:
        """Text for a set of channels, their names separated by commas; of whole units those are named."""
        names = set(group.split(", "))
        units = [unit[0].rpartition(".")[0] for unit in self._units if names.issuperset(unit)]
        if len(units) == 1 and len(names) == 3:
            return f"FDI: {units[0]} faulty, axis not known"[:LENGTH]
        if len(names) == 2 and (size := self._apart.get(max(names))):
            text = f"FDI: {group.replace(', ', ' or ')} wrong by {size} rad/s"
            if len(text) <= LENGTH:
                return text
        text = f"FDI: one faulty of {', '.join(units) if 3 * len(units) == len(names) else group}"
        return text if len(text) <= LENGTH else f"FDI: one faulty of {len(names)} channels"
