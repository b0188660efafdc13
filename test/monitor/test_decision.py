# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decision over time, against a plain account of the same rules over whole windows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.compiling.compiled import allocate
from fdi_ros.core.decision import WHY, decide
from fdi_ros.core.records import Decision, Evidence, PathSettings
from fdi_ros.core.subsets import is_in, mask_of

N = 5
SETS = [(), (0,), (1,), (0, 1), (2, 3), (0, 1, 2, 3, 4)]
ALL = mask_of(range(N))


class Decider:
    """The decision, told of one sample after the other."""

    def __init__(self, alarms, window, latch=True):
        self.limits, self.own, self.seen = allocate(PathSettings), allocate(Decision), allocate(Evidence)
        given = {"n": N, "alarms": alarms, "window": window, "latch": latch, "clean_time": 10, "mean_limit": 0.5}
        for name, value in given.items():
            self.limits[name] = value
        self.stamp = 0

    def take(self, members, isolated=False, **more):
        """Whether a sample whose alarm names these channels changes what is declared."""
        self.stamp += 1
        told = {"suspected": mask_of(members), "isolated": isolated and bool(members), "judged": True, "checked": ALL}
        for name in self.seen.dtype.names:
            self.seen[name] = {**told, "stamp": self.stamp, **more}.get(name, 0)
        return decide(self.limits[0], self.own[0], self.seen[0])

    def channels(self, name):
        return {i for i in range(N) if is_in(i, int(self.own[name][0]))}

    @property
    def why(self):
        return [WHY[k] for k in self.own["why"][0, :N]]


def by_hand(sets, isolated, alarms, window):
    """First row that declares, and what: ('faulty' | 'ambiguous', channels)."""
    for row in range(len(sets)):
        recent = range(max(0, row - window + 1), row + 1)
        named = [sum(i in sets[k] for k in recent) for i in range(N)]
        alone = [sum(i in sets[k] and isolated[k] for k in recent) for i in range(N)]
        half = -(-alarms // 2)
        faulty = {i for i in range(N) if named[i] >= alarms and alone[i] >= half}
        often = {i for i in range(N) if named[i] >= half}
        if not faulty and max(named) >= alarms and len(often) == 1:
            faulty = often
        if faulty:
            return row, "faulty", faulty
        if max(named) >= alarms:
            return row, "ambiguous", often
        if sum(bool(sets[k]) for k in recent) == window:
            return row, "ambiguous", often or {i for i in range(N) if named[i]}
    return None


@given(
    data=st.lists(st.tuples(st.sampled_from(SETS), st.booleans()), min_size=1, max_size=40),
    alarms=st.integers(1, 5),
    extra=st.integers(0, 5),
)
@settings(max_examples=150)
def test_first_declaration_is_the_one_found_by_hand(data, alarms, extra):
    decider, window = Decider(alarms, alarms + extra), alarms + extra
    expected = by_hand(*zip(*data, strict=True), alarms, window)
    declares = next((row for row, sample in enumerate(data) if decider.take(*sample)), None)
    if expected is None:
        assert declares is None
    else:
        row, kind, channels = expected
        assert (declares, decider.channels(kind)) == (row, channels)


def test_a_set_narrows_down_to_the_channel_that_later_evidence_singles_out():
    decider, history = Decider(2, 4), []
    for members, alone in [((0, 1), False)] * 3 + [((1,), True)] * 3:
        decider.take(members, isolated=alone)
        history.append((decider.channels("ambiguous"), decider.channels("faulty")))
    assert ({0, 1}, set()) in history
    assert history[-1] == (set(), {1})
    assert decider.why[1] == "disagrees"


def test_alarms_held_off_are_suspicion_and_never_a_declaration():
    decider, changes = Decider(2, 4), []
    for held in (True, True, True, True, False, False):
        changes.append(decider.take((1,), isolated=True, held=held))
        assert decider.channels("suspicion") == {1}
    assert changes == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("samples", "returns"),
    [
        ([(True, 0.4)] * 20, 9),
        ([(True, 0.6)] * 20, None),
        ([(k != 6, 0.0) for k in range(30)], 16),
        # Sample by sample a small fault agrees with the others; its mean does not, until it has ended.
        ([(True, 3.0)] * 200, None),
    ],
)
def test_a_declared_channel_returns_after_the_clean_time_if_its_mean_error_is_small(samples, returns):
    decider = Decider(1, 1, latch=False)
    assert decider.take((3,), isolated=True)
    changes = [decider.take((), agrees=ALL if agrees else 0, error=np.eye(12)[3] * size) for agrees, size in samples]
    assert np.flatnonzero(changes).tolist() == ([] if returns is None else [returns])
    assert decider.channels("faulty") == ({3} if returns is None else set())
    changes = [decider.take((), agrees=ALL, error=np.zeros(12)) for _ in range(20)]
    assert sum(changes) == (returns is None)
