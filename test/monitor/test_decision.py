"""Decision over time, against a plain sample-by-sample account of the same rules."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.detectors.base import Verdict
from fdi_ros.monitor.decision import Decision, Seen
from fdi_ros.monitor.health import Condition
from fdi_ros.monitor.output import Reason
from fdi_ros.settings import DecisionConfig

N = 5
SETS = [(), (0,), (1,), (0, 1), (2, 3), (0, 1, 2, 3, 4)]


def verdict(sets, isolated):
    suspects = np.zeros((len(sets), N), dtype=bool)
    for row, members in enumerate(sets):
        suspects[row, list(members)] = True
    alarm = suspects.any(axis=1)
    silent = Verdict.silent(len(sets), N)
    return silent._replace(suspects=suspects, alarm=alarm, isolated=np.asarray(isolated, dtype=bool) & alarm)


def seen(rows, held=None):
    no = np.zeros((rows, N), dtype=bool)
    held = np.zeros(rows, dtype=bool) if held is None else held
    return Seen(held=held, checked=~no, agrees=no, error=np.zeros((rows, N)), interrupted=np.zeros(rows, dtype=bool))


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
@settings(max_examples=300)
def test_first_declaration_is_the_one_found_by_hand(data, alarms, extra):
    sets, isolated = [d[0] for d in data], [d[1] for d in data]
    decision = Decision(DecisionConfig(confirm_alarms=alarms, confirm_window=alarms + extra), np.ones(N))
    stamp = np.arange(len(sets), dtype=np.int64)
    condition = np.zeros((len(sets), N), dtype=np.uint8)
    judgement = decision.judge(stamp, verdict(sets, isolated), condition, seen(len(sets)))
    expected = by_hand(sets, isolated, alarms, alarms + extra)
    if expected is None:
        assert judgement.change == len(sets)
        return
    row, kind, channels = expected
    assert judgement.change == row
    found = judgement.faulty if kind == "faulty" else judgement.ambiguous
    assert set(np.flatnonzero(found)) == channels


@pytest.mark.parametrize(("alarms", "window"), [(1, 1), (3, 5), (4, 8), (8, 8)])
def test_k_of_n_and_not_one_less(alarms, window):
    for count in (alarms - 1, alarms):
        sets = [(1,)] * count + [()] * (window - count)
        decision = Decision(DecisionConfig(confirm_alarms=alarms, confirm_window=window), np.ones(N))
        stamp = np.arange(window, dtype=np.int64)
        nothing = np.zeros((window, N), dtype=np.uint8)
        judgement = decision.judge(stamp, verdict(sets, [True] * window), nothing, seen(len(nothing)))
        assert (judgement.change == alarms - 1) == (count == alarms)
        assert judgement.change in (alarms - 1, window)


def test_a_set_narrows_down_to_the_channel_that_later_evidence_singles_out():
    decision = Decision(DecisionConfig(confirm_alarms=2, confirm_window=4), np.ones(N))
    nothing = np.zeros((1, N), dtype=np.uint8)
    history = []
    for k, (members, alone) in enumerate([((0, 1), False)] * 3 + [((1,), True)] * 3):
        judgement = decision.judge(np.array([k]), verdict([members], [alone]), nothing, seen(len(nothing)))
        decision.commit(judgement, 1, nothing, np.zeros(N, dtype=bool))
        history.append((set(np.flatnonzero(decision.ambiguous)), set(np.flatnonzero(decision.faulty))))
    assert ({0, 1}, set()) in history
    assert history[-1] == (set(), {1})
    assert decision.reasons[1] == Reason.DISAGREES


def test_a_channel_that_is_not_finite_for_long_is_declared_by_itself():
    decision = Decision(DecisionConfig(), np.ones(N))
    condition = np.array([[0, 0, Condition.NON_FINITE_LASTING, 0, 0]], dtype=np.uint8)
    judgement = decision.judge(np.array([7]), verdict([()], [False]), condition, seen(1))
    assert decision.commit(judgement, 1, condition, np.zeros(N, dtype=bool))
    assert set(np.flatnonzero(decision.faulty)) == {2}
    assert decision.reasons[2] == Reason.NON_FINITE


def test_alarms_held_off_are_suspicion_and_never_a_declaration():
    decision = Decision(DecisionConfig(confirm_alarms=2, confirm_window=4), np.ones(N))
    nothing = np.zeros((6, N), dtype=np.uint8)
    held = np.array([True, True, True, True, False, False])
    judgement = decision.judge(np.arange(6), verdict([(1,)] * 6, [True] * 6), nothing, seen(6, held))
    assert judgement.suspicion[:, 1].all()
    assert judgement.change == 5
