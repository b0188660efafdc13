# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Python interface: what a script may pass, and what it gets back."""

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
