"""Noise of each channel in motion, from what the channels disagree about.

The rate of a sample in flight is unknown, so only the parity vector ``p = V z`` speaks, with the covariance
``C = V R V'``, R diagonal. Restricted maximum likelihood on the second moments S of p: minimise
``log |C| + tr(inv(C) S)``. Where pairs of channels cannot be told apart the likelihood is flat; there a weak prior
decides: noise is in proportion to what each channel shows by itself above the motion. Three parallel units come out as
from the variances of their differences, ``2 r_1 = d_12 + d_13 - d_23``, kept positive.

Scale and timing errors are not taken from a variance that grows with the motion: vibration does that, too. They are
taken from what is coherent with the motion: a wrong scale has the same sign wherever the rate has.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from fdi_ros.calibration.data import Array, Index
from fdi_ros.model.geometry import Geometry

ALIKE = 0.5
"""Standard deviation of the logarithm of a channel's variance about its guide, before disagreement is measured."""
REACH = 14.0
"""Logarithm of the ratio of variances that is searched to either side."""
CORRELATED = 20
"""Samples of vibration that count as one against the prior."""
LEAST_BLOCKS = 8
"""Spans of motion among which a coherent error can be told from chance."""


def channel_noise(p: Array, geometry: Geometry, own: Array | None = None) -> Array:
    """Find the standard deviation (n,) of each channel from parity vectors (K, n - 3), rad/s.

    own (n,) is what each channel shows by itself above the motion, rad/s: a guide where disagreement tells little;
    None: channels are alike.
    """
    V = geometry.parity
    guide = np.zeros(geometry.n) if own is None else 2 * np.log(np.maximum(own, 1e-9))
    S = p.T @ p / len(p)
    weight = len(p) / CORRELATED
    # v_i' v_i of each channel's variance shows; the mean over all is the start.
    middle = float(np.log(max(np.trace(S) / len(S), 1e-18)))

    def loss(theta: Array) -> tuple[float, Array]:
        R = np.exp(theta)
        C = (V * R) @ V.T
        inverse = np.linalg.inv(C)
        pulled = inverse @ S @ inverse
        off = theta - guide - (theta - guide).mean()
        value = (
            0.5 * weight * (np.linalg.slogdet(C)[1] + float(np.sum(inverse * S))) + 0.5 * float(off @ off) / ALIKE**2
        )
        slope = R * np.einsum("ai,ab,bi->i", V, inverse - pulled, V)
        return value / weight, (0.5 * weight * slope + off / ALIKE**2) / weight

    found = minimize(
        loss, np.full(geometry.n, middle), jac=True, method="L-BFGS-B", bounds=[(middle - 14, middle + 14)] * geometry.n
    )
    return np.asarray(np.exp(0.5 * found.x))


def shared_noise(std: Array, high: Array, axes: Array) -> Array:
    """Noise (n,) of the channels where vibration that some units see alike may not cancel on another day, rad/s.

    Near half the sampling rate a shift of half a sample turns what cancels into what adds. Whether two units agree
    there is a matter of when each happens to sample, and of the next start. So a channel counts with what such a shift
    would make of its own vibration, ``var(v(t) - v(t + T/2)) / 2``, though with no more than channels along its axis
    have on average: where all units agree, they are sampled together. Independent noise stays as it is.

    Parameters
    ----------
    std
        (n,) from the disagreement, rad/s.
    high
        (K, n) channels above the motion that they share, in samples that follow each other, rad/s.
    axes
        (n, 3) calibrated axes.
    """
    power = np.abs(np.fft.rfft(high * np.hanning(len(high))[:, None], axis=0)) ** 2
    change = 1 - np.cos(np.pi * np.fft.rfftfreq(len(high)))
    after_shift = (change @ power) / np.maximum(power.sum(axis=0), 1e-300) * high.var(axis=0)
    unit = axes / np.linalg.norm(axes, axis=1)[:, None]
    along = (unit @ unit.T) ** 2
    average = along @ std**2 / along.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(std**2, np.minimum(after_shift, average))))


def coherent_term(error: Array, motion: Array, block: Index) -> tuple[float, float]:
    """Share k of the motion that the errors follow, other than by chance, and its standard error.

    In each block the correlation of a channel's error with its own motion is compared with that between the errors of
    this block and the motion of others: what matches no better in time than out of time is no scale (or timing) error,
    however much it grows with the motion.

    Parameters
    ----------
    error
        (K, n) of each channel, rad/s.
    motion
        (K, n) what it may follow: rate or angular acceleration along the channel.
    block
        (K,) number of the block of each row, increasing, blocks of the same length.
    """
    edges = np.searchsorted(block, np.unique(block))
    parts = list(zip(np.split(error, edges[1:]), np.split(motion, edges[1:]), strict=True))
    rows = int(np.median([len(e) for e, _ in parts]))
    parts = [(e[:rows], w[:rows]) for e, w in parts if len(e) >= rows]
    if len(parts) < LEAST_BLOCKS:
        return 0.0, 0.0
    e, w = (np.array(side) for side in zip(*parts, strict=True))
    power_e, power_w = (e**2).sum(axis=1), np.maximum((w**2).sum(axis=1), 1e-30)
    products = np.einsum("bkn,ckn->bcn", e, w) ** 2 / np.maximum(power_e[:, None] * power_w[None], 1e-30)
    own = np.einsum("bbn->bn", products)
    others = (products.sum(axis=1) - own) / (len(e) - 1)
    # k^2 = E(excess coherent power) / E(power of the motion), over blocks and channels.
    excess = ((own - others) * power_e).sum(axis=1)
    total = float(power_w.sum())
    square = float(excess.sum()) / total
    error_of_square = float(np.std(excess) * np.sqrt(len(excess))) / total
    value = float(np.sqrt(max(square, 0.0)))
    return value, error_of_square / (2 * max(value, np.sqrt(error_of_square), 1e-12))
