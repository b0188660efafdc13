# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Signatures of MAVLink 2, and the times of signed messages, which outlive a restart.

pymavlink checks signatures unsafely: the time in a message is kept before the signature is
checked, so one forged late message locks the true sender out, and forged link ids fill the
memory. `Verifier` replaces that check.

A signed message holds a time that only grows. MAVLink asks both sides to keep the newest
one over a restart: else messages recorded before the restart would be accepted again.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros.errors import FdiError
from fdi_ros.mavlink.kept_file import KeptFile
from fdi_ros.mavlink.protocol import NS
from fdi_ros.system.files import open_regular

#: Length of a key of MAVLink 2, bytes.
KEY_BYTES = 32
BLOCK = 13  #: Bytes of a signature: link id, time, and 6 of the digest.
EPOCH = 1_420_070_400  #: Unix time from which signatures count, s: 2015.
STEPS_PER_SECOND = 100_000  #: Steps of time in a second.
LARGEST_LAG = 60 * STEPS_PER_SECOND  #: Largest delay of a new sender, steps.
_SENDERS = 16  # largest number of links of the autopilot
_LARGEST_TIME = (1 << 48) - 1  # of a signature, steps

Sender = tuple[int, int, int]  #: Link id, system and component.


def now_in_steps(seconds: float) -> int:
    """Return the time of a signature for a Unix time."""
    return max(0, round((seconds - EPOCH) * STEPS_PER_SECOND))


def read_key(path: str) -> bytes:
    """Return a key of 32 bytes or 64 hexadecimal digits. Raises `FdiError` if others can read the file."""
    try:
        with open_regular(path) as file:
            about = os.fstat(file.fileno())
            if (
                about.st_uid not in (0, os.geteuid())
                or stat.S_IMODE(about.st_mode) & 0o077
            ):
                raise FdiError(
                    f"signing_key {path} can be read by others: chmod 600 it, and let this user own it"
                )
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
        raise FdiError(
            f"signing_key {path} is no key: expected 32 bytes, or 64 hexadecimal digits"
        )
    return key


def mark_of(key: bytes) -> str:
    """Return a mark by which the files of keys are told apart.

    It is as long as the digest in every message, so it reveals no more of the key.
    """
    return hmac.digest(key, b"signing times", "sha256")[:6].hex()


class SigningTimes(NamedTuple):
    """Times of signed messages, in steps."""

    newest: int = 0  #: The largest that was sent or accepted.
    latest: tuple[
        tuple[Sender, int], ...
    ] = ()  #: The last accepted one of each sender.


NO_TIMES = SigningTimes()  #: Before the first start.


class Verifier:
    """Checks signatures made with a key of 32 bytes, and refuses repeated messages.

    Parameters
    ----------
    key
        The key.
    times
        Times of messages before this start.
    """

    def __init__(self, key: bytes, times: SigningTimes) -> None:
        self._key = key
        self._latest = dict(times.latest)
        self._silent = set(self._latest)  # senders not heard since this start
        self.newest = times.newest  #: Largest time that was accepted, or is kept.
        #: Delay of the last message if rightly signed but too old, s.
        self.behind = 0.0

    @property
    def latest(self) -> tuple[tuple[Sender, int], ...]:
        """The last accepted time of each sender."""
        return tuple(self._latest.items())

    def accepts(self, message: bytes, system: int, component: int, now: int) -> bool:
        """Return whether a message is rightly signed and new. now: present time in steps."""
        self.behind = 0.0
        if len(message) < BLOCK + 12 or message[0] != 0xFD or not message[2] & 1:
            return False
        digest = hashlib.sha256(self._key + message[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, message[-6:]):
            return False
        time = int.from_bytes(message[-12:-6], "little")
        sender = (message[-BLOCK], system, component)
        # The clock of this computer may be behind, as without a time source.
        oldest = max(now, self.newest) - LARGEST_LAG
        if sender in self._latest:
            if time <= self._latest[sender]:
                if sender in self._silent:
                    self._note_delay(max(now, self._latest[sender]) - time)
                return False
        elif time < oldest:
            self._note_delay(oldest + LARGEST_LAG - time)
            return False
        elif not self._has_room(oldest):
            return False
        self._latest[sender] = time
        self._silent.discard(sender)
        self.newest = max(self.newest, time)
        return True

    def _note_delay(self, steps: int) -> None:
        self.behind = steps / STEPS_PER_SECOND

    def _has_room(self, oldest: int) -> bool:
        """Return whether a sender can be added. One whose messages are all too old is dropped."""
        if len(self._latest) >= _SENDERS:
            sender = min(self._latest, key=self._latest.__getitem__)
            if self._latest[sender] < oldest:
                del self._latest[sender]
        return len(self._latest) < _SENDERS


class SigningFile(KeptFile[SigningTimes]):
    """Keeps the times of messages signed with one key.

    A card wears out by writing: after a power cut, messages of the last `pause` before it
    could be repeated.
    """

    name = "signing times"
    unfit = "holds no times of signed messages: begun anew"
    pause = 5 * NS

    def __init__(self, path: Path) -> None:
        super().__init__(path, NO_TIMES)

    def decode(self, found: Any) -> SigningTimes:
        """Return the content of a file, parsed."""
        latest = tuple(
            ((int(system), int(component), int(link)), int(time))
            for system, component, link, time in found["latest"]
        )
        newest = int(found["newest"])
        times = [newest, *(time for _, time in latest)]
        if len(latest) > _SENDERS:
            raise ValueError
        if not 0 <= min(times) <= max(times) <= _LARGEST_TIME:
            raise ValueError
        return SigningTimes(newest, latest)

    def encode(self, content: SigningTimes) -> dict[str, Any]:
        """Return what is written."""
        rows = [[*sender, time] for sender, time in content.latest]
        return {"newest": content.newest, "latest": rows}
