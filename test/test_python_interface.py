# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Python interface: what a script may pass, and what it gets back."""

import numpy as np
import pytest
from conftest import ROOT

import fdi_ros
from fdi_ros.errors import ConfigError

pytestmark = pytest.mark.usefixtures("compiled")

FAULT = {"channel": "imu_2.y", "kind": "bias", "size": 0.15, "start": 4}


@pytest.mark.parametrize(
    "fault", [FAULT, " ".join(f"{key}={value}" for key, value in FAULT.items())]
)
def test_one_fault_needs_no_list_and_a_shipped_config_no_path(fault):
    flight = ROOT / "bags" / "cone_flight"
    result = fdi_ros.replay(flight, "two_imus", fault, end=6.0)
    assert result.verdict.word == "FOUND"
    assert result.verdict.sentence == "1 of 1 injected fault detected, 1 isolated."
    # A set was declared first: channels of sets count as well.
    assert "imu_2.y" in result.verdict.channels


@pytest.mark.parametrize("name", ["px4", "px4.yaml", "config/px4.yaml"])
def test_shipped_parameter_files_are_found_by_their_names(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert fdi_ros.Config.from_file(name).hardware_id == "px4"
    (tmp_path / "px4").write_text("/**: {ros__parameters: {hardware_id: mine}}\n")
    assert fdi_ros.Config.from_file("px4").hardware_id == "mine"
    with pytest.raises(ConfigError, match="cannot read config px5"):
        fdi_ros.Config.from_file("px5")


@pytest.mark.parametrize(
    ("interval", "count", "is_refused"),
    [
        (1, 100, True),  # numbers of samples
        (10, 51, True),  # milliseconds
        (10_000, 100, True),  # microseconds
        (10_000_000, 100, False),
        (50_000, 100, False),  # a burst
        (1, 50, False),  # too few to tell
    ],
)
def test_stamps_in_another_unit_than_nanoseconds_are_refused(
    interval, count, is_refused
):
    pipeline = fdi_ros.Pipeline("two_imus")
    rates = np.random.default_rng(1).normal(0.0, 0.002, (count, 6))
    block = fdi_ros.Block(10**9 + interval * np.arange(count), rates)
    if not is_refused:
        assert len(pipeline.process(block)) == count
        return
    with pytest.raises(ConfigError, match="expected nanoseconds, about"):
        pipeline.process(block)
    assert pipeline.status().samples == 0


def test_a_block_has_the_arrays_that_the_page_on_python_names():
    block = next(fdi_ros.read(ROOT / "bags" / "cone_flight", "two_imus"))
    assert (block.stamp.dtype, block.z.dtype) == (np.int64, np.float64)
    assert block.z.shape == (len(block.stamp), 6)
    assert 0.009 < np.median(np.diff(block.stamp)) * 1e-9 < 0.011
