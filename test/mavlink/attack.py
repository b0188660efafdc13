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


class Attacker:
    """Sends packets to a port of this machine.

    Parameters
    ----------
    port
        UDP port of the node.
    seed
        Of all choices.
    """

    def __init__(self, port: int, seed: int = 0) -> None:
        self._to = ("127.0.0.1", port)
        self._draw = np.random.default_rng(seed)
        self._own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec = mavlink.MAVLink(None)
        self._numbers = sorted(number for number in mavlink.mavlink_map if number >= 0)

    def burst(self, kind: str) -> int:
        """Send some packets of a kind; how many."""
        if kind == "strangers":
            # Each from a port of its own.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                self._send(stranger, self._message(1))
            return 1
        packets = [self._packet(kind) for _ in range(BURST if kind != "flood" else FLOOD // 10)]
        packets *= 1 if kind != "flood" else 10
        for packet in packets:
            self._send(self._own, packet)
        return len(packets)

    def close(self) -> None:
        self._own.close()

    def _send(self, source: socket.socket, packet: bytes) -> None:
        with contextlib.suppress(OSError):
            source.sendto(packet, self._to)

    def _packet(self, kind: str) -> bytes:
        draw = self._draw
        if kind == "garbage":
            return draw.bytes(int(draw.integers(1, 400)))
        if kind == "cut messages":
            data = self._message(int(draw.integers(256)))
            return data[: int(draw.integers(1, len(data)))]
        if kind == "any message in its name":
            return self._message(1)
        return self._message(int(draw.integers(2, 256)))

    def _message(self, system: int) -> bytes:
        """Make any message of the dialect, with any payload, of a system."""
        draw, codec = self._draw, self._codec
        kind = mavlink.mavlink_map[int(draw.choice(self._numbers))]
        payload = draw.bytes(kind.unpacker.size) if draw.random() < 0.7 else bytes(kind.unpacker.size)
        codec.srcSystem, codec.srcComponent = system, int(draw.choice([1, 1, 1, draw.integers(256)]))
        codec.seq = int(draw.integers(256))
        made = mavlink.MAVLink_message(kind.id, kind.msgname)
        return bytes(made._pack(codec, kind.crc_extra, payload))
