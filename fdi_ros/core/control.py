# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Commands of an operator to a running monitor."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.core.bias import LEARNING
from fdi_ros.core.compiled import compiled
from fdi_ros.core.decision import clear

DEFAULT_DURATION = 2_000_000_000
"""Of the average of the bias where the settings give none, ns."""


@compiled
def clear_declarations(core: NDArray[Any]) -> int:
    """Clear all that is declared or suspected; core (1,). Returns the channels that were declared, by their bits."""
    declared = core[0].decision.faulty | core[0].decision.ambiguous
    clear(core[0].decision, core[0].settings.decision, core[0].settings.n)
    return declared


def restart_bias(core: NDArray[Any]) -> None:
    """Begin a new average of the bias; core (1,)."""
    bias = core[0]["bias"]
    bias["duration"] = bias["duration"] or DEFAULT_DURATION
    bias["learning"], bias["started"], bias["outcome"] = True, False, LEARNING
