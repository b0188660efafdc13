# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sizes from which a value that repeats is old, each from both sides and in numbers of its own."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.core.records import Core, Subset
from fdi_ros.core.repeated import (
    all_repeat,
    has_moved,
    update_repeated,
    without_coarse_steps,
)

MS = 1_000_000
NOISE = 0.002
STAMP = 10_000 * MS


def monitor(step=0.0005, rate=0.1, run_length=1.0):
    """Three channels of one unit in a vehicle that turns about x, all usable."""
    core = allocate(Core)[0]
    settings = core["settings"]
    settings["n"], settings["units"] = 3, 1
    settings["members"][0] = 7
    settings["sensors"]["n"] = 3
    settings["sensors"]["axes"][:3] = np.eye(3)
    settings["sensors"]["noise_std"][:3] = settings["largest_noise"] = NOISE
    settings["stuck_time"] = 200 * MS
    core["health"]["step"][:3] = step
    core["health"]["run_length"][:3] = run_length
    core["now"]["usable"] = core["now"]["plain"] = 7
    core["now"]["rate"][:] = [rate, 0.0, 0.0]
    core["now"]["evidence"]["stamp"] = STAMP
    return core


def all_repeat_for(core, milliseconds):
    """Return whether all values are old that have repeated for some time."""
    core["health"]["run_stamp"][:3] = STAMP - milliseconds * MS
    return bool(all_repeat(core["settings"], core["health"], core["now"], STAMP))


@pytest.mark.parametrize(("milliseconds", "old"), [(99, False), (100, True)])
def test_all_values_are_old_that_repeat_for_a_tenth_of_a_second(milliseconds, old):
    """At 0.3 noise the steps are fine, and below half a step of MAVLink: 0.5 mrad/s."""
    assert all_repeat_for(monitor(step=0.0004), milliseconds) == old


@pytest.mark.parametrize(("step", "milliseconds"), [(0.00049, 100), (0.00051, 200)])
def test_steps_beyond_half_a_step_of_mavlink_are_coarse(step, milliseconds):
    """Then all values may repeat for the longer time in which a channel is stuck."""
    assert not all_repeat_for(monitor(step=step), milliseconds - 1)
    assert all_repeat_for(monitor(step=step), milliseconds)


@pytest.mark.parametrize(("rate", "old"), [(0.0069, False), (0.0071, True)])
def test_at_rest_values_in_coarse_steps_may_repeat(rate, old):
    """At rest the rate is at most three times the noise and 1 mrad/s."""
    assert all_repeat_for(monitor(step=0.001, rate=rate), 1000) == old


@pytest.mark.parametrize(("change", "old"), [(0.0033, False), (0.0037, True)])
def test_a_unit_is_old_that_repeats_in_a_motion_of_its_noise_and_three_steps(
    change, old
):
    core = monitor(rate=0.1 + change)
    core["unit_rate"][0] = [0.1, 0.0, 0.0]
    core["health"]["run_stamp"][:3] = STAMP - 20 * MS
    assert update_repeated(core) == 7 * old


@pytest.mark.parametrize(("run_length", "old"), [(1.15, True), (1.25, False)])
def test_a_unit_that_repeats_every_fifth_value_does_so_by_habit(run_length, old):
    core = monitor(rate=0.2, run_length=run_length)
    core["health"]["run_stamp"][:3] = STAMP - 20 * MS
    assert update_repeated(core) == 7 * old


@pytest.mark.parametrize(
    ("step", "certain"), [(0.0, False), (0.00095, True), (0.00105, False)]
)
def test_values_in_steps_beyond_half_the_noise_are_not_certainly_old(step, certain):
    """Nor those whose step is not known yet."""
    core = monitor(step=step)
    found = without_coarse_steps(core["settings"], core["health"], 7)
    assert found == 7 * certain


@pytest.mark.parametrize(("disagreement", "moved"), [(0.048, True), (0.052, False)])
def test_others_that_disagree_by_half_of_their_motion_show_none(disagreement, moved):
    """A fault of one of three parallel channels leaves 0.8 of their mean as disagreement."""
    core = monitor()
    core["settings"]["n"] = 4
    core["settings"]["sensors"]["axes"][3] = [1.0, 0.0, 0.0]
    core["now"]["input"][0] = 0.1
    core["now"]["disagreement"][3] = disagreement**2
    subsets = allocate(Subset, 16)
    subsets[7]["gain"][:3] = np.eye(3)
    subsets[7]["spans"] = True
    assert has_moved(core, subsets, 7, 3, 0.02, 0.0) == moved
