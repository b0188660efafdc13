# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All that a monitor needs compiled, compiled or loaded now: ahead of time for images, tests and the first message."""

from __future__ import annotations

import contextlib
import sys

import numpy as np

from fdi_ros.compiling.compiled import Callback
from fdi_ros.config.config import Config
from fdi_ros.core.alignment import Alignment
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate, MessageError, as_batch
from fdi_ros.detectors import DETECTORS, create_detector, detector_class
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import Receiver
from fdi_ros.sources import SOURCES, Source

_FEW = 5
"""Channels for a method that does not take six."""


def warm_detector(name: str) -> None:
    """Compile or load what one detector needs.

    Raises
    ------
    DetectorError
        If there is none of that name.
    """
    method = detector_class(name)
    for one in vars(sys.modules[method.__module__]).values():
        if isinstance(one, Callback):
            _ = one.address
    geometry = Geometry.cone(_FEW) if method.refuses(6) else Geometry.two_triad_cone()
    create_detector(name, geometry, NoiseModel(0.01, bound=0.04)).detect(np.zeros((1, geometry.n)))


def warm_blocks() -> None:
    """Compile or load what takes blocks of samples and of messages through any monitor."""
    pipeline = _any_pipeline()
    n = pipeline.geometry.n
    # Nothing is prepared for a set of channels that lacks two.
    z = np.array([[0.0] * n, [np.nan] * 2 + [0.0] * (n - 2)])
    pipeline.process(Block(np.arange(2), z))
    pipeline.status()
    pipeline.reset()
    alignment = Alignment(2, 1, 1)
    alignment.push_block(np.arange(2), np.zeros(2, dtype=np.int64), np.zeros((2, 3)))
    alignment.flush()
    alignment.is_live(0)


def warm_messages() -> None:
    """Compile or load what takes single messages through any monitor, and what reads and writes messages."""
    receiver = Receiver(_any_pipeline())
    for kind in SOURCES.values():
        receiver.warm(kind)
        warm_codec(kind)
    ChannelsTemplate(1).fill([0.0])
    ImuTemplate("").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9)


def warm_codec(kind: type[Source] | Source) -> None:
    """Compile or load the reading and patching of messages of a kind from Python."""
    # What is compiled does not depend on what the bytes are.
    kind.announced(*as_batch(b"\0"))
    kind.decode(*as_batch(b"\0"), 1)
    with contextlib.suppress(MessageError):
        kind.patch(b"\0", (0.0,))


def _any_pipeline() -> Pipeline:
    return Pipeline(Config.from_parameters({"detector.name": next(iter(DETECTORS))}))
