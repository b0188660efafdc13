# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Signatures of MAVLink 2: the key, and the check of what comes in.

The check is not pymavlink's: that one remembers the time in a message before it has looked at the signature, so one
forged message with a late time locks the true sender out, and forged link ids fill its memory.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
from pathlib import Path

from fdi_ros.errors import FdiError

KEY_BYTES = 32
BLOCK = 13
"""Bytes of a signature: link id, time, and 6 of the digest."""
EPOCH = 1_420_070_400
"""s: times count from 2015 on, in steps of 10 us."""
STEPS = 100_000
"""Of time, in a second."""
LATE = 60 * STEPS
"""A sender not heard before may be so far behind."""
_SENDERS = 16
"""Links of the one autopilot that are kept apart, at most."""


def now_in_steps(seconds: float) -> int:
    """Return the time of a signature for a Unix time."""
    return max(0, round((seconds - EPOCH) * STEPS))


def read_key(path: str) -> bytes:
    """Read a key: 32 bytes, or 64 hexadecimal digits.

    Raises
    ------
    FdiError
        If it is no key, or is not its owner's alone.
    """
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise FdiError(f"signing_key {path} is no regular file")
        with Path(path).open("rb") as file:
            about = os.fstat(file.fileno())
            if about.st_uid not in (0, os.geteuid()) or stat.S_IMODE(about.st_mode) & 0o077:
                raise FdiError(f"signing_key {path} can be read by others: chmod 600 it, and let this user own it")
            data = file.read(4096)
    except OSError as error:
        raise FdiError(f"cannot read signing_key {path}: {error.strerror}") from error
    if len(data) == KEY_BYTES:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise FdiError(f"signing_key {path} is no key: expected 32 bytes, or 64 hexadecimal digits")
    return key


class Verifier:
    """Checks signatures, and that none comes a second time.

    Parameters
    ----------
    key
        32 bytes.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._latest: dict[tuple[int, int, int], int] = {}
        """Time of the last message, by link id, system and component."""
        self.behind = 0.0
        """s by which the message of the last check was too old, though signed with the key; 0: it was not."""

    def accepts(self, message: bytes, system: int, component: int, now: int) -> bool:
        """Whether a whole message is signed with the key and new; now is the time of a signature made here now."""
        self.behind = 0.0
        if len(message) < BLOCK + 12 or message[0] != 0xFD or not message[2] & 1:
            return False
        digest = hashlib.sha256(self._key + message[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, message[-6:]):
            return False
        time = int.from_bytes(message[-12:-6], "little")
        sender = (message[-BLOCK], system, component)
        if sender in self._latest:
            if time <= self._latest[sender]:
                return False
        elif time < now - LATE:
            self.behind = (now - time) / STEPS
            return False
        elif len(self._latest) >= _SENDERS:
            return False
        self._latest[sender] = time
        return True
