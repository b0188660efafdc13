# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which declaration is whose doing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.core.states import ChannelState, Reason
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Event, Output
from fdi_ros.replay.evaluate import GRACE, Evaluation, Rms
from fdi_ros.replay.summary import (
    BiasResult,
    MonitorResult,
    ProtectionLevel,
    SampleRate,
    StreamResult,
    Summary,
    fault_table,
    verdict,
)

S = ChannelState
GEOMETRY = Geometry.two_triad_cone()
FAULT = "channel=g2 kind=bias size=0.2 start=10 stop=20"


def event(second, channel, after, group=None, before=S.OK):
    return Event(round(second * 1e9), channel, before, after, Reason.DISAGREES, group or (channel,), 0.1)


def scored(faults, *events, seconds=40, step=40):
    """Score a monitor that says nothing but these events: a sample per second, fused rates, `step` samples at once."""
    injector = Injector([parse_fault(text) for text in faults], GEOMETRY.channel_names, 0)
    evaluation = Evaluation(injector, GEOMETRY)
    for k in range(0, seconds, step):
        mine = tuple(e for e in events if k <= round(e.stamp * 1e-9) < k + step)
        second = np.arange(k, min(k + step, seconds))
        rate = np.column_stack([second, second % 5, 0 * second])
        evaluation.add(Output.from_arrays(6, mine, stamp=second * 10**9, rate=rate), np.zeros((len(second), 3)))
    return evaluation.scores()


def summary_of(scores):
    """The summary of a replay of which nothing but the scores matters."""
    levels = ProtectionLevel((None,) * 3, (None,) * 3)
    monitor = MonitorResult((), (), (), BiasResult("fixed", ()), "", levels, 1.0)
    stream = StreamResult(SampleRate(100.0, 100.0), 0, {}, 0, {}, ())
    return Summary("bag", "sequential", scores, monitor, stream, 1.0)


happenings = st.tuples(st.integers(0, 39), st.integers(0, 5), st.sampled_from(S))


@given(st.lists(happenings, max_size=12), st.integers(1, 40))
def test_how_the_stream_is_cut_into_outputs_changes_nothing(drawn, step):
    events = [event(second, channel, after) for second, channel, after in sorted(drawn, key=lambda one: one[0])]
    faults = [FAULT, "channel=g2 kind=drift size=1 start=15", "channel=g4,g5,g6 kind=triad_loss start=12.5 stop=30"]
    assert scored(faults, *events, step=step) == scored(faults, *events, step=1)


def test_the_error_counts_as_undetected_up_to_the_sample_of_the_declaration():
    rms = scored([FAULT], event(12, 1, S.FAULTY)).fault_effect_rad_s
    assert rms.before_detection == pytest.approx(np.sqrt(np.mean([k**2 + (k % 5) ** 2 for k in (10, 11, 12)])))
    after = range(13, 20)
    assert rms.after_detection == pytest.approx(np.sqrt(np.mean([k**2 + (k % 5) ** 2 for k in after])))


def test_an_error_that_no_method_can_give_is_not_there():
    odd = Event(12 * 10**9, 1, S.OK, S.FAULTY, Reason.DISAGREES, (1,), float("nan"))
    assert scored([FAULT], odd).events[0].error is None


def test_a_fault_that_is_named_is_detected_and_isolated():
    summary = scored([FAULT], event(12, 1, S.FAULTY))
    (found,) = summary.faults
    assert (found.detected_at_s, found.delay_s, found.isolated) == (12, 2, True)
    assert (found.declared_channels, found.detected_as) == (("g2",), "FAULTY")
    assert summary.declared == ()


def test_one_of_a_set_is_detected_and_isolated_when_it_is_named():
    group = (1, 3)
    summary = scored([FAULT], event(12, 1, S.AMBIGUOUS, group), event(12, 3, S.AMBIGUOUS, group))
    (found,) = summary.faults
    assert (found.isolated, found.declared_channels) == (False, ("g2", "g4"))
    assert summary.declared == ()
    later = event(15, 1, S.FAULTY, before=S.AMBIGUOUS)
    (found,) = scored([FAULT], event(12, 1, S.AMBIGUOUS, group), event(12, 3, S.AMBIGUOUS, group), later).faults
    assert (found.isolated, found.detected_at_s, found.isolated_at_s) == (True, 12, 15)


@pytest.mark.parametrize(
    ("odd", "name"),
    [
        (event(9, 1, S.FAULTY), "g2"),
        (event(20 + GRACE + 1, 1, S.FAULTY), "g2"),
        (event(12, 4, S.FAULTY), "g5"),
        # Whatever set stands with it.
        (event(11, 4, S.FAULTY, (1, 4)), "g5"),
    ],
)
def test_a_declaration_at_another_time_or_of_another_channel_is_no_detection(odd, name):
    summary = scored([FAULT], odd)
    assert summary.faults[0].detected_at_s is None
    assert [(one.channel, one.at_s) for one in summary.declared] == [(name, odd.stamp * 1e-9)]


def test_what_is_named_later_for_other_reasons_is_not_merged():
    group = tuple(event(12, i, S.AMBIGUOUS, (1, 3)) for i in (1, 3))
    later = (event(18, 1, S.FAULTY, before=S.AMBIGUOUS), event(30, 5, S.FAULTY), event(32, 1, S.AMBIGUOUS, (1, 4)))
    (found,) = scored([FAULT.replace("stop=20", "")], *group, *later).faults
    assert found.declared_channels == ("g2", "g4")
    assert (found.delay_s, found.isolation_delay_s) == (2, 8)


def test_sentence_and_table_agree_on_two_faults_at_once():
    faults = ["channel=g1 kind=bias size=0.05 start=10", "channel=g6 kind=bias size=0.05 start=10"]
    both = [event(12, i, S.AMBIGUOUS, (0, 3, 5)) for i in (0, 3, 5)]
    named = [event(14, i, S.FAULTY, before=S.AMBIGUOUS) for i in (0, 5)]
    lines = verdict(summary_of(replace(scored(faults, *both, *named), samples_judged=40)))
    assert lines == [
        "2 of 2 injected faults detected, 2 isolated.",
        "bias on g1: detected after 2000 ms as one of g1, g4, g6, isolated after 4000 ms.",
        "bias on g6: detected after 2000 ms as one of g1, g4, g6, isolated after 4000 ms.",
        "No other channel was declared faulty by itself; under doubt with them: g4.",
    ]
    table = fault_table(scored(faults, *both, *named).faults)
    assert table.count("2000.0 ms  4000.0 ms       g1 g4 g6") == 2
    assert verdict(summary_of(replace(scored(faults, *both), samples_judged=40)))[1].endswith(
        "as one of g1, g4, g6, not isolated."
    )


def test_a_silent_channel_is_found_by_being_stale_and_is_no_false_declaration():
    lost = "channel=g1,g2,g3 kind=triad_loss start=10"
    summary = scored([lost], *(event(11 + i, i, S.STALE) for i in range(3)), event(30, 5, S.STALE))
    (found,) = summary.faults
    assert (found.detected_at_s, found.isolated_at_s, found.isolated) == (11, 13, True)
    assert summary.declared == ()


def test_what_is_hidden_for_a_while_is_not_declared_anew():
    again = (event(25, 4, S.STALE, before=S.FAULTY), event(28, 4, S.FAULTY, before=S.STALE))
    assert len(scored([FAULT], event(5, 4, S.FAULTY), *again).declared) == 1
    returned = (event(25, 4, S.OK, before=S.FAULTY), event(28, 4, S.FAULTY))
    assert len(scored([FAULT], event(5, 4, S.FAULTY), *returned).declared) == 2


def test_a_fault_on_what_is_declared_already_is_not_called_missed():
    summary = scored(["channel=g2 kind=bias size=1 start=30"], event(5, 1, S.FAULTY))
    (found,) = summary.faults
    assert found.declared_before
    assert found.detected_at_s is None


def test_rms_of_vectors():
    rms = Rms()
    assert rms.value is None
    rms.add(np.array([[3.0, 4.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert rms.value == pytest.approx(np.sqrt(25 / 2))
