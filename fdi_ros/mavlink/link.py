# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bytes from and to an autopilot over UDP, TCP or a serial line.

A link never waits. A lost one is opened again. All buffers are bounded. Only the standard
library is used, and pyserial for serial lines. pymavlink's own connections wait, print and
end processes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

from fdi_ros.errors import FdiError
from fdi_ros.mavlink.protocol import NS
from fdi_ros.system import require

MOST_AT_ONCE = 1 << 15  #: Bytes read before others get their turn.
MOST_WAITING = 1 << 12  #: Bytes that may wait to be sent: half a second of a slow line.
REOPEN_EVERY = NS  #: Time between two attempts to open a link, ns.
#: Bytes read at once, more than the longest datagram of MAVLink.
_DATAGRAM = 1 << 11
_UNREACHABLE = (
    errno.ECONNREFUSED,
    errno.EHOSTUNREACH,
    errno.ENETUNREACH,
    errno.ENETDOWN,
)
_CLOSED = "the other side has closed the connection"
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class Link:
    """Link to an autopilot, opened by a function. Messages wait whole until they can be sent."""

    def __init__(self, url: str, make: Callable[[], Any], gone: str = _CLOSED) -> None:
        self.url = url
        self.trouble = "not open yet"  #: Why the link is not open. Empty: open.
        self.dropped = 0  #: Messages that could not be sent.
        self.opened = 0  #: Number of times that the link was opened.
        self._make = make
        self._gone = gone
        self._attempt = 0
        self._handle: Any = None  # non-blocking socket or serial port
        self._waiting = bytearray()

    def _is_connected(self) -> bool:
        """Return whether the handle is usable. Raises OSError if the attempt failed."""
        if not select.select([], [self._handle], [], 0)[1]:
            return False
        if isinstance(self._handle, socket.socket):
            _raise(self._handle.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        return True

    def _read(self) -> tuple[Any, bytes]:
        """Return sender and bytes of one read. Raises BlockingIOError without data, OSError if lost."""
        # A serial line without bytes reads as empty too. Ready and empty: gone.
        if not select.select([self._handle], [], [], 0)[0]:
            raise BlockingIOError
        data = os.read(self._handle.fileno(), _DATAGRAM)
        if not data:
            raise OSError(errno.EIO, self._gone)
        return None, data

    def receive(self, now: int) -> list[tuple[Any, bytes]]:
        """Return the bytes that arrived, with their sender (None: the only one). Opens the link."""
        found: list[tuple[Any, bytes]] = []
        size = 0
        try:
            if self._handle is None:
                if now < self._attempt:
                    return []
                self._attempt = now + REOPEN_EVERY
                self.trouble = "connecting"
                self._handle = self._make()
            if self.trouble and self._is_connected():
                self.trouble = ""
                self.opened = self.opened + 1
            while not self.trouble and size < MOST_AT_ONCE:
                found.append(self._read())
                size += len(found[-1][1])
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            self._lost(error.strerror or str(error))
        self._flush()
        return found

    def send(self, data: bytes, peer: Any) -> None:
        """Send one message or drop the message."""
        if self.trouble:
            return
        if len(self._waiting) + len(data) > MOST_WAITING:
            self.dropped += 1
            return
        self._waiting += data
        self._flush()

    def _flush(self) -> None:
        if not self._waiting or self.trouble:
            return
        try:
            del self._waiting[: os.write(self._handle.fileno(), bytes(self._waiting))]
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lost(error.strerror or str(error))

    def wait(self, seconds: float) -> None:
        """Wait until the link can be read or goes on opening, at most for a time, s."""
        handles = [] if self._handle is None else [self._handle]
        try:
            # A connection becomes writable when made, and when failed.
            select.select(
                handles, handles if self.trouble or self._waiting else [], [], seconds
            )
        except (OSError, ValueError):
            self._lost("the descriptor is gone")

    def close(self) -> None:
        """Close."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                self._handle.close()
        self._handle = None

    def _lost(self, why: str) -> None:
        self.close()
        self._waiting.clear()
        self.trouble = why


class Udp(Link):
    """UDP to an address. None: to the sender."""

    def __init__(
        self, url: str, make: Callable[[], Any], address: tuple[str, int] | None
    ) -> None:
        super().__init__(url, make)
        self._address = address

    def _read(self) -> tuple[Any, bytes]:
        try:
            data, peer = self._handle.recvfrom(_DATAGRAM)
        except OSError as error:
            if error.errno not in _UNREACHABLE:
                raise
            # The report of an earlier message that nobody received.
            raise BlockingIOError from error
        return peer, data

    def send(self, data: bytes, peer: Any) -> None:
        """Send one message or drop the message."""
        to = self._address or peer
        if self._handle is None or to is None:
            return
        try:
            self._handle.sendto(data, to)
        except OSError:
            self.dropped += 1


def _open_socket(kind: str, family: int, address: tuple[str, int]) -> socket.socket:
    handle = socket.socket(
        family, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM
    )
    handle.setblocking(False)
    if kind == "tcp":
        handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _raise(handle.connect_ex(address))
    elif kind == "udpin":
        handle.bind(address)
    return handle


def _raise(code: int) -> None:
    if code not in (0, errno.EINPROGRESS):
        raise OSError(code, os.strerror(code))


def open_link(url: str) -> Link:
    """Return the link of a URL, opened at the first read. Raises `FdiError` for a wrong URL."""
    kind, _, rest = url.partition(":")
    place, _, last = rest.rpartition(":")
    number = int(last) if last.isdecimal() and len(last) < 9 else -1
    if kind == "serial" and place and number > 0:
        require("a serial line", ("serial",))
        from serial import Serial

        # Two readers of one line would each get half of the bytes.
        port = partial(
            Serial, place, number, timeout=0, write_timeout=0, exclusive=True
        )
        return Link(url, port, "the device is gone")
    if kind not in ("udpin", "udpout", "tcp") or not place or not 0 < number < 1 << 16:
        raise FdiError(f"url is {url!r}, expected {_FORMS}")
    sort = socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM
    try:
        family, _, _, _, address = socket.getaddrinfo(
            place.strip("[]"), number, type=sort
        )[0]
    except OSError as error:
        raise FdiError(
            f"url {url}: no address of {place!r}: {error.strerror}"
        ) from error
    except UnicodeError as error:
        raise FdiError(f"url {url}: {place!r} is no name of a host") from error
    to = (str(address[0]), int(address[1]))
    make = partial(_open_socket, kind, family, to)
    return (
        Link(url, make)
        if kind == "tcp"
        else Udp(url, make, None if kind == "udpin" else to)
    )
