# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which declaration is whose doing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from monitor.streams import output_of
from replay.summaries import summary_of

from fdi_ros.core.decision import ChannelState, Reason
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Event
from fdi_ros.replay.outcomes import Evaluation, score
from fdi_ros.replay.words import fault_sections, sentences, verdict
from fdi_ros.report.layout import Severity

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
        evaluation.add(output_of(6, mine, stamp=second * 10**9, rate=rate), np.zeros((len(second), 3)))
    return evaluation.scores()


happenings = st.tuples(st.integers(0, 39), st.integers(0, 5), st.sampled_from(S))


@given(st.lists(happenings, max_size=12), st.integers(1, 40))
def test_how_the_stream_is_cut_into_outputs_changes_nothing(drawn, step):
    events = [event(second, channel, after) for second, channel, after in sorted(drawn, key=lambda one: one[0])]
    faults = [FAULT, "channel=g2 kind=drift size=1 start=15", "channel=g4,g5,g6 kind=triad_loss start=12.5 stop=30"]
    assert scored(faults, *events, step=step) == scored(faults, *events, step=1)


def test_the_error_counts_as_undetected_up_to_the_sample_of_the_declaration():
    rms = scored([FAULT], event(12, 1, S.FAULTY)).fault_effect_rad_s
    for value, seconds in ((rms.before_detection, range(10, 13)), (rms.after_detection, range(13, 20))):
        assert value == pytest.approx(np.sqrt(np.mean([k**2 + (k % 5) ** 2 for k in seconds])))


PAIR = [event(12, i, S.AMBIGUOUS, (1, 3)) for i in (1, 3)]
NAMED = event(18, 1, S.FAULTY, before=S.AMBIGUOUS)
UNSEEN = (None, None, ())


WHOSE = {
    "named": (FAULT, [event(12, 1, S.FAULTY)], (12, 12, ("g2",)), []),
    "one of a set": (FAULT, PAIR, (12, None, ("g2", "g4")), []),
    "a set, then named": (FAULT, [*PAIR, NAMED], (12, 18, ("g2", "g4")), []),
    "too early": (FAULT, [event(9, 1, S.FAULTY)], UNSEEN, [("g2", 9)]),
    "too late": (FAULT, [event(22, 1, S.FAULTY)], UNSEEN, [("g2", 22)]),
    "another channel": (FAULT, [event(12, 4, S.FAULTY)], UNSEEN, [("g5", 12)]),
    "another channel, whatever set stands with it": (FAULT, [event(11, 4, S.FAULTY, (1, 4))], UNSEEN, [("g5", 11)]),
    "named later for other reasons is not merged": (
        FAULT.replace("stop=20", ""),
        [*PAIR, NAMED, event(30, 5, S.FAULTY), event(32, 1, S.AMBIGUOUS, (1, 4))],
        (12, 18, ("g2", "g4")),
        [("g6", 30)],
    ),
    "silent, and another that is silent is no false declaration": (
        "channel=g1,g2,g3 kind=triad_loss start=10",
        [*(event(11 + i, i, S.STALE) for i in range(3)), event(30, 5, S.STALE)],
        (11, 13, ("g1", "g2", "g3")),
        [],
    ),
    "hidden for a while is not declared anew": (
        FAULT,
        [event(5, 4, S.FAULTY), event(25, 4, S.STALE, before=S.FAULTY), event(28, 4, S.FAULTY, before=S.STALE)],
        UNSEEN,
        [("g5", 5)],
    ),
    "returned is declared anew": (
        FAULT,
        [event(5, 4, S.FAULTY), event(25, 4, S.OK, before=S.FAULTY), event(28, 4, S.FAULTY)],
        UNSEEN,
        [("g5", 5), ("g5", 28)],
    ),
}
"""A fault, events, when it is detected and isolated and with which channels, and what is declared besides."""


@pytest.mark.parametrize(("faults", "events", "found", "others"), WHOSE.values(), ids=WHOSE.keys())
def test_which_declaration_is_whose_doing(faults, events, found, others):
    scores = scored([faults], *events)
    (fault,) = scores.faults
    assert (fault.detected_at_s, fault.isolated_at_s, fault.declared_channels) == found
    assert fault.isolated == (found[1] is not None)
    if found[0] is not None:
        assert fault.delay_s == found[0] - fault.start_s
        assert fault.detected_as == events[0].after.name
        assert fault.isolation_delay_s == (None if found[1] is None else found[1] - fault.start_s)
    assert [(one.channel, one.at_s) for one in scores.declared] == others


declared = st.lists(st.tuples(st.integers(10, 39), st.integers(0, 5), st.sampled_from((S.OK, S.FAULTY, S.AMBIGUOUS))))


@given(declared)
def test_what_came_of_a_fault_is_the_same_in_a_replay_and_in_a_sweep(drawn):
    """By the changes of state, and by the states of all samples."""
    drawn.sort(key=lambda one: one[0])
    state, since = np.full((40, 6), S.OK), np.arange(40) - 10.0
    for second, channel, after in drawn:
        state[second:, channel] = after
    # Of several changes at once a sample shows the last.
    last = {(second, channel): after for second, channel, after in drawn}
    (fault,) = scored(
        ["channel=g2 kind=bias size=0.2 start=10"], *(event(*at, after) for at, after in last.items())
    ).faults
    assert fault.outcome == score(state == S.FAULTY, state == S.AMBIGUOUS, 1, since).outcome.value


def test_the_healthy_channel_that_a_fault_made_faulty_is_named():
    # Two of three gyros of an axis shift alike: the third is named, and struck by nothing.
    fault = ["channel=g1,g4 kind=bias size=0.1 start=10"]
    doubted = [event(12, i, S.AMBIGUOUS, (0, 5)) for i in (0, 5)]
    told = summary_of(replace(scored(fault, *doubted, event(14, 5, S.FAULTY, before=S.AMBIGUOUS)), samples_judged=40))
    assert verdict(told) == (Severity.BAD, "1 of 1 injected fault detected, 0 isolated.")
    assert sentences(told)[-1] == "Declared faulty, and not struck by a fault: g6."


def test_sentence_and_table_agree_on_two_faults_at_once():
    faults = ["channel=g1 kind=bias size=0.05 start=10", "channel=g6 kind=bias size=0.05 start=10"]
    both = [event(12, i, S.AMBIGUOUS, (0, 3, 5)) for i in (0, 3, 5)]
    named = [event(14, i, S.FAULTY, before=S.AMBIGUOUS) for i in (0, 5)]
    told = summary_of(replace(scored(faults, *both, *named), samples_judged=40))
    assert verdict(told) == (Severity.GOOD, "2 of 2 injected faults detected, 2 isolated.")
    words = "detected after 2000 ms as one of g1, g4, g6, isolated after 4000 ms."
    last = "No other channel was declared faulty by itself; under doubt with them: g4."
    assert sentences(told) == [f"bias on g1: {words}", f"bias on g6: {words}", last]
    unjudged = summary_of(replace(told.scores, samples_judged=0))
    assert sentences(unjudged)[-1].startswith("Of the others it cannot be told: ")
    table = fault_sections(told.scores)[0].content
    assert [row[-4:] for row in table[1]] == [("2000.0 ms", "AMBIGUOUS", "4000.0 ms", "g1, g4, g6")] * 2
    unnamed = summary_of(replace(scored(faults, *both), samples_judged=40))
    assert verdict(unnamed).severity is Severity.UNKNOWN
    assert sentences(unnamed)[0].endswith("as one of g1, g4, g6, not isolated.")


def test_a_fault_on_what_is_declared_already_is_not_called_missed():
    (found,) = scored(["channel=g2 kind=bias size=1 start=30"], event(5, 1, S.FAULTY)).faults
    assert (found.declared_before, found.detected_at_s) == (True, None)
    (of_a_unit,) = scored(["channel=g1,g2,g3 kind=triad_loss start=30"], event(5, 1, S.FAULTY)).faults
    assert not of_a_unit.declared_before
