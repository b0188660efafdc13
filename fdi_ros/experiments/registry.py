"""Every kind of trial by name, and the one function that a worker runs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from fdi_ros.experiments.experiment import Block, Experiment
from fdi_ros.experiments.protocols.delay import Delay
from fdi_ros.experiments.protocols.flight import Flight
from fdi_ros.experiments.protocols.residual_search import ResidualSearch
from fdi_ros.experiments.protocols.snapshot import Snapshot
from fdi_ros.experiments.tally import Tally

EXPERIMENTS: dict[str, type[Experiment]] = {
    experiment.kind: experiment for experiment in (ResidualSearch, Snapshot, Delay, Flight)
}
SCHEMAS = {name: experiment.schema for name, experiment in EXPERIMENTS.items()}


def run_block(kind: str, settings: str, found: str, seed: int, block: Block) -> Tally:
    """Run one block of trials, wherever: the result depends on the arguments alone.

    Parameters
    ----------
    kind
        Key of `EXPERIMENTS`.
    settings, found
        As JSON: detectors are built once a process for each.
    seed
        Of the study; the block's own generator is spawned from it.
    block
        Which one.
    """
    experiment, known = _prepared(kind, settings, found)
    rng = np.random.default_rng(
        np.random.SeedSequence(seed, spawn_key=(block.section, block.stage, block.cell, block.block))
    )
    return experiment.run(block.stage, experiment.cells(block.stage)[block.cell], block.trials, rng, known)


@lru_cache(maxsize=16)
def _prepared(kind: str, settings: str, found: str) -> tuple[Experiment, Mapping[str, Any]]:
    return EXPERIMENTS[kind](json.loads(settings)), json.loads(found)
