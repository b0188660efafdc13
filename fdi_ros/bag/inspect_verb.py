"""``fdi inspect``: a table of the topics and a config to start from."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.bag.inspect import BELIEVED, TopicReport, candidates, inspect, missing
from fdi_ros.bag.outputs import Kind, check_targets, whole_file
from fdi_ros.bag.raw import Int
from fdi_ros.bag.said import say, write_json, wrote
from fdi_ros.bag.samples import IMU, Array
from fdi_ros.bag.tables import table
from fdi_ros.config import PARAMETERS, Config
from fdi_ros.errors import ConfigError
from fdi_ros.limits import LINE
from fdi_ros.parameter import parameters_in
from fdi_ros.study.unit import RADIANS, Unit, unit_of
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
    targets = [arguments.json, arguments.write]
    kinds = (Kind.JSON, Kind.PARAMETERS)
    check_targets(list(zip(targets, kinds, strict=True)), arguments.force, [arguments.bag])
    reports, damage = inspect(arguments.bag)
    say(arguments, recording_text(reports, arguments.bag))
    say(arguments, topics_text(reports, damage, unit_of(arguments.degrees)))
    config, why = _config(reports, arguments.bag)
    write_json(arguments.json, {**recording_figures(reports, arguments.bag, damage), "config": config})
    if config is None:
        wrote(arguments, [arguments.json])
        if arguments.write is not None:
            raise ConfigError(f"{arguments.write} is not written: {why}")
        say(arguments, f"\n{why}\n")
        return 0
    say(arguments, f"\n{config}")
    if arguments.write is not None:
        with whole_file(arguments.write) as path:
            path.write_text(config, encoding="utf-8")
    wrote(arguments, targets)
    return 0


def _config(reports: Sequence[TopicReport], bag: Path) -> tuple[str | None, str]:
    """Return a config to start from, or none and why."""
    chosen = candidates(reports)
    if not chosen:
        return None, f"no config: {missing(reports)}"
    config = config_text(chosen, bag)
    try:
        Config.from_parameters(parameters_in(parse_yaml(config, "config", ConfigError), "config"))
    except ConfigError as error:
        # A recording may say anything: what the node would refuse is not offered.
        return None, f"no config: {shown(error, LINE)}"
    return config, ""


def recording_text(reports: Sequence[TopicReport], bag: Path) -> str:
    """Say when it was recorded, how long it is and how large."""
    size = _size(bag) / 1e6
    if (span := _span(reports)) is None:
        return f"{shown(bag.name)}: no messages, {size:.1f} MB\n\n"
    first, last = span
    date = _date(first)
    begun = f"{date:%Y-%m-%d %H:%M:%S} UTC" if date is not None else f"{first * 1e-9:.1f} s"
    return f"{shown(bag.name)}: {(last - first) * 1e-9:.1f} s from {begun}, {size:.1f} MB\n\n"


def recording_figures(reports: Sequence[TopicReport], bag: Path, damage: Sequence[str]) -> dict[str, Any]:
    """All figures by name, SI units: for programs."""
    span = _span(reports)
    date = None if span is None else _date(span[0])
    return {
        "bag": str(bag),
        "start_ns": None if span is None else span[0],
        "start": None if date is None else date.isoformat(),
        "duration_s": None if span is None else (span[1] - span[0]) * 1e-9,
        "size_bytes": _size(bag),
        "damage": list(damage),
        "topics": [_topic_figures(report) for report in reports],
    }


def _topic_figures(report: TopicReport) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "name": report.topic.name,
        "type": report.topic.type,
        "messages": report.received,
        "rate_hz": report.rate,
        "gaps": report.gaps,
        "longest_gap_s": report.longest,
        "malformed": report.malformed,
        "could_be_gyros": report.could_be_gyros,
    }
    if report.could_be_gyros:
        figures |= {
            "values": report.channels,
            "not_finite": report.not_finite,
            "beyond_all_rates": report.beyond,
            "repeated": report.repeated,
            "stamps_not_increasing": report.backward,
            "largest": report.largest,
            "quiet_noise": report.quiet_noise(),
            "moving_noise": report.moving_noise(),
            "moving_share": report.moving_share(),
        }
    return figures


def _span(reports: Sequence[TopicReport]) -> tuple[int, int] | None:
    """Return the times of recording of the first and the last message, ns."""
    seen = [report for report in reports if report.received]
    return (min(report.first for report in seen), max(report.last for report in seen)) if seen else None


def _size(bag: Path) -> int:
    """Bytes of all files."""
    paths = [path for path in bag.rglob("*") if path.is_file()] if bag.is_dir() else [bag]
    return sum(path.stat().st_size for path in paths)


def _date(ns: int) -> datetime | None:
    try:
        return datetime.fromtimestamp(ns * 1e-9, timezone.utc)
    except (OverflowError, OSError, ValueError):
        return None


def topics_text(reports: Sequence[TopicReport], damage: Sequence[str], unit: Unit = RADIANS) -> str:
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
                _noise(values * unit.factor) if report.could_be_gyros else "-"
                for values in (report.quiet_noise(), report.moving_noise())
            ),
            _gyros(report, unit),
        )
        for report in reports
    ]
    notes = [f"note: damaged recording: {line}\n" for line in damage]
    if any(report.could_be_gyros for report in reports):
        notes.insert(
            0, f"noise: {unit.name} a sample of each value, vibration included; motion slower than it is left out\n"
        )
    return table(head, rows) + "".join(notes)


def _noise(values: Array) -> str:
    if not np.isfinite(values).any():
        return "-"
    if len(values) > 3:
        return f"{np.nanmin(values):.2g} to {np.nanmax(values):.2g}"
    return " ".join(f"{value:.2g}" for value in values)


def _gyros(report: TopicReport, unit: Unit) -> str:
    if not report.could_be_gyros:
        return "no"
    largest = f"up to {report.largest * unit.factor:.3g} {unit.name}"
    words = [f"{report.channels} values", largest if math.isfinite(report.largest) else "none of them a rate"]
    words += ["never all of them usable"] if math.isfinite(report.largest) and not report.complete else []
    words += [f"in motion for {report.moving_share():.0%}"] if report.all_stretches() else []
    words += [f"not finite: {_counts(report, report.not_finite)}"] if report.not_finite.any() else []
    beyond = f"beyond {BELIEVED * unit.factor:.3g} {unit.name}"
    words += [f"{beyond}: {_counts(report, report.beyond)}"] if report.beyond.any() else []
    words += [f"frozen: {_counts(report, report.repeated)}"] if report.repeated.any() else []
    words += [f"{report.malformed} malformed"] if report.malformed else []
    words += [f"{report.backward} stamps do not increase"] if report.backward else []
    return ", ".join(words)


def _counts(report: TopicReport, counts: Int) -> str:
    """Say how many values (c,) of which place in the message are counted."""
    places = "xyz" if report.topic.type == IMU else [f"value {k + 1}" for k in range(report.channels)]
    counted = zip(places, counts.tolist(), strict=True)
    return " and ".join(f"{count} of {place}" for place, count in counted if count)


def config_text(chosen: Sequence[TopicReport], bag: Path) -> str:
    """Write a config to start from."""
    noise, told = _noise_setting(chosen)
    rest = _REST if all(_starts_at_rest(report) for report in chosen) else 0.0
    largest = max(report.largest for report in chosen)
    body = _imus(chosen) if chosen[0].topic.type == IMU else _array(chosen[0])
    name = shown(bag.name)
    return f"""\
# inspect: made by fdi inspect from {name}, to start from. Noise and rates are measured, mounts and axes are not.
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
      max_rate: [{_rounded_up(max(34.9, 1.001 * largest)):g}] # rad/s: put in what the data sheet says
{_stale(chosen)}"""


def _noise_setting(chosen: Sequence[TopicReport]) -> tuple[str, str]:
    """Noise for the config, and what it is of: a recording that mostly moves is to be judged in motion."""
    share = min(report.moving_share() for report in chosen)
    moving = np.concatenate([report.moving_noise() for report in chosen])
    if share > _MOSTLY and np.isfinite(moving).all() and (moving > 0).all():
        values = ", ".join(f"{_rounded_up(float(value)):g}" for value in moving)
        return values, f"in motion ({share:.0%} of the recording), vibration included"
    quiet = np.concatenate([report.quiet_noise() for report in chosen])
    usable = np.isfinite(quiet) & (quiet > 0)
    if not usable.any():
        return "0.0025", "a guess: the recording is too short to tell"
    # A value that never changes tells no noise: that of the noisiest stands for it.
    levels = np.where(usable, quiet, quiet[usable].max())
    values = ", ".join(f"{_rounded_up(float(value)):g}" for value in levels)
    return values, "when quietest; in motion vibration, and axes that are not quite as given, add"


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
      # inspect: identity, NOT MEASURED: `fdi calibrate` finds how the units are turned against each other, from turns
      # about all axes. By hand: mount of each unit by rows, v_body = R v_imu. With two parallel units a faulty axis is
      # seen and not named; turned against each other, or three of them, name it.
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
      # inspect: a guess, NOT MEASURED: axes, or a preset (two_triad_cone, dodecahedron, cone). `fdi calibrate` finds
      # all axes from turns about all axes, but for those of three reference channels: these must be right.
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
