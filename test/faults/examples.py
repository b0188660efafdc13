# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every kind of fault once: those of the shipped scenario, on channels and at times of choice."""

from dataclasses import replace
from pathlib import Path

from fdi_ros.faults.fault import Fault, load_scenario

SCENARIO = Path(__file__).parents[2] / "config" / "scenarios" / "every_kind.yaml"


def examples(channel: str, unit: str, start: float, stop: float) -> dict[str, Fault]:
    """A fault of each kind by its name; kinds that strike a whole unit strike that one."""
    return {
        fault.kind.name: replace(fault, channel=unit if fault.kind.whole_unit else channel, start=start, stop=stop)
        for fault in load_scenario(SCENARIO)
    }
