# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every trial protocol by name, and the one function that a worker runs."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import numpy as np

from fdi_ros.experiments.json_form import from_json
from fdi_ros.experiments.protocol import Block, Stage, TrialProtocol
from fdi_ros.experiments.protocols.delay import Delay
from fdi_ros.experiments.protocols.flight import Flight
from fdi_ros.experiments.protocols.residual_search import ResidualSearch
from fdi_ros.experiments.protocols.snapshot import Snapshot
from fdi_ros.scoring import Tally

AnyProtocol = TrialProtocol[Any, Any, Any, Any]

PROTOCOLS: dict[str, type[AnyProtocol]] = {
    protocol.kind: protocol for protocol in (ResidualSearch, Snapshot, Delay, Flight)
}
SCHEMAS = {name: protocol.schema for name, protocol in PROTOCOLS.items()}


def run_block(kind: str, settings: str, preparation: str, seed: int, block: Block) -> Tally:
    """Run one block of trials, wherever: the result depends on the arguments alone.

    Parameters
    ----------
    kind
        Key of `PROTOCOLS`.
    settings, preparation
        As JSON: detectors are built once per process for each.
    seed
        Of the study; the block's own generator is spawned from it.
    block
        Which one.
    """
    protocol, prepared = _built(kind, settings, preparation)
    rng = np.random.default_rng(
        np.random.SeedSequence(seed, spawn_key=(block.section, block.stage, block.cell, block.block))
    )
    cell = protocol.cells(block.stage)[block.cell]
    if block.stage == Stage.PREPARING:
        return protocol.prepare(cell, block.trials, rng)
    return protocol.run(cell, block.trials, rng, prepared)


@lru_cache(maxsize=16)
def _built(kind: str, settings: str, preparation: str) -> tuple[AnyProtocol, Any]:
    """Build a protocol; its preparation is None in the first stage."""
    protocol = PROTOCOLS[kind](json.loads(settings))
    known = json.loads(preparation)
    return protocol, None if known is None else from_json(protocol.preparation_type, known)
