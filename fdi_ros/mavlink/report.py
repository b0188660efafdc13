# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The diagnostics of a link to an autopilot: the link itself, and each unit with the rate that it really has."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_ros.mavlink.clock import MS, NS
from fdi_ros.mavlink.imu import MESSAGES, RESOLUTION, numbers
from fdi_ros.mavlink.link import Link
from fdi_ros.mavlink.streams import ENOUGH
from fdi_ros.mavlink.vehicle import Vehicle
from fdi_ros.monitor.diagnostics import Level, StatusLine

LOSSY = 0.05
"""Share of messages lost on the link that is worth a warning."""


class Reporter:
    """Describes a link; what is counted is also told of the time since the last report.

    Parameters
    ----------
    link, vehicle
        What is described.
    names, topics
        Of the units, and of what they are published on.
    """

    def __init__(self, link: Link, vehicle: Vehicle, names: Sequence[str], topics: Sequence[str]) -> None:
        self._link, self._vehicle, self._names, self._topics = link, vehicle, names, topics
        self._before: dict[str, int] = {}

    def lines(self, prefix: str, hardware: str, now: int) -> list[StatusLine]:
        """Return the statuses at the monotonic time now, ns; names begin with prefix."""
        recent = {name: count - self._before.get(name, 0) for name, count in self._vehicle.counts.items()}
        self._before = dict(self._vehicle.counts)
        level, message = self._link_words(recent, now)
        lines = [StatusLine(level, f"{prefix}link", message, hardware, self._link_values(now))]
        for k, name in enumerate(self._names):
            level, message = self._unit_words(k, now)
            lines.append(StatusLine(level, f"{prefix}unit {name}", message, hardware, self._unit_values(k, now)))
        return lines

    def _link_words(self, recent: dict[str, int], now: int) -> tuple[Level, str]:
        vehicle, link = self._vehicle, self._link
        if link.trouble:
            return Level.ERROR, f"{link.url}: {link.trouble}"
        if not vehicle.heard:
            refused = recent.get("unsigned", 0)
            why = f"; {refused} messages without a valid signature" if refused else ""
            if recent.get("signed late"):
                why = f"; rightly signed messages, but {vehicle.behind:.0f} s old by this computer's clock: set either"
            wanted = f" of system {vehicle.settings.system}" if vehicle.settings.system else ""
            return Level.STALE, f"no heartbeat{wanted} yet on {link.url}{why}"
        who = f"{vehicle.name}, system {vehicle.system}"
        if not vehicle.in_reach:
            return Level.STALE, f"nothing of {who} for {(now - vehicle.heard) / NS:.0f} s"
        words = []
        if others := vehicle.others_of_late(now):
            words.append(f"other autopilots on the link, left aside: {', '.join(map(str, others))}")
        if not vehicle.sync.synchronised:
            words.append("no answer to TIMESYNC: stamps are late by the unknown latency of the link")
        lost, heard = recent.get("lost", 0), recent.get("messages", 0)
        if lost > LOSSY * (lost + heard):
            words.append(f"{lost} of {lost + heard} messages lost")
        if more := [str(unit + 1) for unit in sorted(vehicle.units) if unit >= len(self._names)]:
            words.append(f"no topic for IMU {', '.join(more)} of the autopilot")
        words += [
            f"{recent[kind]} {said}"
            for kind, said in (
                ("bad", "pieces that are no message"),
                ("unsigned", "messages without a valid signature"),
            )
            if recent.get(kind)
        ]
        return (Level.WARN if words else Level.OK), "; ".join([who, *words])

    def _link_values(self, now: int) -> tuple[tuple[str, str], ...]:
        vehicle, link = self._vehicle, self._link
        error = vehicle.sync.error(now)
        offset = vehicle.sync.offset(now)
        counts = ("messages", "lost", "bad", "of others", "from elsewhere", "unsigned", "unknown", "without a gyro")
        return (
            ("url", link.url),
            ("opened", str(link.opened)),
            ("signing", "on" if vehicle.settings.key else "off"),
            ("messages in use", vehicle.kind or "not chosen yet"),
            ("resolution", RESOLUTION.get(vehicle.kind, "not known yet")),
            ("clock of the autopilot (s)", "none" if offset is None else f"{(now + offset) / NS:.3f}"),
            ("stamps known to (ms)", "none" if error is None else f"{error / MS:.2f}"),
            ("restarts of the autopilot's time", str(vehicle.clock.restarts)),
            *((name, str(vehicle.counts[name])) for name in counts),
            ("not sent", str(link.dropped)),
        )

    def _message(self, unit: int) -> int | None:
        """Return the id of the message that brings a unit; None: not known."""
        ids = numbers(self._vehicle.kind) if self._vehicle.kind else ()
        return next((number for number in ids if MESSAGES[number].unit in (unit, -1)), None)

    def _unit_words(self, unit: int, now: int) -> tuple[Level, str]:
        vehicle = self._vehicle
        track = vehicle.units.get(unit)
        if track is None:
            if unit in vehicle.magnetometers:
                return Level.ERROR, "the autopilot has no such IMU: only its magnetometer comes"
            number = self._message(unit)
            said = f"; request: {vehicle.streams.said(number)}" if number is not None else ""
            return (Level.ERROR if vehicle.in_reach else Level.STALE), f"nothing of this unit yet{said}"
        rate, asked = track.rate(now), vehicle.settings.rate
        if not rate:
            return Level.STALE, f"silent for {(now - track.last) / NS:.1f} s"
        number = self._message(unit)
        words = f"{rate:.1f} Hz of {asked:g} asked for"
        if rate < ENOUGH * asked:
            said = vehicle.streams.said(number) if number is not None else "not asked for"
            return Level.WARN, f"{words}; request: {said}"
        return Level.OK, words

    def _unit_values(self, unit: int, now: int) -> tuple[tuple[str, str], ...]:
        vehicle, number = self._vehicle, self._message(unit)
        track = vehicle.units.get(unit)
        return (
            ("topic", self._topics[unit]),
            ("message", MESSAGES[number].name if number is not None else "none"),
            ("rate (Hz)", f"{track.rate(now):.1f}" if track else "0.0"),
            ("asked for (Hz)", f"{vehicle.settings.rate:g}"),
            ("samples", str(track.received if track else 0)),
            ("times repeated", str(track.repeated if track else 0)),
            ("times impossible", str(track.impossible if track else 0)),
        )
