# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A config to start from, written from what is in a recording."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.config.config import PARAMETERS, parameters_in
from fdi_ros.errors import BagError, ConfigError
from fdi_ros.setup.inspect import TopicReport, candidates, inspect, missing
from fdi_ros.sources import input_of
from fdi_ros.text import shown
from fdi_ros.yaml_file import parse_yaml

_NUMBERED = re.compile(r"/imu_[0-9]{1,3}")
"""Topics that name units as a config does: those of flight logs, counted as there."""
_REST = 3.0
"""Time at the start over which the bias could be learned, s."""
_MOSTLY = 0.5
"""Share of a recording in motion from which its noise is that in motion."""
_TIMEOUT = 0.1
"""What imus.timeout and health.stale_timeout are unless they are given, s."""
_BRIDGED = 4.4
"""Message intervals in a timeout: a quarter of it is the longest span that alignment draws a line across."""
_SILENT = 3.0
"""Message intervals without a value after which a channel may be called silent."""


def starting_config(path: Path, refused: str) -> str:
    """Return the text of a config to start from, as ``fdi inspect`` writes it.

    Raises
    ------
    BagError
        In these words, and with what is missing, if the recording shows no gyros.
    """
    reports, _ = inspect(path)
    if chosen := candidates(reports):
        return config_text(chosen, path)
    raise BagError(f"{refused}: {missing(reports)}")


def parameters_of(text: str) -> dict[str, Any]:
    """Return the parameters that the text of a config holds, ``{"section.field": value}``."""
    return parameters_in(parse_yaml(text, "config", ConfigError), "config")


def config_text(chosen: Sequence[TopicReport], bag: Path) -> str:
    """Write a config to start from."""
    noise, source = _noise_setting(chosen)
    rest = _REST if all(_starts_at_rest(report) for report in chosen) else 0.0
    largest = max(report.largest for report in chosen)
    kind = chosen[0].kind
    assert kind is not None
    body = _units(chosen, input_of(kind)) if kind.stamped else _array(chosen[0], input_of(kind))
    name = shown(bag.name)
    return f"""\
# inspect: made by fdi inspect from {name}, to start from. Noise and rates are measured, mounts and axes are not.
/**:
  ros__parameters:
{body}
    noise:
      noise_std: [{noise}] # inspect: rad/s a sample, {source}
      scale_std: [0.01] # inspect: share of the rate: uncalibrated scale factors and axes
      timing_std: [{0.05 / chosen[0].rate:.2g}] # inspect: s between the sampling instants: a guess

    bias:
      startup_bias_duration: {rest:g} # inspect: s; {"" if rest else "not "}at rest at the start

    detector:
      name: {PARAMETERS["detector.name"].default}
      false_alarms_per_hour: 0.001

    health:
      max_rate: [{_rounded_up(max(34.9, 1.001 * largest)):g}] # rad/s: put in what the data sheet says
{_line_if_longer(chosen, "stale_timeout", _SILENT, 60.0, f"s; the default is {_TIMEOUT:g}")}"""


def _noise_setting(chosen: Sequence[TopicReport]) -> tuple[str, str]:
    """Noise for the config, and what it is of: a recording that mostly moves is to be judged in motion."""
    share = min(report.stretches.moving_share() for report in chosen)
    moving = np.concatenate([report.stretches.moving_noise() for report in chosen])
    if share > _MOSTLY and np.isfinite(moving).all() and (moving > 0).all():
        values = ", ".join(f"{_rounded_up(float(value)):g}" for value in moving)
        return values, f"in motion ({share:.0%} of the recording), vibration included"
    quiet = np.concatenate([report.stretches.quiet_noise() for report in chosen])
    usable = np.isfinite(quiet) & (quiet > 0)
    if not usable.any():
        return "0.0025", "a guess: the recording is too short to tell"
    # A value that never changes shows no noise: that of the noisiest is taken for it.
    levels = np.where(usable, quiet, quiet[usable].max())
    values = ", ".join(f"{_rounded_up(float(value)):g}" for value in levels)
    return values, "when quietest; in motion vibration, and axes that are not quite as given, add"


def _line_if_longer(chosen: Sequence[TopicReport], name: str, intervals: float, most: float, words: str) -> str:
    """Set a time of silence that this many intervals, and nearly all gaps, stay below, where the default is shorter."""
    needed = max(max(intervals * report.interval, report.usual_longest) for report in chosen)
    return f"      {name}: {min(_rounded_up(needed), most):g} # {words}\n" if needed > _TIMEOUT else ""


def _units(chosen: Sequence[TopicReport], name: str) -> str:
    topics = ", ".join(report.topic.name for report in chosen)
    numbered = all(_NUMBERED.fullmatch(report.topic.name) for report in chosen)
    names = ", ".join(r.topic.name[1:] if numbered else f"imu_{k + 1}" for k, r in enumerate(chosen))
    slowest = min(report.rate for report in chosen)
    slow = f"s; messages come at {slowest:.3g} Hz: with the default {_TIMEOUT:g} none would be aligned between two"
    rows = ",\n".join(["          1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0"] * len(chosen)).lstrip()
    return f"""\
    input: {name}
    sample_rate: {max(report.rate for report in chosen):.4g} # Hz
    imus:
      topics: [{topics}]
      names: [{names}]
      # inspect: identity, NOT MEASURED: `fdi setup` finds how the units are turned against each other, from turns
      # about all axes. By hand: mount of each unit by rows, v_body = R v_imu. With two parallel units a fault is
      # detected and not isolated; turned against each other, or three of them, isolate it.
      mounts:
        [ {rows}]
      max_skew: {_rounded_up(0.2 / max(report.rate for report in chosen)):g} # s
{_line_if_longer(chosen, "timeout", _BRIDGED, 10.0, slow)}"""


def _array(report: TopicReport, name: str) -> str:
    return f"""\
    input: {name}
    sample_rate: {report.rate:.4g} # Hz
    channels:
      topic: {report.topic.name}
    geometry:
      # inspect: a guess, NOT MEASURED: axes, or a preset (two_triad_cone, dodecahedron, cone). `fdi calibrate` finds
      # all axes from turns about all axes, but for those of three reference channels: these must be right.
      preset: cone
      cone_channels: {report.channels}
"""


def _starts_at_rest(report: TopicReport) -> bool:
    """Whether nothing moves over the time in which biases could be learned."""
    begin = [
        rest
        for stretch, rest in zip(report.stretches.all_of_them(), report.stretches.at_rest(), strict=True)
        if stretch.first - report.first < _REST * 1e9
    ]
    return bool(begin) and all(begin)


def _rounded_up(value: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step - 1e-9) * step
