"""Samples through the pipeline as they come, and how long each took."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator

import numpy as np

from fdi_ros.model.block import Block
from fdi_ros.monitor.alignment import Sample
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline

SINGLY = 3
"""Up to so many are worked one by one: the pipeline has a short way for a single sample on which nothing happens."""
REMEMBERED = 4096
"""Samples whose latency is remembered."""


class Live:
    """Works what has arrived since it was last looked at as one block.

    Idle, that is one sample at once; behind, it is many, at little more than the cost of one. How a stream is cut
    into blocks changes nothing in what the pipeline says.

    Parameters
    ----------
    pipeline
        The monitor.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.samples = 0
        self.shift = 0
        """Of the last sample: to be taken off its stamp to have that of its message, ns."""
        self.last_rate = np.full(3, np.nan)
        """Last fused rate (3,), rad/s; NaN where there was none."""
        self._waiting: list[tuple[Sample, int]] = []
        self._latency: deque[int] = deque(maxlen=REMEMBERED)

    def take(self, sample: Sample) -> None:
        """Take a sample."""
        self._waiting.append((sample, time.perf_counter_ns()))

    def work(self) -> Iterator[tuple[Output, list[int]]]:
        """Work what waits: outputs, each with the shifts of its stamps, cut after every sample that brought events."""
        waiting, self._waiting = self._waiting, []
        size = 1 if len(waiting) <= SINGLY else len(waiting)
        for first in range(0, len(waiting), size):
            yield from self._work(waiting[first : first + size])

    def _work(self, waiting: list[tuple[Sample, int]]) -> Iterator[tuple[Output, list[int]]]:
        row = 0
        for output in self.pipeline.steps(_block([sample for sample, _ in waiting])):
            part = waiting[row : row + len(output)]
            row += len(output)
            self.samples += len(output)
            self.shift = part[-1][0].shift
            self.last_rate = output.rate[-1]
            yield output, [sample.shift for sample, _ in part]
            now = time.perf_counter_ns()
            self._latency.extend(now - begun for _, begun in part)

    def latency(self) -> tuple[float, float]:
        """Median and 99th percentile of the time from the arrival of a sample to its publication, s."""
        if not self._latency:
            return 0.0, 0.0
        ordered = sorted(self._latency)
        return ordered[len(ordered) // 2] / 1e9, ordered[min(len(ordered) - 1, len(ordered) * 99 // 100)] / 1e9


def _block(samples: list[Sample]) -> Block:
    stamp = np.array([sample.stamp for sample in samples], dtype=np.int64)
    z = np.array([sample.z for sample in samples])
    if all(sample.received is None for sample in samples):
        return Block(stamp, z)
    everything = [True] * z.shape[1]
    received = np.array([everything if s.received is None else s.received for s in samples], dtype=bool)
    return Block(stamp, z, received)
