# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The package as a user of Python or of a notebook meets it."""

import inspect
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fdi_ros
from fdi_ros.bag.samples import joined, read_block
from fdi_ros.faults.fault import parse_fault
from fdi_ros.monitor.output import time_index
from fdi_ros.replay.run import replay as run_replay
from fdi_ros.system.text import html_table, shown

FAULT = "channel=imu_2.y kind=bias size=0.15 start=28"


@pytest.fixture(scope="module")
def config():
    return fdi_ros.Config.from_file(
        Path(__file__).parents[1] / "config" / "two_imus.yaml"
    )


@given(st.lists(st.lists(st.text(max_size=20), min_size=2, max_size=2), max_size=3))
def test_a_table_shows_any_text_as_it_is(rows):
    table = ElementTree.fromstring(html_table("a < b", ("one", "two"), rows))
    said = [cell.text or "" for cell in table.iter() if cell.tag in ("td", "th")]
    assert said == ["one", "two", *(shown(text) for row in rows for text in row)]


def test_dir_shows_what_there_is():
    assert {
        "Config",
        "Event",
        "Geometry",
        "Output",
        "Pipeline",
        "read",
        "replay",
    } <= set(dir(fdi_ros))
    assert all(getattr(fdi_ros, name) is not None for name in dir(fdi_ros))


def test_a_recording_is_read_in_blocks(flight, config):
    whole = read_block(flight, config, 1.0, 9.0)
    blocks = joined(list(fdi_ros.read(flight, config, 1.0, 9.0)))
    np.testing.assert_array_equal(blocks.stamp, whole.stamp)
    np.testing.assert_array_equal(blocks.z, whole.z)
    # Without settings as inspect would set it up.
    assert sum(map(len, fdi_ros.read(str(flight), end=2.0))) == 200
    with pytest.raises(fdi_ros.FdiError, match="no recording at nowhere"):
        fdi_ros.read("nowhere")


def test_a_replay_says_what_the_verb_says(flight, config, root):
    fault = {"channel": "imu_2.y", "kind": "bias", "size": 0.15, "start": 28}
    same = run_replay(flight, config, (parse_fault(FAULT),), end=31.0).scores
    assert same.isolated == 1
    # A module of it has been imported, and it is a function all the same.
    assert "fdi_ros.replay.run" in sys.modules
    assert [*inspect.signature(fdi_ros.replay).parameters][:3] == [
        "path",
        "config",
        "faults",
    ]
    for settings, one in ((root / "config" / "two_imus.yaml", fault), (config, FAULT)):
        assert fdi_ros.replay(flight, settings, [one], end=31.0).scores == same
    assert fdi_ros.Pipeline(str(root / "config" / "two_imus.yaml")).config == config
    with pytest.raises(fdi_ros.FdiError, match="takes no 'sise', did you mean 'size'"):
        fdi_ros.replay(
            flight, config, [{"channel": "imu_2.y", "kind": "bias", "sise": 0.15}]
        )


def test_without_settings_units_that_are_turned_are_refused(flight):
    with pytest.raises(
        fdi_ros.FdiError, match=r"imu_2 is turned by 109 deg against imu_1.*fdi setup"
    ):
        fdi_ros.replay(flight)


def test_the_bundled_crash_needs_no_settings(root):
    import pandas

    result = fdi_ros.replay(root / "bags" / "copter_crash.tlog")
    [fault] = result.story.declared
    assert fault.channels == ("imu_1.x",)
    table = result.to_pandas()
    named = table[table["state"] == "FAULTY"]
    assert named["channel"].tolist() == ["imu_1.x"]
    # Its first message, and the fault 12.96 s later.
    onset = pandas.Timestamp("2026-11-23 17:10:06.268", tz="UTC") + pandas.Timedelta(
        12.96, "s"
    )
    assert 0.0 <= (named.index[0] - onset).total_seconds() < 0.2
    # Of channels that nothing checks at the end no fault is said to be seen.
    assert result.monitor.note == ""


def test_things_say_what_they_are(flight, config):
    pipeline, blocks = fdi_ros.Pipeline(config), fdi_ros.read(flight, config, end=10.0)
    outputs = [pipeline.process(block) for block in blocks]
    geometry, output, event = (
        fdi_ros.Geometry.two_triad_cone(),
        outputs[0],
        outputs[0].events[0],
    )
    block = next(iter(fdi_ros.read(flight, config, end=1.0)))
    for one in (config, geometry, pipeline, output, event, block):
        assert repr(one).startswith(f"{type(one).__name__}(")
        assert len(repr(one)) < 3000
    assert (
        repr(pipeline)
        == "Pipeline(sequential, 6 channels, 1000 samples; every channel OK)"
    )
    assert "UNCHECKED -> OK" in repr(event)
    for one, words in (
        (config, "startup_bias_duration"),
        (geometry, "g6"),
        (pipeline, "imu_2.z"),
        (output, "imu_1.x"),
    ):
        assert words in one._repr_html_()
    assert "imus.mounts" in repr(config)
    assert "imus.max_skew" not in repr(config), "what is as by default"


def test_an_output_becomes_a_table(flight, config, monkeypatch):
    import pandas

    output = fdi_ros.Pipeline(config).process(read_block(flight, config, 0.0, 5.0))
    table = output.to_pandas()
    assert table.shape == (500, 3 + 3 + 3 + 3 + 2 * 6)
    np.testing.assert_array_equal(table.index.as_unit("ns").asi8, output.stamp)
    assert str(table.index.tz) == "UTC"
    np.testing.assert_array_equal(table[["rate_x", "rate_y", "rate_z"]], output.rate)
    np.testing.assert_allclose(table["std_y"] ** 2, output.covariance[:, 1, 1])
    np.testing.assert_array_equal(table["imu_2.y.residual"], output.residual[:, 4])
    assert (table["imu_2.y.state"] == "OK").sum() == (output.state[:, 4] == 0).sum() > 0
    # Times that are no dates count from the start.
    assert time_index([5 * 10**9])[0] == pandas.Timedelta(5, "s")
    assert time_index([]).tz is not None
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(fdi_ros.FdiError, match="needs pandas"):
        output.to_pandas()
