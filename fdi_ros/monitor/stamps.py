"""Which stamps of several streams may be believed: one time base for all, judged from the stamps alone."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass
class Counters:
    """What one triad has delivered; messages, but for the last two, which count samples."""

    received: int = 0
    duplicate: int = 0
    """The stamp of the message before, again."""
    backward: int = 0
    """An older stamp than the message before."""
    jumped: int = 0
    """A stamp ahead of all triads by more than the timeout."""
    late: int = 0
    """A stamp that the samples had already gone past."""
    interpolated: int = 0
    missing: int = 0

    def as_dict(self) -> dict[str, int]:
        """All counts by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class TimeBase:
    """The common time of all streams, and its restart when all of them leave it.

    A stamp belongs to the base if it is at most ``timeout`` from the newest stamp of any stream. One stream that
    leaves the base has a bad clock: it is refused. When all leave it together (a recording that starts anew, a
    clock set back, a pause of the whole system) the base itself has moved. That is believed once every live stream
    stands within ``timeout`` of the others there, or one has gone on there for ``timeout`` while none spoke in the
    old base. After a step back, ``shift`` is added to every stamp, so that the base never runs backwards.

    Parameters
    ----------
    streams
        Number of streams.
    timeout
        Silent for longer than this by the stamps of the others: not live, ns.
    """

    def __init__(self, streams: int, timeout: int) -> None:
        self.timeout = timeout
        self.shift = 0
        """Added to the stamps of the messages, ns; 0 until all clocks were set back."""
        self.restarts = 0
        self.frontier: int | None = None
        """Newest stamp of any stream."""
        self.newest: list[int | None] = [None] * streams
        """Newest stamp of each stream."""
        self.lag = [0] * streams
        """How far the last message of each stream stood behind the frontier, ns."""
        self._start = 0
        self._off: dict[int, tuple[int, int]] = {}

    def accept(self, stream: int, stamp: int) -> bool:
        """Enter a stamp (with the shift); False if it is no newer than the stream's last or outside the base."""
        last = self.newest[stream]
        if self.frontier is None:
            self.frontier = self._start = stamp
        lag = self.frontier - stamp
        if (last is not None and stamp <= last) or not -self.timeout <= lag <= self.timeout:
            return False
        self.newest[stream] = stamp
        self.lag[stream] = max(lag, 0)
        if lag < 0:
            self.frontier = stamp
        if self._off:
            self._off.clear()
        return True

    def refuse(self, stream: int, stamp: int, counters: Counters) -> bool:
        """Count a stamp that was not accepted; True if with it all streams have left the base."""
        frontier, last = self.frontier or 0, self.newest[stream]
        if stamp == last:
            counters.duplicate += 1
            self._off.pop(stream, None)
            return False
        if last is not None and stamp < last:
            counters.backward += 1
        elif stamp > frontier:
            counters.jumped += 1
        else:
            counters.late += 1
            self.lag[stream] = frontier - stamp
        if abs(stamp - frontier) <= self.timeout:
            self._off.pop(stream, None)
            return False
        first, before = self._off.get(stream, (stamp, stamp))
        if not 0 <= stamp - before <= self.timeout:
            first = stamp
        self._off[stream] = (first, stamp)
        if stamp - first >= self.timeout:
            return True
        live = [j for j in range(len(self.newest)) if self.is_live(j)]
        return len(live) > 1 and all(j in self._off and abs(self._off[j][1] - stamp) <= self.timeout for j in live)

    def restart(self, stamp: int) -> list[int]:
        """Begin anew at a stamp outside the base; the streams that stand there."""
        moved = [j for j, (_, last) in self._off.items() if abs(last - stamp) <= self.timeout]
        frontier = self.frontier or 0
        # Nothing accepted from now on can be as old as the old frontier.
        original = stamp - self.shift
        forward = max(original, frontier + 2 * self.timeout + 1)
        self.shift = forward - original
        self.frontier = self._start = forward
        self.newest = [None] * len(self.newest)
        self.restarts += 1
        self._off.clear()
        return moved

    def skip_to(self, newest: list[int]) -> None:
        """Enter stamps of all streams that are known to belong to the base."""
        self.newest = list(newest)
        self.frontier = max(newest)

    def has_reached(self, stream: int, stamp: int) -> bool:
        """Whether a stream has spoken at or after a stamp."""
        newest = self.newest[stream]
        return newest is not None and newest >= stamp

    def is_live(self, stream: int) -> bool:
        """Whether a stream has spoken within the timeout, by the stamps of the others."""
        newest = self.newest[stream]
        return (self.frontier or 0) - (self._start if newest is None else newest) <= self.timeout
