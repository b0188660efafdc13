# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Injected faults: what each kind does, that the cut of the stream changes nothing, and what is refused."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from replay.summaries import examples

from fdi_ros.config.settings import REQUIRED
from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Fault, Injector, fault_from, load_scenario, parse_fault
from fdi_ros.faults.kinds import FAULT_KINDS, Bias
from fdi_ros.model.samples import Block

NAMES = ("imu_1.x", "imu_1.y", "imu_1.z", "imu_2.x", "imu_2.y", "imu_2.z")
RATE = 100.0
EXAMPLES = examples("imu_2.y", "imu_2", 1.0, 3.0)


def stream(rows=500, seed=0):
    random = np.random.default_rng(seed)
    stamp = (
        1_700_000_000_000_000_000
        + np.arange(rows) * 10_000_000
        + random.integers(0, 1_000_000, rows)
    )
    return Block(stamp, random.normal(0, 1, (rows, 6)))


def inject(fault, block):
    injector = Injector(
        [parse_fault(fault) if isinstance(fault, str) else fault], NAMES
    )
    return injector.apply(block), injector


def during(block, start=1, stop=3):
    time = (block.stamp - block.stamp[0]) * 1e-9
    return time, (time >= start) & (time < stop)


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_ground_truth_covers_all_that_is_changed_and_words_of_a_fault_read_back(kind):
    assert parse_fault(str(EXAMPLES[kind])) == EXAMPLES[kind]
    block, given = stream(), stream()
    faulty, injector = inject(EXAMPLES[kind], given)
    np.testing.assert_array_equal(given.z, block.z, err_msg="it is left as it is")
    struck = injector.struck(block.stamp)
    changed = ~((faulty.z == block.z) | (np.isnan(faulty.z) & np.isnan(block.z)))
    if faulty.received is not None:
        changed |= ~faulty.received
    assert not changed[~struck].any()
    assert changed[struck].any()
    columns = [3, 4, 5] if FAULT_KINDS[kind].whole_unit else [4]
    _, active = during(block)
    np.testing.assert_array_equal(
        struck[:, columns], np.repeat(active[:, None], len(columns), axis=1)
    )


def test_each_kind_does_what_it_says():
    block = stream()
    time, active = during(block)
    true, since = block.z[active, 4], time[active] - 1
    kinds = {name: fault.kind for name, fault in EXAMPLES.items()}
    rest = np.mod(since, kinds["intermittent"].period) / kinds["intermittent"].period
    expected = {
        "bias": true + kinds["bias"].size,
        "drift": true + kinds["drift"].size * since,
        "scale": true * (1 + kinds["scale"].size),
        "stuck": np.full(len(true), block.z[~active & (time < 1), 4][-1]),
        "dropout": np.full(len(true), np.nan),
        "intermittent": true
        + kinds["intermittent"].size * (rest < kinds["intermittent"].duty),
        "saturation": np.clip(
            true, -kinds["saturation"].size, kinds["saturation"].size
        ),
        "sign": -true,
        "delay": block.z[np.flatnonzero(active) - kinds["delay"].size, 4],
        "oscillation": true
        + kinds["oscillation"].size
        * np.sin(2 * np.pi * kinds["oscillation"].frequency * since),
    }
    for kind, values in expected.items():
        faulty, _ = inject(EXAMPLES[kind], block)
        np.testing.assert_allclose(
            faulty.z[active, 4], values, rtol=1e-12, atol=1e-12, err_msg=kind
        )
    for words, value in (("size=0.3", 0.3), ("", block.z[0, 0])):
        assert set(inject(f"channel=imu_1.x kind=stuck {words}", block)[0].z[:, 0]) == {
            value
        }


def test_studies_know_a_size_of_every_kind_that_needs_one():
    for kind in FAULT_KINDS.values():
        size = kind.options().get("size")
        if size is not None and size.default is REQUIRED:
            assert kind.study_size is not None, kind.name


def test_random_kinds_have_the_stated_strength():
    rows = 100_000
    block = Block(np.arange(rows) * 10_000_000, np.zeros((rows, 6)))
    added = inject("channel=imu_1.x kind=noise size=0.1 start=0 seed=3", block)[0].z[
        :, 0
    ]
    assert (
        added
        != inject("channel=imu_1.x kind=noise size=0.1 start=0 seed=4", block)[0].z[
            :, 0
        ]
    ).all()
    assert added.std() == pytest.approx(0.1, rel=0.01)
    assert abs(added.mean()) < 4 * 0.1 / math.sqrt(rows)
    added = inject("channel=imu_1.x kind=spike size=0.5 rate=20 start=0", block)[0].z[
        :, 0
    ]
    assert set(np.unique(added)) == {-0.5, 0.0, 0.5}
    expected = rows * -math.expm1(-20 * 0.01)
    for count, mean in (
        ((added != 0).sum(), expected),
        ((added > 0).sum(), expected / 2),
    ):
        assert abs(count - mean) < 5 * math.sqrt(mean)


def test_missing_is_not_delivered_and_nan_is():
    block = stream()
    _, active = during(block)
    assert inject(EXAMPLES["dropout"], block)[0].received is None
    missing = inject(f"{EXAMPLES['dropout']}".replace("missing=0", "missing=1"), block)[
        0
    ]
    np.testing.assert_array_equal(missing.received[:, 4], ~active)
    lost = inject(EXAMPLES["triad_loss"], block)[0]
    np.testing.assert_array_equal(
        lost.received[:, 3:], np.repeat(~active[:, None], 3, axis=1)
    )
    assert lost.received[:, :3].all()


def test_several_faults_at_once_act_one_after_the_other():
    block = stream()
    faults = [
        parse_fault("channel=imu_1.x,imu_2.z kind=bias size=0.5"),
        parse_fault("channel=imu_1.x kind=sign"),
    ]
    injected = Injector(faults, NAMES).apply(block).z
    np.testing.assert_array_equal(injected[:, 0], -(block.z[:, 0] + 0.5))
    np.testing.assert_array_equal(injected[:, 5], block.z[:, 5] + 0.5)


@pytest.mark.parametrize("cuts", [[7, 9, 55, 130, 131, 260, 300], range(400)])
@pytest.mark.parametrize(
    "kinds", [*((kind,) for kind in FAULT_KINDS), tuple(FAULT_KINDS)], ids="-".join
)
def test_the_cut_of_the_stream_changes_nothing(kinds, cuts):
    block = stream(400)
    block.z[50:60, 4] = np.nan
    faults = [EXAMPLES[kind] for kind in kinds]
    whole = Injector(faults, NAMES).apply(block)
    edges = sorted({0, 400, *cuts})
    injector = Injector(faults, NAMES)
    pieces = [injector.apply(block[a:b]) for a, b in itertools.pairwise(edges)]
    np.testing.assert_array_equal(
        np.concatenate([piece.z for piece in pieces]), whole.z
    )
    received = [
        np.ones(p.z.shape, bool) if p.received is None else p.received for p in pieces
    ]
    expected = (
        np.ones(whole.z.shape, bool) if whole.received is None else whole.received
    )
    np.testing.assert_array_equal(np.concatenate(received), expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "channel=imu_9.y kind=bias size=0.2",
            "unknown channel 'imu_9.y', expected one of: imu_1.x, imu_1.y",
        ),
        (
            "channel=imu_1.x kind=wobble",
            "unknown fault kind 'wobble', expected one of: bias, drift",
        ),
        ("channel=imu_1.x kind=bias", "needs size in rad/s"),
        ("channel=imu_1.x kind=bias size=0", "size is 0"),
        (
            "channel=imu_1.x kind=bias size=nan",
            "size is nan rad/s, expected -100 to 100 rad/s",
        ),
        ("channel=imu_1.x kind=bias size=big", "size is 'big', expected a number"),
        ("channel=imu_1.x kind=bias size=1 size=2", "size is given twice"),
        (
            "channel=imu_1.x kind=bias size=1 duty=0.5",
            "takes no 'duty', expected one of: channel, kind, start, stop, seed, size",
        ),
        (
            "channel=imu_1.x kind=bias size=1 start=-1",
            "start is -1 s, expected 0 to 1e+12 s",
        ),
        (
            "channel=imu_1.x kind=bias size=1 start=5 stop=5",
            "stop is 5 s, expected more than start 5 s",
        ),
        (
            "channel=imu_1.x kind=bias size=1 seed=0.5",
            "seed is 0.5, expected a whole number",
        ),
        (
            "channel=imu_1 kind=intermittent size=1 duty=2",
            "duty is 2, expected 0.001 to 0.999",
        ),
        ("channel=imu_1.x kind=triad_loss", "strikes 1 channels, expected 3"),
        ("kind=bias size=1", "needs channel"),
        (
            {"channel": "imu_1.x", "kind": "bias", "size": 1, "start": None},
            "start is None, expected a number",
        ),
        ({"channel": "imu_1.x", "kind": "bias", "size": 10**400}, "expected a number"),
        (
            {"channel": "imu_1.x", "kind": "bias", "size": 1, 5: 3},
            "takes no '5', expected one of: channel",
        ),
        ("channel=imu_1.x kind bias", "'kind' is not of the form key=value"),
        (
            "channel=imu_1.x,kind=bias, size=1",
            "expected blanks between, 'channel=imu_1.x kind=bias size=1'",
        ),
        ("channel=imu_1.x kind=bias sise=1", "did you mean 'size'?"),
        ("chanel=imu_1.x kind=bias", "did you mean 'channel' instead of 'chanel'?"),
        ("channel=imu_1.x kid=bias", "did you mean 'kind' instead of 'kid'?"),
    ],
)
def test_a_wrong_fault_is_refused_in_one_line(text, words):
    with pytest.raises(FaultError) as caught:
        Injector(
            [parse_fault(text) if isinstance(text, str) else fault_from(text)], NAMES
        )
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scenario_file_is_validated_as_the_command_line_is(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text(
        "faults:\n  - {channel: imu_2.y, kind: bias, size: 0.2, start: 30, stop: 60}\n"
    )
    assert load_scenario(path) == (Fault("imu_2.y", Bias(0.2), 30.0, 60.0),)
    path.write_text(
        "faults:\n  - {channel: imu_2.y, kind: bias, size: 0.2}\n  - {channel: imu_2.y, kind: bias}\n"
    )
    with pytest.raises(
        FaultError, match=r"scenario\.yaml, fault 2: fault bias needs size in rad/s"
    ):
        load_scenario(path)
    for text, words in (
        ("faults: 3", "no list 'faults'"),
        ("faults: [3]", "expected keys"),
    ):
        path.write_text(text)
        with pytest.raises(FaultError, match=words):
            load_scenario(path)
    with pytest.raises(FaultError, match="cannot read scenario"):
        load_scenario(tmp_path / "none.yaml")


@settings(max_examples=200, deadline=None)
@given(
    items=st.dictionaries(
        st.sampled_from(
            ["channel", "kind", "size", "start", "stop", "seed", "duty", "rate"]
        ),
        st.one_of(
            st.sampled_from(["imu_1.x", "bias", "spike"]),
            st.floats(),
            st.integers(),
            st.none(),
            st.booleans(),
        ),
    )
)
def test_whatever_stands_in_a_scenario_gives_a_fault_or_one_line(items):
    message = ""
    try:
        assert math.isfinite(fault_from(items).start)
    except FaultError as error:
        message = str(error)
    assert "\n" not in message
