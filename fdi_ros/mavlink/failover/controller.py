# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover of one ArduPilot: the policy joined to the vehicle, the monitor and the file.

`Failover.turn` collects the present view, asks `fdi_ros.mavlink.failover.policy`, sends
the orders and announces the conditions. All decisions are the policy's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from fdi_ros.mavlink.failover.evidence import SILENCE, Evidence
from fdi_ros.mavlink.failover.file import FailoverFile, Saved
from fdi_ros.mavlink.failover.lane import LaneReport, LaneState, follow
from fdi_ros.mavlink.failover.policy import (
    Imu,
    PolicySettings,
    PolicyState,
    View,
    decide,
    is_refused,
)
from fdi_ros.mavlink.failover.probe import Probe, probe
from fdi_ros.mavlink.failover.raw import CURRENT
from fdi_ros.mavlink.failover.ready import (
    EKF_LANES,
    EKF_PRIMARY,
    INS_USE,
    Facts,
    doubt,
    not_again,
    not_ready,
)
from fdi_ros.mavlink.failover.words import (
    SIZING,
    Announced,
    Condition,
    Note,
    Readiness,
    Words,
    WordsState,
    announce,
    imu_name,
    text_of,
)
from fdi_ros.mavlink.protocol import ARDUPILOT, ENOUGH, MS, NS, ImuSample
from fdi_ros.mavlink.report import TEXT_LENGTH
from fdi_ros.mavlink.vehicle import Vehicle
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.system.clocks import Clocks

#: Failover compares more samples than the topics of the monitor get. At 50 Hz a gyro that
#: vibrates with a multiple of 50 Hz seems to have a slow error. 111 Hz show the vibration
#: up to half of that, and the multiples of 111 Hz hardly pass the autopilot's filter.
OVERSAMPLING = 20 / 9
READ_EVERY = 100 * MS  #: Time between two readings of the parameters in flight, ns.
READ_ON_GROUND = NS // 2  #: The same on the ground, ns.
READ_HURRIED = 50 * MS  #: The same while an order may depend on the parameters, ns.
USE_KNOWN_FOR = 10 * NS  #: An older report of a parameter is not known any more, ns.
#: A monitor without diagnostics for this time is in doubt, ns.
REPORTED_WITHIN = 5 * NS
COUNTED = 5 * NS  #: Losses are counted over this time, ns.
#: After this silence what was sent since the last message counts as lost, ns. Heartbeats
#: alone come once a second.
TEXT_LOST = 1200 * MS
BOOT_STEP = 3 * NS  #: A boot time that grows by more is another boot, ns,
#: if the autopilot's time has gone back, or after this time over a link that is quick, ns.
BACKLOG = 10 * NS
SAME_BOOT = 10.0  #: Largest difference of two times of one start of the autopilot, s.
#: Two starts within this time are those of one power supply, s.
POWERED_TOGETHER = 60.0


class Failover:
    """Takes bad IMUs of one ArduPilot out of use, and puts them back.

    Parameters
    ----------
    vehicle
        The autopilot.
    channels
        Names of the monitor's channels, three for each IMU.
    settings
        Settings of the policy.
    path
        File that keeps the IMUs out of use.
    clocks
        Returns the clocks of this computer.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        channels: Sequence[str],
        settings: PolicySettings,
        path: Path,
        clocks: Callable[[], Clocks],
    ) -> None:
        vehicle.keeps_system = True
        self._vehicle = vehicle
        self._channels = channels
        self._settings = settings
        self._clocks = clocks
        count = len(channels) // 3
        interval = round(NS / vehicle.settings.rate)
        #: Time of the monitor's last diagnostics with these IMUs, ns. 0: none, or others since.
        self.reported = 0
        #: Nobody else publishes on the topics of the monitor and of this node.
        self.is_alone = False
        #: Age of the newest judged sample when reported, s. NaN: unknown.
        self.age = math.nan
        self.evidence = Evidence(count, interval, settings.min_size)
        self._file = FailoverFile(path, count)
        if self._file.trouble:
            vehicle.events.append(self._file.trouble)
        saved = self._file.written
        self._system = saved.system
        self._state = PolicyState.begin(count, saved.out, saved.without_notch)
        self.evidence.remember(dict(zip(saved.out, saved.bad, strict=False)))
        self._words = WordsState((Note(),) * count)
        self._values: list[tuple[bool | None, int]] = [(None, 0)] * count
        self._lanes: int | None = None  # of `EKF_LANES`. None: not reported
        self._primary: int | None = None  # of `EKF_PRIMARY`. None: not reported
        self._lane = LaneState()
        self._breaks = 0  # of the vehicle, until the last turn
        self._conversation = 0
        self._boots = 0
        self._booted: int | None = None  # when the autopilot started, ns
        self._restarts = 0  # steps of the autopilot's time found until then
        self._late_since: int | None = None  # messages are late, or after a boot, since
        self._probe = Probe.begin(count)
        self._read_at = -NS
        self._hurry = False
        self._unsized: dict[int, int] = {}  # IMUs out of use, not announced yet: since
        self._counted = (0, 0, 0)  # time, ns, and messages lost and received until then
        self._lost = math.nan  # share of messages lost of late
        self._readiness = Readiness()
        self._said_at = 0  # time of the last text, ns
        #: What was announced before a message of the autopilot: conditions and reason.
        self._received = self._announced

    @property
    def _announced(self) -> tuple[Mapping[int, Announced], str | None]:
        return self._words.announced, self._readiness.announced

    @_announced.setter
    def _announced(self, known: tuple[Mapping[int, Announced], str | None]) -> None:
        conditions, reason = known
        self._words = self._words._replace(announced=conditions)
        self._readiness = self._readiness._replace(announced=reason)

    @property
    def out(self) -> tuple[int, ...]:
        """IMUs, from 0, that are, or may be, out of use by our orders."""
        memories = self._state.memories
        return tuple(k for k, memory in enumerate(memories) if memory.ours)

    @property
    def _is_same(self) -> bool:
        """Whether the IMUs out of use are those of the present autopilot."""
        return self._vehicle.system == self._system or not self.out

    @property
    def _without_notch(self) -> tuple[int, ...]:
        memories = self._state.memories
        return tuple(k for k, memory in enumerate(memories) if memory.without_notch)

    @property
    def is_done(self) -> bool:
        """Whether a stop now leaves nothing to put back: in flight, IMUs stay out."""
        pairs = zip(self._state.memories, self.evidence.imus, strict=True)
        waits = any(
            memory.ours and imu.ok and imu.agreed and not memory.without_notch
            for memory, imu in pairs
        )
        return self._vehicle.armed or not self._vehicle.in_reach or not waits

    def close(self) -> None:
        """Wait until the file is written. Raise `ConfigError` if that fails."""
        self._file.close()

    def feed(self, sample: ImuSample) -> None:
        """Take a sample of an IMU."""
        self.evidence.raw.feed(sample.unit, sample.stamp, sample.rate)

    def turn(self, now: int, restore: bool = False) -> None:
        """Do all that is due at time now, ns. restore: the operator puts all back."""
        self._note_boot(now)
        self._read(now)
        view = self._view(now, restore)
        if not self.out:
            self._system = self._vehicle.system or 0
        decision = decide(self._state, view, now, self._settings)
        self._state = decision.state
        self._hurry = decision.hurry
        self._try_orders(view, now)
        for imu, use in decision.orders:
            self._vehicle.set_parameter(INS_USE[imu], float(use))
        self._count_losses(now)
        self._follow_lane(view, now)
        self._announce(view, now)
        if error := self._file.keep(self._saved(now), now):
            self._vehicle.events.append(error)

    def _follow_lane(self, view: View, now: int) -> None:
        """Ask for another EKF lane where a bad IMU has misled the primary one."""
        vehicle = self._vehicle
        silence = now - vehicle.heard
        count = len(view.imus)
        # Others than ArduCopter do not name the lane that they return to when disarmed.
        mask = self._lanes if self._lanes and vehicle.is_copter else 0
        named = None
        while vehicle.lanes:
            named = vehicle.lanes.popleft()
        report = LaneReport(
            named=named,
            configured=self._primary,
            # Without a lane for one IMU, the next one has its number.
            lanes=next((k for k in range(count) if not mask >> k & 1), count),
            is_complete=silence < SILENCE and vehicle.breaks == self._breaks,
            has_texts=vehicle.texts > 0,
        )
        self._breaks = vehicle.breaks
        memories = self._state.memories
        self._lane, asks = follow(
            self._lane, report, memories, view, now, self._settings
        )
        if asks:
            vehicle.ask_for_lane()
            vehicle.events.append(
                f"EKF lane {self._lane.primary} was misled: asked for another lane"
            )

    def _try_orders(self, view: View, now: int) -> None:
        """Find out whether the autopilot sets INS_USE, while no order depends on it."""
        is_calm = view.linked and not self._hurry and not self.out
        denied = self._vehicle.denied
        memories = self._state.memories
        self._probe, imu = probe(
            self._probe,
            may=[is_calm and bool(use) for use, _ in self._values],
            heard=[heard for _, heard in self._values],
            outcomes=[
                False if memory.obeyed is None and name in denied else memory.obeyed
                for name, memory in zip(INS_USE, memories, strict=False)
            ],
            now=now,
        )
        if imu >= 0:
            self._vehicle.set_parameter(INS_USE[imu], 1.0)

    def _saved(self, now: int) -> Saved:
        """Return the content of the file."""
        clocks = self._clocks()
        known = self._file.written
        if self._booted is not None:
            ago = (now - self._booted) / NS
            known = known._replace(
                booted=clocks.unix - ago,
                after=clocks.uptime - ago,
                computer=clocks.boot,
            )
        return known._replace(
            system=self._system,
            out=self.out,
            without_notch=self._without_notch,
            bad=tuple(map(self.evidence.bad, self.out)),
        )

    def restore(self, now: int) -> tuple[bool, str]:
        """Ask to put all IMUs back. Return whether that was done, and an answer."""
        ours = self._names(self.out)
        if not ours:
            return True, "no IMU is out of use by failover"
        if not self._view(now).linked:
            return False, f"{ours} cannot be put back: the autopilot is not heard"
        self.turn(now, restore=True)
        return True, f"the autopilot is asked to use {ours} again"

    def status(self, now: int) -> tuple[Level, str]:
        """Return level and words for the diagnostics."""
        view = self._view(now)
        facts = self._facts(view, now)
        if not self.out:
            why = not_ready(self._state.memories, view, facts, now, self._settings)
            return (Level.WARN, f"no failover: {why}") if why else (Level.OK, "ready")
        why = doubt(view, facts)
        asked = [k for k in self.out if self._state.memories[k].seen is True]
        out = [k for k in self.out if k not in asked]
        parts = (
            (out, f"out of use: {self._names(out)} of system {self._system}"),
            (asked, f"ordered out, reported in use: {self._names(asked)}"),
            (self._file.written.out != self.out, "failover_file is not written"),
            (self._without_notch and self._is_same, "reboot before flight"),
            (why, f"no failover: {why}"),
        )
        return Level.WARN, "; ".join(words for holds, words in parts if holds)

    def _names(self, imus: Sequence[int]) -> str:
        return ", ".join(imu_name(imu, self._channels) for imu in imus)

    def _note_boot(self, now: int) -> None:
        """Note a start of the autopilot: its clock has gone back, or is behind for long."""
        tracks = self._vehicle.units.values()
        newest = max(tracks, key=lambda track: track.last, default=None)
        if newest is None:
            return
        booted = newest.last - newest.time
        restarts = self._vehicle.clock.restarts
        if self._booted is None and (self.out or self._without_notch):
            if not self._is_same_boot((now - booted) / NS):
                self._boots += 1
        elif self._booted is not None and booted - self._booted > BOOT_STEP:
            # A link that was blocked also delivers late what it has kept.
            self._late_since = self._late_since or now
            is_long = now - self._late_since >= BACKLOG and self._vehicle.sync.trip(now)
            if restarts == self._restarts and not is_long:
                return
            self._boots += 1
            self._forget()
            self._probe = Probe.begin(len(self._values))
            self._vehicle.denied.clear()
        self._late_since = None
        self._restarts = restarts
        self._booted = booted

    def _is_same_boot(self, ago: float) -> bool:
        """Return whether the autopilot has run since before the file was written.

        The autopilot started ``ago`` seconds ago. Its clock and the clock of this computer have
        gone on alike, or not. Unix time is compared only if this computer was started in
        between, and not together with the autopilot: without a time source, Unix time may
        begin at the same value after each power cut.
        """
        clocks = self._clocks()
        saved = self._file.written
        if clocks.boot and clocks.boot == saved.computer:
            return abs(clocks.uptime - ago - saved.after) <= SAME_BOOT
        if abs(clocks.uptime - ago) < POWERED_TOGETHER:
            return False
        return abs(clocks.unix - ago - saved.booted) <= SAME_BOOT

    def _forget(self) -> None:
        self._values = [(None, 0)] * len(self._values)
        self._lanes = self._primary = None

    def _read(self, now: int) -> None:
        """Take the reports of parameters, and ask for the next."""
        vehicle = self._vehicle
        if vehicle.begun != self._conversation:
            self._conversation = vehicle.begun
            self._forget()
        names = INS_USE[: len(self._values)]
        stamps = [track.stamp for track in vehicle.units.values()]
        is_late = now - max(stamps, default=0) > CURRENT
        while vehicle.parameters:
            name, value = vehicle.parameters.popleft()
            # What comes beside old samples is as old, perhaps from before our orders.
            if name in names and not is_late:
                self._values[names.index(name)] = (value != 0, now)
            elif 0 <= value < 256:
                self._hear_of_lanes(name, int(value))
        usual = READ_EVERY if vehicle.armed else READ_ON_GROUND
        pause = READ_HURRIED if self._hurry else usual
        if vehicle.in_reach and now - self._read_at >= pause:
            self._read_at = now
            for k, name in enumerate(names):
                if k != self._probe.imu:
                    vehicle.read_parameter(name)
            if self._lanes is None or not vehicle.armed:
                vehicle.read_parameter(EKF_LANES)
            if not vehicle.armed:
                vehicle.read_parameter(EKF_PRIMARY)

    def _hear_of_lanes(self, name: str, value: int) -> None:
        if name == EKF_LANES:
            # A bit that is set later counts only from the next start on.
            known = 255 if self._lanes is None else self._lanes
            self._lanes = known & value
        elif name == EKF_PRIMARY:
            self._primary = value

    def _view(self, now: int, restore: bool = False) -> View:
        vehicle = self._vehicle
        evidence = self.evidence
        delivers = [
            k in vehicle.units and now - vehicle.units[k].last < SILENCE
            for k in range(len(self._values))
        ]
        imus: list[Imu] = []
        lanes = 255 if self._lanes is None else self._lanes
        taken = [k for k, one in enumerate(self._state.memories) if one.taken]
        for k, imu in enumerate(evidence.look(delivers, self.out, now, taken)):
            use, heard = self._values[k]
            # Those of another system do not count for the one with an IMU out.
            if not self._is_same or now - heard >= USE_KNOWN_FOR:
                use = None
            imus.append(imu._replace(use=use, heard=heard, lane=bool(lanes >> k & 1)))
        reported = (
            self.reported >= evidence.begun and now - self.reported < REPORTED_WITHIN
        )
        return View(
            imus=tuple(imus),
            linked=vehicle.in_reach
            and vehicle.autopilot == ARDUPILOT
            and vehicle.kind == "SCALED_IMU"
            and self._late_since is None
            and self._is_same,
            armed=vehicle.armed,
            disarmed=vehicle.disarmed,
            monitored=self.is_alone and now - evidence.heard < SILENCE and reported,
            boots=self._boots,
            restore=restore,
        )

    def _announce(self, view: View, now: int) -> None:
        """Announce conditions and readiness while the autopilot is heard.

        What was sent into a gap of the link is announced anew after the gap.
        """
        silence = now - self._vehicle.heard
        if self._vehicle.heard > self._said_at and not self._unsized:
            self._received = self._announced
        if silence >= TEXT_LOST:
            self._announced = self._received
            self._unsized.clear()
        before = self._announced
        memories = self._state.memories
        self._words, conditions = announce(
            self._words, memories, view, now, self._settings
        )
        readiness = self._judge_readiness(view, now)
        if silence >= SILENCE:
            self._announced = before
            return
        texts = self._condition_texts(conditions, now)
        if readiness is not None:
            texts.append((readiness.severity, f"FDI: {readiness.text}"))
        for severity, text in texts:
            self._said_at = now
            self._say(severity, text)

    def _condition_texts(
        self, conditions: Sequence[tuple[int, Condition]], now: int
    ) -> list[tuple[int, str]]:
        """Return severities and texts, that of `OUT` once the error is known or `SIZING` is over."""
        texts = []
        for key, condition in conditions:
            self._unsized.pop(key, None)
            if condition is Condition.OUT:
                self._unsized[key] = now
            else:
                waits = self.evidence.imus[key].waits if key >= 0 else ""
                text = text_of(key, condition, self._channels, waits=waits)
                texts.append((condition.value.severity, text))
        for imu, since in list(self._unsized.items()):
            error = self.evidence.error(imu, now)
            if error is not None or now - since >= SIZING:
                del self._unsized[imu]
                text = text_of(imu, Condition.OUT, self._channels, error)
                texts.append((Condition.OUT.value.severity, text))
        return texts

    def _say(self, severity: int, text: str) -> None:
        text = text[:TEXT_LENGTH]
        self._vehicle.send_text(severity, text)
        self._vehicle.events.append(text)

    def _count_losses(self, now: int) -> None:
        at, lost, received = self._counted
        if now - at >= COUNTED:
            counts = self._vehicle.counts
            self._counted = (now, counts["lost"], counts["in use"])
            more = counts["lost"] - lost
            self._lost = more / max(1, more + counts["in use"] - received)

    def _judge_readiness(self, view: View, now: int) -> Words | None:
        """Return that failover is ready, or not any more and why, once that lasts."""
        facts = self._facts(view, now)
        memories = self._state.memories
        is_out = any(memory.ours and not is_refused(memory) for memory in memories)
        reason = not_again if is_out else not_ready
        why = reason(memories, view, facts, now, self._settings)
        may_warn = view.armed and self._vehicle.in_reach
        self._readiness, words = self._readiness.hear(why, is_out, may_warn, now)
        return words

    def _facts(self, view: View, now: int) -> Facts:
        """Return what readiness depends on beside the view."""
        return Facts(
            age=self.age,
            lost=self._lost,
            trip=self._vehicle.sync.trip(now),
            is_slow=self._is_slow(view, now),
            other=None if self._is_same or not self._vehicle.system else self._system,
            is_mixed=self._vehicle.senders.are_several(now),
            is_file_fine=not self._file.trouble,
            has_lanes=self._lanes is not None,
            obeys=self._probe.obeys,
        )

    def _is_slow(self, view: View, now: int) -> bool:
        """Return whether an IMU in use comes so slowly that vibration may look like an error."""
        units = self._vehicle.units
        least = ENOUGH * self._vehicle.settings.rate
        return any(
            imu.use and imu.delivers and units[k].rate(now) < least
            for k, imu in enumerate(view.imus)
        )
