# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Is what calibration states of its own errors true: simulated vehicles of every kind of recording.

The vehicles are those of the tests (test/vehicles.py), with two and three units. axes, between, biases, delays: errors
of the estimate over its stated standard deviations, root mean square; between: of axes, what channels do not have in
common. scale within, delays within: how often the truth lies within two of the stated uncertainties of what is written.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from trials import Asked, Row

from fdi_ros.model.samples import Array
from fdi_ros.setup.calibrate import calibrate

sys.path.append(str(Path(__file__).resolve().parents[1] / "test"))

from vehicles import KINDS, vehicle

FIGURES = {
    **dict.fromkeys(("axes", "between", "biases", "delays"), ".2f"),
    **dict.fromkeys(("scale_within", "delays_within"), ".0%"),
}


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def errors_of(seed: int, kind: str, units: int) -> tuple[float, ...]:
    """Errors of one estimate, in the order of `FIGURES`."""
    made = vehicle(seed, kind, units)
    result = calibrate(made.block, made.config)
    found, n = result.estimate, len(made.axes)
    off = (found.axes - made.axes).ravel()
    # What all channels have in common is no channel's error.
    left = np.linalg.svd(
        np.kron(np.eye(n) - made.axes @ np.linalg.pinv(made.axes), np.eye(3))
    )[0][:, : 3 * (n - 3)]
    apart, known = left.T @ off, left.T @ found.axes_covariance @ left
    size, uncertainty = result.scale
    delays = (found.delay[::3] - made.late)[1:] / found.delay_std[3::3]
    return (
        rms(off / np.sqrt(np.diag(found.axes_covariance))),
        float(np.sqrt(apart @ np.linalg.solve(known, apart) / len(apart))),
        rms((found.bias - made.bias) / result.bias_std),
        rms(delays),
        float(abs(rms(apart) - size) < 2 * uncertainty),
        float((np.abs(delays) < 2).mean()),
    )


def measure(asked: Asked) -> Iterator[Row]:
    """Every kind of recording."""
    for kind in KINDS:
        for units in (2, 3):
            if asked.wants(label := f"{kind}, {units} units"):
                trials = range(asked.seed, asked.seed + asked.count(20))
                columns = np.array([errors_of(seed, kind, units) for seed in trials]).T
                means = [*map(rms, columns[:4]), *columns[4:].mean(axis=1).tolist()]
                yield label, dict(zip(FIGURES, means, strict=True))
