# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a link, and a monitor's declarations as short texts for the ground station.

Texts are STATUSTEXT, at most as many as a link carries. Severities are ArduPilot's: CRITICAL
for what endangers the flight, WARNING for what may pass, INFO for good news. A set of
channels is a WARNING, because healthy channels are in doubt too. A gyro with an error below
`GRAVE` is a WARNING as well. Suspicions are not announced. A delayed text gives the state at
the time of sending. Channels of a unit in the same state share one text. These texts give
the monitor's state. The texts of failover give the autopilot's use of IMUs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from fdi_ros.mavlink.link import Link
from fdi_ros.mavlink.protocol import ENOUGH, IMU_MESSAGES, MS, NS, RESOLUTION, numbers
from fdi_ros.mavlink.vehicle import LOST_AFTER, TWO_SENDERS, UnitTrack, Vehicle
from fdi_ros.monitor.diagnostics import MONITOR_LINE, Level, StatusLine

WARNED_LOSS = 0.05  #: Share of lost messages from which the link is a WARN.


class Reporter:
    """Describes a link; counts are given since the last report too."""

    def __init__(
        self, link: Link, vehicle: Vehicle, names: Sequence[str], topics: Sequence[str]
    ) -> None:
        self._link = link
        self._vehicle = vehicle
        self._names = names
        self._topics = topics
        self._before: dict[str, int] = {}

    def lines(self, prefix: str, hardware: str, now: int) -> list[StatusLine]:
        """Return the statuses at monotonic time now, ns. Names begin with prefix."""
        recent = {
            name: count - self._before.get(name, 0)
            for name, count in self._vehicle.counts.items()
        }
        self._before = dict(self._vehicle.counts)
        rows = [("link", *self._format_link(recent, now), self._link_values(now))]
        for k, name in enumerate(self._names):
            rows.append(
                (f"unit {name}", *self._format_unit(k, now), self._unit_values(k, now))
            )
        return [
            StatusLine(level, prefix + name, words, hardware, values)
            for name, level, words, values in rows
        ]

    def _format_link(self, recent: dict[str, int], now: int) -> tuple[Level, str]:
        vehicle = self._vehicle
        link = self._link
        if link.trouble:
            return Level.ERROR, f"{link.url}: {link.trouble}"
        if not vehicle.heard:
            refused = recent.get("unsigned", 0)
            why = f"; {refused} messages without a valid signature" if refused else ""
            if recent.get("signed late"):
                why = (
                    f"; rightly signed messages, but {vehicle.behind:.0f} s older than"
                    " expected: repeated, or the clock of one side is wrong"
                )
            wanted = (
                f" of system {vehicle.settings.system}"
                if vehicle.settings.system
                else ""
            )
            return Level.STALE, f"no heartbeat{wanted} yet on {link.url}{why}"
        who = f"{vehicle.name}, system {vehicle.system}"
        if not vehicle.in_reach:
            return (
                Level.STALE,
                f"nothing of {who} for {(now - vehicle.heard) / NS:.0f} s",
            )
        words = []
        if others := sorted(
            system
            for system, at in vehicle.others.items()
            if now - at < 10 * LOST_AFTER
        ):
            words.append(
                f"other autopilots on the link, left aside: {', '.join(map(str, others))}"
            )
        if vehicle.senders.are_several(now):
            words.append(
                f"{TWO_SENDERS.format(vehicle.system)}. Give each autopilot an id of its"
                " own, and route one link of each"
            )
        if not vehicle.sync.synchronised:
            words.append(
                "no answer to TIMESYNC: stamps are late by the unknown latency of the link"
            )
        lost = recent.get("lost", 0)
        heard = recent.get("in use", 0)
        if lost > WARNED_LOSS * (lost + heard):
            words.append(f"{lost} of {lost + heard} messages lost")
        if more := [
            str(unit + 1) for unit in sorted(vehicle.units) if unit >= len(self._names)
        ]:
            words.append(f"no topic for IMU {', '.join(more)} of the autopilot")
        odd = {
            "bad": "pieces that are no message",
            "unsigned": "messages without a valid signature",
        }
        words += [
            f"{recent[kind]} {text}" for kind, text in odd.items() if recent.get(kind)
        ]
        return (Level.WARN if words else Level.OK), "; ".join([who, *words])

    def _link_values(self, now: int) -> tuple[tuple[str, str], ...]:
        vehicle = self._vehicle
        link = self._link
        error = vehicle.sync.error(now)
        offset = vehicle.sync.offset(now)
        counts = (
            "messages",
            "lost",
            "bad",
            "of others",
            "from elsewhere",
            "unsigned",
            "unknown",
            "without a gyro",
        )
        return (
            ("url", link.url),
            ("opened", str(link.opened)),
            ("signing", "on" if vehicle.settings.key else "off"),
            ("messages in use", vehicle.kind or "not chosen yet"),
            ("resolution", RESOLUTION.get(vehicle.kind, "not known yet")),
            (
                "clock of the autopilot (s)",
                "none" if offset is None else f"{(now + offset) / NS:.3f}",
            ),
            ("stamps known to (ms)", "none" if error is None else f"{error / MS:.2f}"),
            ("restarts of the autopilot's time", str(vehicle.clock.restarts)),
            *((name, str(vehicle.counts[name])) for name in counts),
            ("not sent", str(link.dropped)),
        )

    def _message(self, unit: int) -> int | None:
        """Return the id of the message with a unit, or None if unknown."""
        return next(
            (
                number
                for number in numbers(self._vehicle.kind)
                if IMU_MESSAGES[number].unit in (unit, -1)
            ),
            None,
        )

    def _format_unit(self, unit: int, now: int) -> tuple[Level, str]:
        vehicle = self._vehicle
        track = vehicle.units.get(unit)
        answer = vehicle.streams.answer_to(self._message(unit))
        if track is None and unit in vehicle.magnetometers:
            return (
                Level.ERROR,
                "the autopilot has no such IMU: only its magnetometer comes",
            )
        if track is None:
            return (
                Level.ERROR if vehicle.in_reach else Level.STALE
            ), f"nothing of this unit yet; request: {answer}"
        rate = track.rate(now)
        asked = vehicle.settings.rate
        if not rate:
            return Level.STALE, f"silent for {(now - track.last) / NS:.1f} s"
        words = f"{rate:.1f} Hz of {asked:g} asked for"
        return (
            (Level.WARN, f"{words}; request: {answer}")
            if rate < ENOUGH * asked
            else (Level.OK, words)
        )

    def _unit_values(self, unit: int, now: int) -> tuple[tuple[str, str], ...]:
        number = self._message(unit)
        track = self._vehicle.units.get(unit, UnitTrack())
        return (
            ("topic", self._topics[unit]),
            ("message", IMU_MESSAGES[number].name if number is not None else "none"),
            ("rate (Hz)", f"{track.rate(now):.1f}"),
            ("asked for (Hz)", f"{self._vehicle.settings.rate:g}"),
            ("samples", str(track.received)),
            ("times repeated", str(track.repeated)),
            ("times impossible", str(track.impossible)),
        )


CRITICAL, WARNING, INFO = 2, 4, 6  #: MAV_SEVERITY
TEXT_LENGTH = 50  #: Characters of a STATUSTEXT.
EVERY = NS  #: Mean time between texts, ns.
AT_ONCE = 5  #: Texts that may follow each other at once after a quiet time.
SHARED_WITHIN = NS // 5  #: Changes within this time share texts, ns.
MONITOR_SILENT = 3 * NS  #: A monitor without reports for this time is silent, ns.
#: `NOTHING_SEEN` is announced after this time, ns: a late unit ends sooner.
NOTHING_SEEN_FOR = 2 * NS
#: Good news wait for this time, ns: sets of a loose unit come and go.
GOOD_FOR = 2 * NS
GRAVE = 0.03  #: ArduCopter flies with a smaller error of a gyro, rad/s.
#: Raw rates of healthy gyros, in whole mrad/s and averaged, differ by less, rad/s.
ROUNDED = 0.005
FAR = "FAR"  #: State of an accelerometer with a bias that no healthy one has.
FROZEN = "FROZEN"  #: State of an undeclared channel whose unit repeats old values.
_STATES = {
    "FAULTY": (CRITICAL, "faulty"),
    "AMBIGUOUS": (WARNING, "one of them faulty"),
    "STALE": (WARNING, "no data"),
    FAR: (WARNING, "biased"),
    FROZEN: (WARNING, "frozen"),
}  # severity and words by state
_QUIET = ("OK", "AMBIGUOUS")  #: Not announced beside failover.
_FINE = ("OK", "UNCHECKED", "EXCLUDED")
#: States with which nobody should take off.
_NOT_SOUND = ("FAULTY", "AMBIGUOUS", "STALE")
IN_BOTH_HALVES = "faulty (gyros and accelerometers)"
NOTHING_SEEN = "no further fault would be detected"


def _format_whole(line: StatusLine) -> str:
    """Return the words for a monitor's own status. Empty: nothing to announce."""
    if line.level == Level.STALE:
        # At a start nothing can be missed yet.
        return "" if line.message == "no sample yet" else "no samples"
    if line.message.startswith("no fused rate"):
        return (
            ""
            if line.message.startswith("no fused rate: the biases are being learned")
            else "no fused rate"
        )
    return NOTHING_SEEN if NOTHING_SEEN in line.message else ""


def _fit(name: str, words: str) -> str:
    """Return a text about a unit or channel. A name that is too long loses its beginning."""
    return f"FDI: {name[-(TEXT_LENGTH - len(f'FDI:  {words}')) :]} {words}"


def allows_arming(lines: Sequence[StatusLine]) -> bool:
    """Whether a vehicle may be armed, by the diagnostics of a monitor.

    It may not without samples, without a fused rate, or while a fault would not be detected;
    nor while a gyro or accelerometer is FAULTY, is in a set of which one is faulty, or is
    silent.
    """
    whole = next((line for line in lines if line.name == MONITOR_LINE), None)
    return (
        whole is not None
        and whole.level < Level.ERROR
        and not any(line.value("state") in _NOT_SOUND for line in lines)
    )


class Announcer:
    """Decides which texts are sent, and when, about channels in units of three.

    Parameters
    ----------
    channels
        Names of the channels. Reports on others are ignored.
    apart
        Given beside failover, which sends texts of its own: bound on the present difference
        of the raw rate of a unit, from 0, and the nearest other one, rad/s, NaN if unknown. Sets and
        good news then stay in the diagnostics. A name waits while raw rates contradict it.
    """

    def __init__(
        self, channels: Sequence[str], apart: Callable[[int], float] | None = None
    ) -> None:
        self._raw_apart = apart
        self._units = [tuple(channels[k : k + 3]) for k in range(0, len(channels), 3)]
        self._forces = {
            f"{name.rpartition('.')[0]}.accel_{axis}": f"accelerometer {axis} of IMU {k + 1}"
            for k, (name, *_) in enumerate(self._units)
            for axis in "xyz"
        }
        """Accelerometers in words, by the names of their channels."""
        self._now: dict[str, tuple[str, str]] = {
            **dict.fromkeys((*channels, *self._forces), ("OK", "")),
            MONITOR_LINE: ("", ""),
        }
        """State and set of each channel, and the trouble of the whole. Empty: none."""
        self._said = dict(self._now)  # the same as last announced
        self._changed_at = dict.fromkeys(self._now, 0)  # when each last did, ns
        self._apart = dict.fromkeys(channels, "")
        """Present difference of each channel and the other of its pair, rad/s."""
        # Estimated, rad/s, of an accelerometer m/s^2.
        self._errors = dict.fromkeys((*channels, *self._forces), math.inf)
        self._heard = 0
        # Time of the first change since the last texts, ns.
        self._changed: int | None = None
        self._nothing_since: int | None = None
        self._tokens = float(AT_ONCE)
        self._filled = 0

    def hear(self, lines: Sequence[StatusLine], now: int) -> None:
        """Take the monitor's diagnostics, without its name in theirs, at time now, ns."""
        self._heard = now
        for line in lines:
            state = line.value("state")
            if line.value("repeats for (s)") and state not in ("FAULTY", "AMBIGUOUS"):
                state = FROZEN
            if line.name == MONITOR_LINE:
                words = _format_whole(line)
                is_none = words == NOTHING_SEEN
                self._nothing_since = (self._nothing_since or now) if is_none else None
                if now - (self._nothing_since or 0) >= NOTHING_SEEN_FOR:
                    self._note(MONITOR_LINE, (words, ""), now)
            elif line.name in self._apart and (state in _STATES or state in _FINE):
                self._apart[line.name] = line.value("apart (rad/s)").partition(" ")[0]
                error = abs(line.number("estimated error (rad/s)"))
                self._errors[line.name] = error if error > 0.0 else math.inf
                group = line.value("one of") if state == "AMBIGUOUS" else ""
                self._note(line.name, (state if state in _STATES else "OK", group), now)
            elif line.name in self._forces:
                # Sets, and what a whole unit lacks, stay in the diagnostics.
                bias = abs(line.number("implausible bias (m/s^2)"))
                error = abs(line.number("estimated error (m/s^2)"))
                told = "FAULTY" if state == "FAULTY" else FAR if bias > 0.0 else "OK"
                self._errors[line.name] = bias if told == FAR else error
                self._note(line.name, (told, ""), now)

    def _note(self, name: str, found: tuple[str, str], now: int) -> None:
        if found != self._now[name]:
            self._now[name] = found
            self._changed_at[name] = now
            self._changed = now if self._changed is None else self._changed

    def due(self, now: int) -> list[tuple[int, str]]:
        """Return the texts to be sent now, ns, each with its severity."""
        if self._heard and now - self._heard > MONITOR_SILENT:
            self._note(MONITOR_LINE, ("the monitor is silent", ""), now)
        self._tokens = min(AT_ONCE, self._tokens + (now - self._filled) / EVERY)
        self._filled = now
        if self._changed is not None and now - self._changed < SHARED_WITHIN:
            return []
        self._changed = None
        alike = self._alike(now)
        if self._raw_apart is not None:
            quiet = [names for names in alike if self._now[names[0]][0] in _QUIET]
            self._said |= {name: self._now[name] for names in quiet for name in names}
            alike = [
                names
                for names in alike
                if names not in quiet and not self._is_contradicted(names)
            ]
        alike = self._with_accelerometers(alike)
        pending = [(self._text(names), names) for names in alike]
        # The gravest first.
        told = sorted(pending, key=lambda one: one[0][0])[: int(self._tokens)]
        self._tokens -= len(told)
        self._said |= {name: self._now[name] for _, names in told for name in names}
        return [text for text, _ in told]

    def _is_contradicted(self, names: tuple[str, ...]) -> bool:
        """Return whether the raw rates agree, though the monitor names channels of a unit."""
        if self._raw_apart is None or self._now[names[0]][0] != "FAULTY":
            return False
        if names[0] in self._forces:
            return False
        unit = next(k for k, one in enumerate(self._units) if names[0] in one)
        error = max(map(self._errors.__getitem__, names))
        return self._raw_apart(unit) < min(GRAVE, max(ROUNDED, error / 2))

    def _alike(self, now: int) -> list[tuple[str, ...]]:
        """Return the changed channels in groups that share a text: a set, or a whole unit."""
        left = {
            name: found
            for name, found in self._now.items()
            if found != self._said[name]
            and (found[0] != "OK" or now - self._changed_at[name] >= GOOD_FOR)
        }
        groups = dict.fromkeys(
            found for found in left.values() if found[0] == "AMBIGUOUS"
        )
        found = [
            tuple(name for name in left if left[name] == group) for group in groups
        ]
        for unit in self._units:
            states = {left.get(name, ("", "")) for name in unit}
            if len(unit) == 3 and len(states) == 1 and not states & {*groups, ("", "")}:
                found.append(unit)
        together = {name for names in found for name in names}
        # Of equal severity the whole comes first.
        return sorted(
            found + [(name,) for name in left if name not in together],
            key=lambda names: names != (MONITOR_LINE,),
        )

    def _with_accelerometers(
        self, alike: list[tuple[str, ...]]
    ) -> list[tuple[str, ...]]:
        """Join the accelerometers of a unit to its gyros, if its fault shows in both.

        At least two accelerometers are named, and all gyros, or a set of two at least.
        """
        joined = []
        told: set[str] = set()
        for names in alike:
            units = {name.rpartition(".")[0] for name in names}
            beside = []
            if len(names) > 1 and len(units) == 1:
                wanted = "OK" if self._now[names[0]][0] == "OK" else "FAULTY"
                beside = [
                    one
                    for (one, *others) in alike
                    if one in self._forces
                    and not others
                    and one.rpartition(".")[0] in units
                    and self._now[one][0] == wanted
                ]
            if len(beside) > 1:
                told.update(beside)
                names = (*names, *beside)
            joined.append(names)
        return [names for names in joined if names[0] not in told]

    def _text(self, names: tuple[str, ...]) -> tuple[int, str]:
        """Return the text about a group of channels, or about the whole."""
        state, group = self._now[names[0]]
        if names == (MONITOR_LINE,):
            return (
                (CRITICAL, f"FDI: {state}")
                if state
                else (INFO, "FDI: all is judged again")
            )
        gyros = [name for name in names if name not in self._forces]
        who = names[0].rpartition(".")[0] if len(names) > 1 else names[0]
        is_both = 0 < len(gyros) < len(names)
        if state == "AMBIGUOUS":
            both = _fit(who, IN_BOTH_HALVES)
            return WARNING, both if is_both else self._set_text(group)
        severity, words = _STATES.get(state, (INFO, "agrees again"))
        if names[0] in self._forces:
            if state in ("FAULTY", FAR) and self._errors[names[0]] > 0.0:
                # Of two that differ, either may be the one.
                far = sum(found == FAR for found, _ in self._now.values())
                mark = "?" if state == FAR and far > 1 else ""
                words = f"off by {self._errors[names[0]]:.1f} m/s^2{mark}"
            return max(severity, WARNING), _fit(self._forces[names[0]], words)
        if state == "FAULTY" and max(map(self._errors.__getitem__, gyros)) < GRAVE:
            severity = WARNING
        is_faulty = state == "FAULTY"
        return severity, _fit(who, IN_BOTH_HALVES if is_both and is_faulty else words)

    def _set_text(self, group: str) -> str:
        """Return the text for a set, given as names with commas between. Whole units are named."""
        names = set(group.split(", "))
        units = [
            unit[0].rpartition(".")[0] for unit in self._units if names.issuperset(unit)
        ]
        if len(units) == 1 and len(names) == 3:
            return _fit(units[0], "faulty (axis cannot be told apart)")
        if len(names) == 1:
            return _fit(group, "likely faulty")
        texts = [
            f"FDI: one faulty of {', '.join(units) if 3 * len(units) == len(names) else group}"
        ]
        if len(names) == 2 and (size := self._apart.get(max(names))):
            texts.insert(0, f"FDI: {group.replace(', ', ' or ')} wrong by {size} rad/s")
        return next(
            (text for text in texts if len(text) <= TEXT_LENGTH),
            f"FDI: one faulty of {len(names)} channels",
        )
