# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Smallest sets of channels that check one another: the circuits of the sensitivity axes.

A circuit is a set of channels whose axes are linearly dependent while those of every proper subset are not: two
parallel axes, three in a plane, four in space. It carries exactly one check ``nu . z`` that no body rate moves.
Every statement about bounded errors follows from the circuits alone (vertices of the dual linear programmes):

- bounds b hold for a set of channels iff ``|nu . z| <= sum b |nu|`` for every circuit inside the set;
- the error of channel i lies within ``(nu . z +- sum_{j != i} b_j |nu_j|) / nu_i`` for every circuit whose other
  members keep their bounds, and the tightest of these is the whole truth.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEPENDENT = 1e-9
"""Volume spanned by unit axes below which they count as dependent."""


def circuits(axes: Array) -> Array:
    """Return the checks of all circuits, (C, n): at most four entries of a row are not zero, and row @ axes = 0.

    Parameters
    ----------
    axes
        Sensitivity axes, (n, 3).
    """
    norm = np.linalg.norm(axes, axis=1)
    unit = axes / norm[:, None]
    lines, planes, spaces = _pairs(unit), _triples(unit), _quadruples(unit)
    planes = planes[~_contains(planes, lines)]
    spaces = spaces[~_contains(spaces, np.vstack([lines, planes]))]
    return np.vstack([lines, planes, spaces]) / norm


def _pairs(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 2)))
    a, b = unit[index[:, 0]], unit[index[:, 1]]
    dependent = np.linalg.norm(np.cross(a, b), axis=1) < DEPENDENT
    values = np.column_stack([np.ones(len(index)), -np.sign((a * b).sum(axis=1))])
    return _scatter(index[dependent], values[dependent], len(unit))


def _triples(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 3)))
    a, b, c = unit[index[:, 0]], unit[index[:, 1]], unit[index[:, 2]]
    dependent = np.abs((a * np.cross(b, c)).sum(axis=1)) < DEPENDENT
    # In a plane with unit normal N: (b x c . N) a + (c x a . N) b + (a x b . N) c = 0.
    products = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)[dependent]
    longest = np.linalg.norm(products, axis=2).argmax(axis=1)
    normal = products[np.arange(len(products)), longest]
    values = (products * normal[:, None, :]).sum(axis=2)
    length = np.linalg.norm(values, axis=1)
    spans = length > DEPENDENT  # else all three are parallel: every pair of them is a circuit already
    return _scatter(index[dependent][spans], values[spans] / length[spans, None], len(unit))


def _quadruples(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 4)))
    signs, others = (1, -1, 1, -1), ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))
    rows = unit[index]
    volumes = [sign * np.linalg.det(rows[:, list(three)]) for sign, three in zip(signs, others, strict=True)]
    values = np.stack(volumes, axis=1)
    whole = (np.abs(values) >= DEPENDENT).all(axis=1)
    return _scatter(index[whole], values[whole], len(unit))


def _scatter(index: NDArray[np.intp], values: Array, n: int) -> Array:
    rows = np.zeros((len(index), n))
    np.put_along_axis(rows, index, values, axis=1)
    return rows


def _contains(rows: Array, smaller: Array) -> NDArray[np.bool_]:
    """(len(rows),): whether the support of a row contains that of one of the smaller circuits."""
    support, small = (rows != 0).astype(np.int64), (smaller != 0).astype(np.int64)
    contains: NDArray[np.bool_] = (support @ small.T == small.sum(axis=1)).any(axis=1)
    return contains
