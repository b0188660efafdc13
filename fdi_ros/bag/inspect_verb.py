"""``fdi inspect``: a table of the topics and a config to start from."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fdi_ros.bag.inspect import TopicReport, candidates, inspect
from fdi_ros.bag.outputs import check_target, whole_file
from fdi_ros.bag.samples import IMU
from fdi_ros.bag.tables import table

_REST = 3.0
"""Time at the start over which the bias could be learned, s."""
_REST_SPREAD = 5.0
"""At rest: the values of that time spread by no more than this many times the noise."""


def run(arguments: argparse.Namespace) -> int:
    """Print what is there."""
    if arguments.write is not None:
        check_target(arguments.write, arguments.force, [arguments.bag])
    reports, damage = inspect(arguments.bag)
    sys.stdout.write(topics_text(reports, damage))
    chosen = candidates(reports)
    if not chosen:
        sys.stdout.write("\nno config: two Imu topics, or one array of 4 to 12 values, are needed\n")
        return 0
    config = config_text(chosen, arguments.bag)
    sys.stdout.write(f"\n{config}")
    if arguments.write is not None:
        with whole_file(arguments.write) as path:
            path.write_text(config, encoding="utf-8")
    return 0


def topics_text(reports: Sequence[TopicReport], damage: Sequence[str]) -> str:
    """Lay out the topics."""
    head = ("topic", "type", "messages", "rate", "gaps", "longest gap", "gyros?")
    rows = [
        (
            report.topic.name,
            report.topic.type or "unknown",
            str(report.received),
            f"{report.rate:.1f} Hz",
            str(report.gaps),
            f"{1000 * report.longest:.1f} ms",
            _gyros(report),
        )
        for report in reports
    ]
    return table(head, rows) + "".join(f"note: damaged recording: {line}\n" for line in damage)


def _gyros(report: TopicReport) -> str:
    if not report.could_be_gyros:
        return "no"
    noise = report.noise()
    words = [f"{report.channels} values", f"noise {np.max(noise, initial=0.0, where=np.isfinite(noise)):.2g} rad/s"]
    words += [f"up to {report.largest():.3g} rad/s"]
    words += [f"{report.malformed} malformed"] if report.malformed else []
    words += [f"{report.backward} stamps do not increase"] if report.backward else []
    return ", ".join(words)


def config_text(chosen: Sequence[TopicReport], bag: Path) -> str:
    """Write a config to start from."""
    noise = np.concatenate([report.noise() for report in chosen])
    usable = noise[np.isfinite(noise) & (noise > 0)]
    level = _rounded_up(float(usable.max())) if len(usable) else 0.0025
    rest = 3.0 if all(_starts_at_rest(report) for report in chosen) else 0.0
    largest = max(report.largest() for report in chosen)
    body = _imus(chosen) if chosen[0].topic.type == IMU else _array(chosen[0])
    return f"""\
# To start from, made from {bag.name}. Noise and rate are measured; what no recording of unknown motion tells is marked.
/**:
  ros__parameters:
{body}
    noise:
      noise_std: [{level:g}] # rad/s, from the first messages; in motion axes that are not quite as given add to it
      scale_std: [0.01] # share of the rate: uncalibrated scale factors and axes; smaller after a calibration
      timing_std: [{0.05 / chosen[0].rate if chosen[0].rate else 0.0:.2g}] # s between the sampling instants: a guess

    bias:
      startup_bias_duration: {rest:g} # s; {"at rest at the start" if rest else "not at rest at the start: give fixed"}

    detector:
      name: likelihood_ratio
      false_alarms_per_hour: 0.001

    health:
      max_rate: [{_rounded_up(max(34.9, 1.001 * largest)):g}] # rad/s, from the data sheet
"""


def _imus(chosen: Sequence[TopicReport]) -> str:
    topics = ", ".join(report.topic.name for report in chosen)
    names = ", ".join(f"imu_{k + 1}" for k in range(len(chosen)))
    rows = ",\n".join(["          1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0"] * len(chosen)).lstrip()
    return f"""\
    input: imus
    sample_rate: {max(report.rate for report in chosen):.4g} # Hz
    imus:
      topics: [{topics}]
      names: [{names}]
      # NOT KNOWN from a recording of unknown motion: mount of each unit by rows, v_body = R v_imu. With two parallel
      # units a faulty axis is seen and not named; turned against each other, or three of them, name it.
      mounts:
        [ {rows}]
      max_skew: {_rounded_up(0.2 / max(report.rate for report in chosen)):g} # s
"""


def _array(report: TopicReport) -> str:
    return f"""\
    input: channels
    sample_rate: {report.rate:.4g} # Hz
    channels:
      topic: {report.topic.name}
    geometry:
      # NOT KNOWN from a recording of unknown motion: axes, or a preset (two_triad_cone, dodecahedron, cone).
      preset: cone
      cone_channels: {report.channels}
"""


def _starts_at_rest(report: TopicReport) -> bool:
    values = np.vstack(report.values)[: max(2, int(_REST * report.rate))]
    if not np.isfinite(values).all():
        return False
    return bool((values.std(axis=0) <= _REST_SPREAD * report.noise()).all())


def _rounded_up(value: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step - 1e-9) * step
