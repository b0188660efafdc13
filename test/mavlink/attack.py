# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Hostile packets upon a MAVLink port, in kinds: what the storms send."""

from __future__ import annotations

import contextlib
import socket

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

KINDS = ("garbage", "cut messages", "any message of others", "any message in its name", "strangers", "flood")
BURST, FLOOD = 20, 2000
"""Packets sent at once."""
NUMBERS = sorted(number for number in mavlink.mavlink_map if number >= 0)


class Attacker:
    """Sends packets to a UDP port of this machine; seed: of all choices."""

    def __init__(self, port: int, seed: int = 0) -> None:
        self._port, self._draw = port, np.random.default_rng(seed)
        self._own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec = mavlink.MAVLink(None)

    def burst(self, kind: str) -> int:
        """Send some packets of a kind; how many."""
        if kind == "strangers":
            # Each from a port of its own.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                return self._send(stranger, [self._packet(kind)])
        made = [self._packet(kind) for _ in range(BURST if kind != "flood" else FLOOD // 10)]
        return self._send(self._own, made if kind != "flood" else 10 * made)

    def close(self) -> None:
        self._own.close()

    def _send(self, source: socket.socket, packets: list[bytes]) -> int:
        for packet in packets:
            with contextlib.suppress(OSError):
                source.sendto(packet, ("127.0.0.1", self._port))
        return len(packets)

    def _packet(self, kind: str) -> bytes:
        """Make any message of the dialect, with any payload, of a system; or what is none."""
        draw, codec = self._draw, self._codec
        if kind == "garbage":
            return draw.bytes(int(draw.integers(1, 400)))
        message = mavlink.mavlink_map[int(draw.choice(NUMBERS))]
        payload = draw.bytes(message.unpacker.size) if draw.random() < 0.7 else bytes(message.unpacker.size)
        codec.srcSystem = 1 if kind in ("any message in its name", "strangers") else int(draw.integers(2, 256))
        codec.srcComponent, codec.seq = int(draw.choice([1, 1, 1, draw.integers(256)])), int(draw.integers(256))
        data = bytes(mavlink.MAVLink_message(message.id, message.msgname)._pack(codec, message.crc_extra, payload))
        return data[: int(draw.integers(1, len(data)))] if kind == "cut messages" else data
