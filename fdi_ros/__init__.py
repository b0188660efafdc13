# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Online gyro fault detection and isolation.

Units: angular rate rad/s, angular acceleration rad/s^2, time s; stamps int64 nanoseconds. Frames: the body frame of
REP-103 (x forward, y left, z up); ``v_body = R @ v_unit`` for a unit mounted turned by R.

Symbols and shapes, used everywhere:

- n channels, 4 to 12; N samples in a block; m = n - 3 the redundancy.
- H (n, 3): row i is the sensitivity axis of channel i in the body frame; omega (3,) the body rate.
- z (N, n): measured channels, ``z = H @ omega + error`` a sample.
- S (n, n) = I - H pinv(H): maps z to the least-squares residuals r.
- V (m, n): orthonormal rows with V @ H = 0; parity vector p = V @ z; S = V.T @ V.
- w_i = r_i / (sigma sqrt(S_ii)): normalised residual; rho_ij the correlation of w_i and w_j.

Channels are numbered from 0 in code, and named in everything a person reads.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fdi_ros.config.config import Config as Config
    from fdi_ros.detectors import create_detector as create_detector
    from fdi_ros.errors import FdiError as FdiError
    from fdi_ros.model.geometry import Geometry as Geometry
    from fdi_ros.model.noise import NoiseModel as NoiseModel
    from fdi_ros.model.samples import Block as Block
    from fdi_ros.monitor.output import Event as Event
    from fdi_ros.monitor.output import Output as Output
    from fdi_ros.monitor.pipeline import Pipeline as Pipeline
    from fdi_ros.replay.run import read as read
    from fdi_ros.replay.run import replay as replay

__version__ = "0.4.0"

_HOMES = {
    "Block": "fdi_ros.model.samples",
    "Config": "fdi_ros.config.config",
    "Event": "fdi_ros.monitor.output",
    "FdiError": "fdi_ros.errors",
    "Geometry": "fdi_ros.model.geometry",
    "NoiseModel": "fdi_ros.model.noise",
    "Output": "fdi_ros.monitor.output",
    "Pipeline": "fdi_ros.monitor.pipeline",
    "create_detector": "fdi_ros.detectors",
    "read": "fdi_ros.replay.run",
}
__all__ = [*_HOMES, "replay"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: a usage error need not wait for the compiler."""
    if name == "replay":
        # The package of that name, which can be called: an import of one of its modules would replace a function.
        return importlib.import_module("fdi_ros.replay")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
