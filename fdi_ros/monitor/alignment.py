"""Time alignment of triads: messages of 2 to 4 streams in, samples of all channels out.

Decisions come from stamps in arrival order alone: no clock and no timer, so that a recording played through it gives
the samples that the live node formed.

Where a sample is formed: at the stamp of a message, if there is no sample between this message and the one before of
the same triad. So the samples come at the rate of the fastest triad, never faster, whatever the phases; and whoever
is left carries on where the fastest falls out. What the other triads give at that stamp:

- a message within ``max_skew`` (and nearer than half the message interval) counts as of that instant, as it is, once;
- else the line between the messages before and after, if they are near enough (`triad.MAX_BRIDGE`, `triad.MAX_STEPS`);
- else nothing: NaN, not received.

A sample is formed as soon as every live triad has spoken for its stamp: by a message within the skew, or by a later
one. The wait is at most the message interval of the slowest triad; if one falls silent, ``timeout`` by the stamps of
the others, once, and then nobody waits for it; and never longer than `MAX_PENDING` messages.
"""

from __future__ import annotations

from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError
from fdi_ros.model.block import Block
from fdi_ros.monitor.rounds import by_triad, count_regular
from fdi_ros.monitor.stamps import Counters, TimeBase
from fdi_ros.monitor.triad import NEVER, UNKNOWN, Message, Rate, Triad

MAX_PENDING = 1024
"""Messages of one triad that wait at most."""
MAX_ROUNDS = 8192
"""Rounds of a recording that are tried at once."""
_NOTHING = (float("nan"),) * 3


class Sample(NamedTuple):
    """One sample of all triads."""

    stamp: int
    """ns."""
    z: list[float]
    """(3k,) rad/s, NaN where nothing was received."""
    received: list[bool] | None
    """(3k,); None: all were."""
    shift: int = 0
    """Stamp minus that of the message, ns: 0 until the clocks of all inputs were set back."""


class Aligner:
    """Forms samples of all channels from the messages of several triads.

    Memory and time per message are bounded whatever is fed. Output stamps strictly increase.

    Parameters
    ----------
    triads
        Number of triads.
    max_skew_ns
        Stamps this close count as one instant, ns.
    timeout_ns
        A triad silent for longer than this by the stamps of the others is not waited for, ns.
    """

    def __init__(self, triads: int, max_skew_ns: int, timeout_ns: int) -> None:
        if triads < 1 or max_skew_ns < 0 or timeout_ns < 1:
            raise ConfigError(f"cannot align {triads} triads with skew {max_skew_ns} ns and timeout {timeout_ns} ns")
        self.max_skew = max_skew_ns
        self.base = TimeBase(triads, timeout_ns)
        self._triads = [Triad(timeout_ns) for _ in range(triads)]
        self._last = NEVER
        self._refused: dict[int, tuple[int, Rate]] = {}

    @property
    def counters(self) -> tuple[Counters, ...]:
        """What was counted, a triad each."""
        return tuple(triad.counters for triad in self._triads)

    def is_live(self, triad: int) -> bool:
        """Whether a triad is waited for."""
        return self.base.is_live(triad)

    def push(self, triad: int, stamp: int, rate: Rate) -> list[Sample]:
        """Take one message and return the samples that it completes, mostly none or one.

        Parameters
        ----------
        triad
            Whose message.
        stamp
            Of the message, ns.
        rate
            (3,) rad/s.
        """
        self._triads[triad].counters.received += 1
        return self._enter(triad, stamp, rate)

    def _enter(self, triad: int, stamp: int, rate: Rate) -> list[Sample]:
        own, base = self._triads[triad], self.base
        original, stamp = stamp, stamp + base.shift
        last = base.newest[triad]
        if not base.accept(triad, stamp):
            self._refused[triad] = original, rate
            return self._restart(stamp) if base.refuse(triad, stamp, own.counters) else []
        message = own.message(stamp, rate, UNKNOWN if last is None else stamp - last)
        if stamp <= self._last:
            own.counters.late += 1
            own.past = message
            return []
        own.pending.append(message)
        return self._form(NEVER if len(own.pending) <= MAX_PENDING else own.pending[1].stamp)

    def flush(self) -> list[Sample]:
        """Return what is left at the end of a recording, without waiting for anybody."""
        return self._form(UNKNOWN)

    def push_block(self, triad_of: NDArray[np.int64], stamps: NDArray[np.int64], rates: NDArray[np.float64]) -> Block:
        """Take recorded messages at once; the samples are exactly those of `push`, one by one.

        Parameters
        ----------
        triad_of
            (M,) whose message, in order of arrival.
        stamps
            (M,) ns.
        rates
            (M, 3) rad/s.
        """
        k, blocks, at, rounds, singles = len(self._triads), [], 0, 64, 2
        while at < len(stamps):
            ahead = slice(at, at + min(rounds, (len(stamps) - at) // k) * k)
            regular = self._push_rounds(triad_of[ahead], stamps[ahead], rates[ahead])
            if regular:
                blocks.append(regular)
                at += len(regular) * k
                # What is regular stays so mostly: try more at once; and the other way round.
                rounds, singles = min(2 * rounds, MAX_ROUNDS), 2
                continue
            some = slice(at, at + (singles + 1) * k)
            messages = zip(triad_of[some].tolist(), stamps[some].tolist(), rates[some].tolist(), strict=True)
            samples: list[Sample] = []
            for count, (j, stamp, rate) in enumerate(messages):
                # Rounds can only start where no message waits; what was given may begin in the middle of one.
                if count >= singles * k and not any(triad.pending for triad in self._triads):
                    break
                samples += self.push(j, stamp, tuple(rate))
                at += 1
            blocks.append(_block(samples, k))
            rounds, singles = 64, min(2 * singles, MAX_ROUNDS)
        return _joined(blocks, k)

    def _push_rounds(self, triad_of: NDArray[np.int64], stamps: NDArray[np.int64], rates: NDArray[np.float64]) -> Block:
        """Take the leading regular rounds."""
        k, base = len(self._triads), self.base
        newest = [stamp for j, stamp in zip(self._triads, base.newest, strict=True) if stamp == j.used]
        stamps = stamps + base.shift
        if len(newest) < k or not len(stamps) or any(triad.pending for triad in self._triads):
            return _block([], k)
        count, lead = count_regular(triad_of, stamps, newest, self._last, self.max_skew, base.timeout)
        if not count:
            return _block([], k)
        triad_of, stamps, rates = triad_of[: count * k], stamps[: count * k], rates[: count * k]
        at, values = by_triad(triad_of, stamps, k), by_triad(triad_of, rates, k)
        last_steps = np.diff(np.vstack([np.array(newest), at])[-3:], axis=0).tolist()
        for j, own in enumerate(self._triads):
            steps = [own.usual[1], *(step[j] for step in last_steps)]
            own.usual = (steps[-2], steps[-1])
            own.used = int(at[-1, j])
            own.past = Message(own.used, tuple(values[-1, j].tolist()), steps[-1], False)
            own.counters.received += count
        if count > 1:
            base.skip_to(at[-2].tolist())
        for j, stamp in zip(triad_of[-k:].tolist(), stamps[-k:].tolist(), strict=True):
            base.accept(j, stamp)
        self._last = int(at[-1, lead])
        return Block(at[:, lead], values.reshape(count, 3 * k))

    def _restart(self, stamp: int) -> list[Sample]:
        """Begin anew with the messages that showed that the time base has moved."""
        samples = self.flush()
        moved = self.base.restart(stamp)
        for triad in self._triads:
            triad.forget()
        self._last = NEVER
        held = sorted((self._refused[j], j) for j in moved)
        for (original, rate), j in held:
            samples += self._enter(j, original, rate)
        return samples

    def _form(self, force: int) -> list[Sample]:
        """Form what can be formed, up to the stamp `force` without waiting."""
        samples: list[Sample] = []
        while True:
            heads = [message for triad in self._triads if (message := triad.head(self._last)) is not None]
            if not heads:
                return samples
            anchor = min(heads, key=attrgetter("stamp"))
            matches = [triad.match(anchor, self.max_skew) for triad in self._triads]
            if anchor.stamp > force and not self._all_spoke(anchor.stamp, matches):
                return samples
            samples.append(self._sample(anchor.stamp, matches))

    def _all_spoke(self, stamp: int, matches: list[Message | None]) -> bool:
        return all(
            match is not None or self.base.has_reached(j, stamp) or not self.base.is_live(j)
            for j, match in enumerate(matches)
        )

    def _sample(self, stamp: int, matches: list[Message | None]) -> Sample:
        z: list[float] = []
        received: list[bool] = []
        for triad, match in zip(self._triads, matches, strict=True):
            rate = match.rate if match is not None else triad.line(stamp)
            if match is not None:
                triad.used = match.stamp
            elif rate is not None:
                triad.counters.interpolated += 1
            else:
                triad.counters.missing += 1
            z += rate or _NOTHING
            received += [rate is not None] * 3
            triad.pass_by(stamp if match is None else max(stamp, match.stamp))
        self._last = stamp
        return Sample(stamp, z, None if all(received) else received, self.base.shift)


def _block(samples: list[Sample], triads: int) -> Block:
    received = np.array([s.received or [True] * (3 * triads) for s in samples], dtype=bool).reshape(-1, 3 * triads)
    z = np.array([s.z for s in samples], dtype=np.float64).reshape(-1, 3 * triads)
    return Block(np.array([s.stamp for s in samples], dtype=np.int64), z, None if received.all() else received)


def _joined(blocks: list[Block], triads: int) -> Block:
    blocks = [block for block in blocks if len(block)] or [_block([], triads)]
    received = None
    if any(block.received is not None for block in blocks):
        received = np.vstack([np.ones(b.z.shape, dtype=bool) if b.received is None else b.received for b in blocks])
    return Block(np.concatenate([b.stamp for b in blocks]), np.vstack([b.z for b in blocks]), received)
