# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A vehicle of ours and simulated autopilots, talking in simulated time over a link with a latency."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from itertools import count
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.mavlink.protocol import ImuSample
from fdi_ros.mavlink.vehicle import Vehicle, VehicleSettings
from mavlink.autopilots import NS, PARAMETERS, Autopilot

UTC = 1_790_000_000
"""Unix time at the start of the simulation, s."""
HARMLESS = {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "STATUSTEXT", "NAMED_VALUE_FLOAT"}
"""All that may be sent; of commands only the one for intervals."""


class Conversation:
    """Runs in steps of a millisecond; everything that our side sends is checked to be harmless."""

    def __init__(
        self,
        *autopilots: Autopilot,
        latency: Callable[[], int] = lambda: 3_000_000,
        peers: tuple[Any, ...] = (),
        may_set: bool = False,
        **settings,
    ) -> None:
        self.now = 1000 * NS
        for autopilot in autopilots:
            autopilot.boot += self.now
            autopilot.start += self.now
        self.autopilots = autopilots
        self.peers = peers or (None,) * len(autopilots)
        self.latency, self.may_set = latency, may_set
        self.sent: Counter[str] = Counter()
        self.sent_to: Counter[Any] = Counter()
        self.vehicle = Vehicle(VehicleSettings(**{"rate": 50.0, **settings}), self._send, lambda: UTC + self.now / NS)
        self.samples: list[tuple[int, ImuSample]] = []
        """With the time at which each came out, ns."""
        self.cut = False
        self._order = count()
        self._under_way: list[tuple[int, int, int, Any, bytes]] = []
        self._check = mavlink.MAVLink(None)

    def _send(self, data: bytes, peer: Any) -> None:
        message = self._check.parse_char(data)
        assert message.get_type() in HARMLESS or (self.may_set and message.param_id in PARAMETERS)
        assert message.get_type() != "COMMAND_LONG" or message.command == 511
        assert message.get_type() != "TIMESYNC" or message.tc1 == 0
        assert message.get_type() != "HEARTBEAT" or message.autopilot == 8
        self.sent[message.get_type()] += 1
        self.sent_to[peer] += 1
        for number, autopilot in enumerate(self.autopilots):
            if self.peers[number] == peer or peer is None:
                self._travel(autopilot, data, None)

    def _travel(self, to: Autopilot | None, data: bytes, peer: Any) -> None:
        if not self.cut:
            number = -1 if to is None else self.autopilots.index(to)
            entry = (self.now + self.latency(), next(self._order), number, peer, data)
            heapq.heappush(self._under_way, entry)

    def inject(self, data: bytes, peer: Any = None) -> None:
        """Bytes from anybody reach us now."""
        self.samples += [(self.now, sample) for sample in self.vehicle.feed(peer, data, self.now)]

    def run(self, seconds: float) -> Conversation:
        end = self.now + round(seconds * NS)
        while self.now < end:
            self.now += 1_000_000
            for peer, autopilot in zip(self.peers, self.autopilots, strict=True):
                for data in autopilot.step(self.now):
                    self._travel(None, data, peer)
            while self._under_way and self._under_way[0][0] <= self.now:
                _, _, number, peer, data = heapq.heappop(self._under_way)
                if number < 0:
                    self.inject(data, peer)
                else:
                    for answer in self.autopilots[number].take(data, self.now):
                        self._travel(None, answer, self.peers[number])
            self.vehicle.tick(self.now)
        return self

    def by_unit(self) -> dict[int, list[ImuSample]]:
        found: dict[int, list[ImuSample]] = {}
        for _, sample in self.samples:
            found.setdefault(sample.unit, []).append(sample)
        return found
