# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A pipeline fed with the bytes of live messages, one at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate, reported
from fdi_ros.core.alignment import is_live, new_aligner
from fdi_ros.core.decision import clear_declarations
from fdi_ros.core.path import MORE, NEVER, work
from fdi_ros.core.records import EventRow, Live
from fdi_ros.monitor.encoder import Encoder
from fdi_ros.monitor.output import Events
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.sources import Source, source_of

COUNTERS = ("duplicate", "backward", "jumped", "late", "interpolated", "missing")
"""What alignment counts of each unit beside the messages received."""


_NOTHING = np.frombuffer(b"\0", dtype=np.uint8)


class Receiver:
    """Takes messages, aligns those of several units, and has the pipeline work the samples.

    `take` and `go_on` work one sample at most; what they return says whether its messages are to
    be published, and whether to go on (`fdi_ros.core.path`).

    Parameters
    ----------
    pipeline
        Of which the settings say what arrives.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        config, n = pipeline.config, pipeline.geometry.n
        self.pipeline = pipeline
        self.source = source_of(config)
        self.aligner = new_aligner(*self.source.alignment)
        """Record of the alignment, (1,)."""
        self.live = allocate(Live)
        """Record of what was received, (1,)."""
        self.errors = [""] * len(self.source.topics)
        """Why the last malformed message of each topic was refused."""
        self._events = allocate(EventRow, n)
        self.encoder = Encoder(config.body_frame, n)
        self.fused, self.integrity = self.encoder.fused.bytes, self.encoder.integrity.bytes
        """Bytes of the messages to be published about the last sample."""
        self.live["fused_at"], self.live["integrity_at"] = self.encoder.fused.at, self.encoder.integrity.at
        self.live["channels"] = n
        self.live["inlets"]["stamp"] = self.live["inlets"]["lag"] = NEVER
        pipeline.prepare()
        self._take_over_detector()
        self.warm(self.source)

    def _take_over_detector(self) -> None:
        """Point to the detector of the pipeline, and keep it alive as long as compiled code has its addresses."""
        pipeline, detector = self.pipeline, self.pipeline.detector
        self._detector = detector
        self._records = (
            *pipeline.path,
            *(self.aligner, self.live, self._events, self.fused, self.integrity),
        )
        self._work: Callable[[], int] = partial(work, *self._records)

    def take(self, inlet: int, data: bytes, stamp: int = 0) -> int:
        """Take a message of an input topic; stamp: when it arrived, ns, for messages that carry none."""
        if self.pipeline.detector is not self._detector:
            self._take_over_detector()
        # Bytes: arrays of what can be written would be compiled once more.
        told = self.source.take(self.aligner, self.live, inlet, np.frombuffer(bytes(data), dtype=np.uint8), stamp)
        return self._work() if told & MORE else told

    def go_on(self) -> int:
        """Work the next sample."""
        if self.pipeline.detector is not self._detector:
            self._take_over_detector()
        return self._work()

    def supply(self) -> None:
        """Prepare what was asked for by `SUPPLY`."""
        self.pipeline.supply()
        self.encoder.fill_integrity(self.pipeline.core[0]["last"])

    def refused(self, unit: int, data: bytes) -> None:
        """Keep why a message was refused."""
        code = int(self.live["inlets"]["error"][0, unit])
        self.errors[unit] = self.source.explain(code, data, self.pipeline.geometry.n)

    @property
    def events(self) -> Events:
        """Changes of state that the last sample brought."""
        return Events(self._events[: self.live["events"][0]].copy())

    @property
    def shift(self) -> int:
        """To be taken off the stamp of the last sample to have that of its message, ns."""
        return int(self.live["shift"][0])

    @property
    def restarts(self) -> int:
        """How often the time of all inputs began anew."""
        return int(self.aligner["restarts"][0] + self.live["restarts"][0])

    @property
    def rate(self) -> NDArray[np.float64]:
        """Last fused rate (3,), rad/s; NaN where there was none."""
        rate: NDArray[np.float64] = self.pipeline.core["last"]["rate"][0]
        return rate if self.pipeline.core["samples"][0] else np.full(3, np.nan)

    def is_live(self, unit: int) -> bool:
        """Whether a unit is waited for."""
        return bool(is_live(self.aligner[0], unit))

    def counts(self, unit: int) -> dict[str, int]:
        """All that was not taken as it came, by kind."""
        malformed = {"malformed": int(self.live["inlets"]["malformed"][0, unit])}
        if not self.source.stamped:
            return malformed
        counters = self.aligner["units"]["counters"][0, unit]
        return malformed | {name: int(counters[name]) for name in COUNTERS}

    def warm(self, kind: Source | type[Source]) -> None:
        """Load or compile what messages of a kind need now, on copies: the first message must not wait for it."""
        aside: Any = tuple(one.copy() for one in self._records)
        with reported("the way from message to message"):
            kind.take(self.aligner.copy(), self.live.copy(), 0, _NOTHING, 0)
            work(*aside)
            self.encoder.fill_integrity(aside[0][0]["last"])
            is_live(self.aligner[0], 0)
            clear_declarations(aside[0])
