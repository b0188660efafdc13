# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which single faults a set of channels can show, and how large they must be: from geometry and noise alone."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.model.geometry import MIN_SENSITIVITY, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import max_normal_threshold, normal_isf

DETECTION = 0.99
"""Probability with which the smallest detectable error is seen in one sample."""
IN_PLANE = 0.1
"""Directions in parity space whose third singular value is below are in one plane: mounts are known no better."""
MOST_SETS = 4
"""Sets of channels that are listed."""


def smallest_detectable(geometry: Geometry, noise: NoiseModel, probability: float) -> Array:
    """Error (n,) rad/s of each channel that one sample at rest shows with probability DETECTION.

    The test is the largest normalised residual at a false-alarm probability. A channel's own residual, whitened, is
    ``w_i = error sqrt(v_i' (V R V')^-1 v_i) + N(0, 1)``; that some other one passes the threshold first is left out.
    """
    V = geometry.parity
    inverse = np.linalg.inv((V * noise.noise_std**2) @ V.T)
    gain = np.sqrt(np.maximum(np.einsum("ai,ab,bi->i", V, inverse, V), 0))
    root = np.linalg.cholesky(inverse)
    directions = (root.T @ V).T[geometry.detectable]
    threshold = max_normal_threshold(directions / np.linalg.norm(directions, axis=1)[:, None], probability)
    with np.errstate(divide="ignore"):
        return np.where(geometry.detectable, (threshold + normal_isf(1 - DETECTION)) / gain, np.inf)


def coincidences(geometry: Geometry) -> tuple[tuple[int, ...], ...]:
    """Channels of which two that fail in step look like a fault of a third, set by set.

    Their directions in parity space lie in a plane: three parallel gyros, for one, which have two differences.
    """
    directions = geometry.parity / np.maximum(np.linalg.norm(geometry.parity, axis=0), MIN_SENSITIVITY)
    sets: list[set[int]] = []
    triples = np.array(list(combinations(np.flatnonzero(geometry.isolable), 3)), dtype=np.int64).reshape(-1, 3)
    third = np.linalg.svd(directions.T[triples], compute_uv=False)[:, 2:].sum(axis=1)
    for triple in triples[third < IN_PLANE].tolist():
        # Two directions make a plane.
        known = next((found for found in sets if len(found & set(triple)) == 2), None)
        if known is None:
            sets.append(set(triple))
        else:
            known |= set(triple)
    return tuple(tuple(sorted(found)) for found in sets)


def assumption_words(geometry: Geometry) -> str:
    """Say what no data can tell and every name rests on (docs/integrity.md); empty: nothing of this kind."""
    names = geometry.channel_names
    sets = ["/".join(names[i] for i in found) for found in coincidences(geometry)]
    shown = ", ".join(sets[:MOST_SETS]) + (f" and {len(sets) - MOST_SETS} more sets" if len(sets) > MOST_SETS else "")
    return f"no two failing alike of {shown}: they would look like a fault of the third" if sets else ""


def summary_line(
    geometry: Geometry,
    noise: NoiseModel,
    probability: float,
    unit: str = "rad/s",
    factor: float = 1.0,
    agree: bool = True,
) -> str:
    """Return what a mounting can do, in one line: for the log of a node.

    Parameters
    ----------
    geometry, noise
        Of the monitor.
    probability
        False-alarm probability per sample.
    unit, factor
        Unit of the errors, and how much of it is 1 rad/s.
    agree
        The channels are not known to contradict each other: else nothing is said of what can be named.
    """
    smallest = smallest_detectable(geometry, noise.for_channels(geometry.n), probability)
    seen = smallest[np.isfinite(smallest)]
    ends = dict.fromkeys(f"{value * factor:.3g}" for value in (seen.min(), seen.max())) if len(seen) else {}
    span = f"{' to '.join(ends)} {unit}" if ends else "none"
    isolable, n = int(geometry.isolable.sum()), geometry.n
    words = f"{n} channels, GDOP {geometry.gdop:.2f}; seen in one sample at rest with {DETECTION:.0%}: errors of {span}"
    if not agree:
        return f"{words}; which faults can be isolated is not known: channels contradict each other"
    groups = [group for group in geometry.groups if len(group) > 1]
    if isolable == n:
        return f"{words}; any single fault can be isolated"
    alike = "; ".join(" or ".join(geometry.channel_names[i] for i in group) for group in groups)
    return f"{words}; {isolable} of {n} single faults can be isolated, not told apart: {alike or 'faults never seen'}"
