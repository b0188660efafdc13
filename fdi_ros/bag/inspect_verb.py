"""``fdi inspect``: a table of the topics and a config to start from."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from fdi_ros.bag.inspect import TopicReport, candidates, inspect
from fdi_ros.bag.outputs import check_target, say_written, whole_file, words
from fdi_ros.bag.samples import IMU, Array
from fdi_ros.bag.tables import table
from fdi_ros.config import PARAMETERS, Config
from fdi_ros.errors import ConfigError
from fdi_ros.parameter import parameters_in
from fdi_ros.text import shown
from fdi_ros.yaml_file import parse_yaml

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


def run(arguments: argparse.Namespace) -> int:
    """Print what is there."""
    if arguments.write is not None:
        check_target(arguments.write, arguments.force, [arguments.bag])
    reports, damage = inspect(arguments.bag)
    out = words([arguments.write])
    out.write(recording_text(reports, arguments.bag))
    out.write(topics_text(reports, damage))
    chosen = candidates(reports)
    if not chosen:
        out.write("\nno config: two Imu topics, or one array of 4 to 12 values, are needed\n")
        return 0
    config = config_text(chosen, arguments.bag)
    try:
        Config.from_parameters(parameters_in(parse_yaml(config, "config", ConfigError), "config"))
    except ConfigError as error:
        # A recording may say anything: what the node would refuse is not offered.
        out.write(f"\nno config: {shown(error)}\n")
        return 0
    out.write(f"\n{config}")
    if arguments.write is not None:
        with whole_file(arguments.write) as path:
            path.write_text(config, encoding="utf-8")
        say_written([arguments.write])
    return 0


def recording_text(reports: Sequence[TopicReport], bag: Path) -> str:
    """Say when it was recorded, how long it is and how large."""
    seen = [report for report in reports if report.received]
    files = [path for path in bag.rglob("*") if path.is_file()] if bag.is_dir() else [bag]
    size = sum(path.stat().st_size for path in files) / 1e6
    if not seen:
        return f"{shown(bag.name)}: no messages, {size:.1f} MB\n\n"
    first, last = min(report.first for report in seen), max(report.last for report in seen)
    return f"{shown(bag.name)}: {(last - first) * 1e-9:.1f} s from {_date(first)}, {size:.1f} MB\n\n"


def _date(ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(ns * 1e-9, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, OSError, ValueError):
        return f"{ns * 1e-9:.1f} s"


def topics_text(reports: Sequence[TopicReport], damage: Sequence[str]) -> str:
    """Lay out the topics."""
    head = ("topic", "type", "messages", "rate", "gaps", "longest gap", "noise at its quietest", "in motion", "gyros?")
    rows = [
        (
            shown(report.topic.name),
            shown(report.topic.type or "unknown"),
            str(report.received),
            f"{report.rate:.1f} Hz",
            str(report.gaps),
            f"{1000 * report.longest:.1f} ms",
            *(
                _noise(values) if report.could_be_gyros else "-"
                for values in (report.quiet_noise(), report.moving_noise())
            ),
            _gyros(report),
        )
        for report in reports
    ]
    notes = [f"note: damaged recording: {line}\n" for line in damage]
    if any(report.could_be_gyros for report in reports):
        notes.insert(0, "noise: rad/s a sample of each value, vibration included; motion slower than it is left out\n")
    return table(head, rows) + "".join(notes)


def _noise(values: Array) -> str:
    if not np.isfinite(values).any():
        return "-"
    if len(values) > 3:
        return f"{np.nanmin(values):.2g} to {np.nanmax(values):.2g}"
    return " ".join(f"{value:.2g}" for value in values)


def _gyros(report: TopicReport) -> str:
    if not report.could_be_gyros:
        return "no"
    words = [f"{report.channels} values, up to {report.largest:.3g} rad/s"]
    words += [f"in motion for {report.moving_share():.0%}"] if report.all_stretches() else []
    words += [f"{report.not_finite} not finite"] if report.not_finite else []
    words += [f"{report.malformed} malformed"] if report.malformed else []
    words += [f"{report.backward} stamps do not increase"] if report.backward else []
    return ", ".join(words)


def config_text(chosen: Sequence[TopicReport], bag: Path) -> str:
    """Write a config to start from."""
    noise, told = _noise_setting(chosen)
    rest = _REST if all(_starts_at_rest(report) for report in chosen) else 0.0
    largest = max(report.largest for report in chosen)
    body = _imus(chosen) if chosen[0].topic.type == IMU else _array(chosen[0])
    name = shown(bag.name)
    return f"""\
# To start from, made from {name}. Noise and rate are measured; what no recording of unknown motion tells is marked.
/**:
  ros__parameters:
{body}
    noise:
      noise_std: [{noise}] # inspect: rad/s a sample, {told}
      scale_std: [0.01] # inspect: share of the rate: uncalibrated scale factors and axes
      timing_std: [{0.05 / chosen[0].rate:.2g}] # inspect: s between the sampling instants: a guess

    bias:
      startup_bias_duration: {rest:g} # inspect: s; {"" if rest else "not "}at rest at the start

    detector:
      name: {PARAMETERS["detector.name"].default}
      false_alarms_per_hour: 0.001

    health:
      max_rate: [{_rounded_up(max(34.9, 1.001 * largest)):g}] # rad/s, from the data sheet
{_stale(chosen)}"""


def _noise_setting(chosen: Sequence[TopicReport]) -> tuple[str, str]:
    """Noise for the config, and what it is of: a recording that mostly moves is to be judged in motion."""
    share = min(report.moving_share() for report in chosen)
    moving = np.concatenate([report.moving_noise() for report in chosen])
    if share > _MOSTLY and np.isfinite(moving).all() and (moving > 0).all():
        values = ", ".join(f"{_rounded_up(float(value)):g}" for value in moving)
        return values, f"in motion ({share:.0%} of the recording), vibration included"
    quiet = np.concatenate([report.quiet_noise() for report in chosen])
    usable = quiet[np.isfinite(quiet) & (quiet > 0)]
    if not len(usable):
        return "0.0025", "a guess: the recording is too short to tell"
    level = f"{_rounded_up(float(usable.max())):g}"
    return level, "when quietest; in motion vibration, and axes that are not quite as given, add"


def _timeout(chosen: Sequence[TopicReport], intervals: float) -> float:
    """Time of silence that this many intervals, and nearly all gaps, stay below, s."""
    return max(max(intervals * report.interval, report.usual_longest) for report in chosen)


def _stale(chosen: Sequence[TopicReport]) -> str:
    needed = _timeout(chosen, _SILENT)
    if needed <= _TIMEOUT:
        return ""
    return f"      stale_timeout: {min(_rounded_up(needed), 60.0):g} # s; the default is {_TIMEOUT:g}\n"


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
{_imus_timeout(chosen)}"""


def _imus_timeout(chosen: Sequence[TopicReport]) -> str:
    needed = _timeout(chosen, _BRIDGED)
    if needed <= _TIMEOUT:
        return ""
    slowest = min(report.rate for report in chosen)
    words = f"s; messages come at {slowest:.3g} Hz: with the default {_TIMEOUT:g} none would be aligned between two"
    return f"      timeout: {min(_rounded_up(needed), 10.0):g} # {words}\n"


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
    """Whether nothing moves over the time in which biases could be learned."""
    begin = [
        rest
        for stretch, rest in zip(report.all_stretches(), report.at_rest(), strict=True)
        if stretch.first - report.first < _REST * 1e9
    ]
    return bool(begin) and all(begin)


def _rounded_up(value: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step - 1e-9) * step
