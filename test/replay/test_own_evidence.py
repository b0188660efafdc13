# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence against a channel that is left out, drawn to the end of a recording."""

import numpy as np
import pytest
from monitor.streams import output_of

from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.own_evidence import OwnEvidence

STD = 0.004  # rad/s
VARIANCE = 1e-6  # of the fused rate, (rad/s)^2


def evidence_of(size, faulty, cuts, rate=50):
    """Return times, evidence of each of six channels, and the largest evidence."""
    geometry = Geometry.from_triads([np.eye(3)] * 2)
    time = np.arange(len(faulty)) / rate
    residual = np.random.default_rng(5).normal(0, STD, (len(time), 6))
    residual[:, 4] += size * np.asarray(faulty)
    state = np.full((len(time), 6), int(ChannelState.OK))
    state[:, 4] = np.where(faulty, int(ChannelState.FAULTY), int(ChannelState.OK))
    own = OwnEvidence(geometry, np.full(6, STD), list("abcdef"))
    for rows in np.split(np.arange(len(time)), cuts):
        fields = {"stamp": (time[rows] * 1e9).astype(np.int64), "state": state[rows]}
        fields |= {"covariance": VARIANCE * np.eye(3), "residual": residual[rows]}
        own.add(time[rows], output_of(6, **fields))
    own.finish()
    at, values, _ = own.store.spans()
    return at, values, own.peak


@pytest.mark.parametrize("cuts", [[], [137, 138, 901], list(range(0, 1000, 7))])
def test_the_evidence_stands_while_the_fault_lasts_however_blocks_are_cut(cuts):
    """A fault of 0.1 rad/s from 6 to 14 s of 20 s, left out in that time."""
    time = np.arange(1000) / 50
    at, values, peak = evidence_of(0.1, (time >= 6) & (time < 14), cuts)
    assert at.tolist() == (np.arange(20) + 0.5).tolist()
    shown = np.isfinite(values)
    assert shown[:, [0, 1, 2, 3, 5]].sum() == 0
    assert at[shown[:, 4]].tolist() == (np.arange(6, 14) + 0.5).tolist()
    expected = 0.1**2 / (2 * (STD**2 / 50 + VARIANCE))
    assert values[6:14, 4] == pytest.approx(expected, rel=0.1)
    assert peak == np.nanmax(values)


def test_the_evidence_is_gone_once_the_fault_is():
    """A channel that agrees again, but is still left out."""
    _, values, peak = evidence_of(0.0, np.ones(1000, bool), [])
    assert peak < 8.0
    assert np.nanmean(values[:, 4]) < 1.0


def test_a_long_recording_has_bounded_evidence():
    at, values, _ = evidence_of(0.1, np.ones(9000, bool), [], rate=1)
    assert len(at) <= 2000
    assert np.isfinite(values[:, 4]).all()
