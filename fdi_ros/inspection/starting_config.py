# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings to start from, derived from the topics of a recording alone."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import PARAMETERS, SAMPLES, Config, parameter_file
from fdi_ros.config.unit_names import unit_names
from fdi_ros.core.alignment import MAX_BRIDGE
from fdi_ros.core.sources import input_of
from fdi_ros.errors import BagError, ConfigError
from fdi_ros.inspection.fitness import (
    DEFAULT_TIMEOUT,
    candidates,
    left_out,
    needs,
    one_clock,
)
from fdi_ros.inspection.gravity import in_gravity
from fdi_ros.inspection.topics import (
    BELIEVED,
    INTERVALS,
    TopicReport,
    burst_words,
    inspect,
)
from fdi_ros.inspection.turns import TURNS, angle_of, find_turn
from fdi_ros.inspection.urdf import Urdf
from fdi_ros.model.samples import Array
from fdi_ros.system.text import figures, listed, percent, shown

#: topics of flight logs, which keep the numbers of the autopilot
_LOG_TOPIC = re.compile(r"/imu_[0-9]{1,3}")
#: time at the start over which the bias could be learned, s
_REST = 3.0
#: message intervals in a timeout: so that alignment draws a line from one to the next
_BRIDGED = 1.1 / MAX_BRIDGE


@dataclass(frozen=True)
class StartingConfig:
    """A config to start from."""

    #: name of the recording
    bag: str
    #: ``{"section.field": value}``
    parameters: dict[str, Any]
    #: how they were found, by parameter
    remarks: dict[str, str]
    #: warnings before the settings are used, empty if none
    look: str = ""
    #: source of the mounts, empty: none, identity is assumed
    mounted: str = ""
    #: topics with gyros left out, and why
    unused: tuple[tuple[str, str], ...] = ()

    @property
    def text(self) -> str:
        """The parameter file."""
        mounts = "mounts are from a URDF" if self.mounted else "mounts are not"
        origin = f"made by fdi inspect from {self.bag}, to start from. Noise and rates are measured, {mounts}."
        return parameter_file(self.parameters, origin, self.remarks)


def starting_config_of(path: Path, refused: str) -> StartingConfig:
    """Return the config that ``fdi inspect`` writes.

    ``refused``: first words of the `BagError` if there are no gyros in rad/s on one
    clock.
    """
    reports = inspect(path).reports
    if words := needs(reports):
        raise BagError(f"{refused}: needs {words}")
    if words := one_clock(candidates(reports)):
        raise BagError(f"{refused}: needs one clock: {words}")
    chosen = candidates(reports)
    unused = tuple((shown(topic), why) for topic, why in left_out(reports))
    look = [f"{topic} is left out: {why}" for topic, why in unused]
    look += [
        f"{shown(one.topic.name)}: {burst_words(one)}"
        for one in chosen
        if one.burst > 1
    ]
    return replace(starting_config(chosen, path), look="; ".join(look), unused=unused)


class AssumedConfig(NamedTuple):
    """Settings for a recording that came without any."""

    config: Config
    """The settings."""
    words: str
    """What they assume, in one line."""
    unused: tuple[tuple[str, str], ...]
    """Topics with gyros that are left out, and why."""


def assumed_config(path: Path) -> AssumedConfig:
    """Return settings for a recording that came without any.

    `BagError` if the recording shows no gyros, or they are not mounted alike: then the user must
    give the axes.
    """
    refused = f"{shown(path.name)}: no config given, and none can be assumed"
    found = starting_config_of(path, refused)
    config = Config.from_parameters(found.parameters)
    if not config.imus.topics:
        raise BagError(
            f"{refused}: no message states the axes of an array of channels; give them with --config"
        )
    if turned := turned_units(path, config):
        raise BagError(
            f"{refused}: {turned}. `fdi setup` measures the mounts and writes a config for --config"
        )
    low = min(config.noise.noise_std)
    high = max(config.noise.noise_std)
    look = f"; {found.look}" if found.look else ""
    words = (
        f"{', '.join(config.imus.names)} mounted alike, {config.sample_rate:g} Hz,"
        f" noise {figures(low, 2)} to {figures(high, 2)} rad/s,"
        f" scale factors within {100 * config.noise.scale_std[0]:g} %; `fdi setup` measures these{look}"
    )
    return AssumedConfig(config, words, found.unused)


def turned_units(path: Path, config: Config) -> str:
    """Name the units that measure the motion of the first one along other axes, may be empty."""
    if not config.imus.topics:
        return ""
    size = max(1, round(TURNS.window * config.sample_rate))
    names = config.imus.names
    # Damaged rates may be anything: their means overflow, and are left out.
    with Recording(path) as recording, np.errstate(over="ignore", invalid="ignore"):
        means = [
            block.z[: len(block) // size * size]
            .reshape(-1, size, 3 * len(names))
            .mean(axis=1)
            for block in Samples(recording, config).blocks()
        ]
    none = np.zeros((0, 3 * len(names)))
    slow = np.concatenate([none, *means])
    slow = slow[(np.abs(slow) < BELIEVED).all(axis=1)]
    if len(slow) < TURNS.least_windows:
        return ""
    turning = slow - np.median(slow, axis=0)
    first, *others = np.split(turning, len(names), axis=1)
    turned = []
    for name, rate in zip(names[1:], others, strict=True):
        rotation = find_turn(first, rate)[0]
        # A fault stays, whatever the rotation.
        left = np.std(rate @ rotation.T - first)
        explained = left < (1.0 - TURNS.shared) * np.std(rate - first)
        if explained and angle_of(rotation) > TURNS.square:
            turned.append(
                f"{name} is turned by {math.degrees(angle_of(rotation)):.0f} deg against {names[0]}"
            )
    return ", ".join(turned)


def _mounts_of(urdf: Urdf, chosen: Sequence[TopicReport]) -> tuple[Array, str]:
    """Return the mounts (n, 3, 3) of n units from a URDF, and words for their source."""
    frames = []
    for report in chosen:
        if report.frame_changes or not report.frame:
            fault = (
                "change their frame_id" if report.frame_changes else "have no frame_id"
            )
            raise ConfigError(
                f"no mounts from {urdf.name}: messages on {shown(report.topic.name)} {fault}"
            )
        frames.append(report.frame)
    names = unit_names([report.topic.name for report in chosen])
    units = [
        f"{name} is link {shown(frame)}"
        for name, frame in zip(names, frames, strict=True)
    ]
    words = f"those of the URDF {urdf.name} ({listed(units)}; the body frame is that of {names[0]})"
    return urdf.mounts(frames), words


#: value of a parameter, and a remark on it
_Setting = tuple[Any, str]


def starting_config(
    chosen: Sequence[TopicReport], bag: Path, urdf: Urdf | None = None
) -> StartingConfig:
    """Make a config to start from, of the topics of gyros in a recording.

    ``urdf``: gives the mounts of the units by the frames of their messages. `ConfigError`
    if it does not.
    """
    kind = chosen[0].kind
    assert kind is not None
    known = _settings_of_all(chosen, input_of(kind))
    mounted = ""
    if kind.stamped:
        settings, mounted = _settings_of_units(chosen, urdf)
        known |= settings
    else:
        known |= _settings_of_array(chosen[0], urdf)
    if why := in_gravity(chosen):
        known["accelerometers.enabled"] = "off", why
    if silent := _longer(chosen, INTERVALS.gap, 60.0):
        known["health.stale_timeout"] = silent, f"the default is {DEFAULT_TIMEOUT:g} s"
    return StartingConfig(
        shown(bag.name),
        {name: value for name, (value, _) in known.items()},
        {name: words for name, (_, words) in known.items() if words},
        mounted=mounted,
    )


def _settings_of_all(
    chosen: Sequence[TopicReport], input_name: str
) -> dict[str, _Setting]:
    """Return the settings that units and arrays have in common."""
    rate = max(report.rate for report in chosen)
    # A single spike says nothing of the range.
    largest = np.fmax.reduce([report.lasting for report in chosen])
    largest_rate = _rounded_up(
        float(np.fmax(max(PARAMETERS["health.max_rate"].default), 1.001 * largest))
    )
    at_rest = rate * _REST >= SAMPLES.min_learned and all(map(_starts_at_rest, chosen))
    return {
        "input": (input_name, ""),
        "sample_rate": (float(f"{rate:.4g}"), ""),
        "noise.noise_std": _noise_setting(chosen),
        "noise.scale_std": (
            [0.01],
            "a guess, for scale factors and axes that are not calibrated",
        ),
        "noise.timing_std": ([float(f"{0.05 / chosen[0].rate:.2g}")], "a guess"),
        "bias.startup_bias_duration": (
            _REST if at_rest else 0.0,
            f"the recording is {'' if at_rest else 'not '}at rest at the start",
        ),
        "detector.name": (PARAMETERS["detector.name"].default, ""),
        "detector.false_alarms_per_hour": (0.001, ""),
        "health.max_rate": (
            [largest_rate],
            "NOT KNOWN: put in what the data sheet says",
        ),
    }


def _settings_of_units(
    chosen: Sequence[TopicReport], urdf: Urdf | None
) -> tuple[dict[str, _Setting], str]:
    """Return the settings of IMUs, and words for the source of their mounts, if any."""
    topics = [report.topic.name for report in chosen]
    mounts = np.tile(np.eye(3), (len(chosen), 1, 1))
    mounted = ""
    if urdf is not None:
        mounts, mounted = _mounts_of(urdf, chosen)
    assumed = (
        "identity, NOT MEASURED: `fdi setup` finds how the units are turned against each other, from turns about"
        " all axes. With two parallel units a fault is detected and not isolated; turned against each other, or"
        " three of them, isolate it"
    )
    known: dict[str, _Setting] = {
        "imus.topics": (topics, ""),
        "imus.names": (unit_names(topics), "taken from the topics above"),
        "imus.mounts": (mounts.ravel().tolist(), mounted or assumed),
        "imus.max_skew": (_rounded_up(0.2 / max(one.rate for one in chosen)), ""),
    }
    if all(_LOG_TOPIC.fullmatch(topic) for topic in topics):
        words = "for a flight log: a second fault is named like the first, once the first has ended"
        known["decision.latch"] = False, words
    if timeout := _longer(chosen, _BRIDGED, 10.0):
        slowest = min(report.rate for report in chosen)
        none = "none would be aligned between two"
        words = f"messages come at {figures(slowest)} Hz: with the default {DEFAULT_TIMEOUT:g} s {none}"
        known["imus.timeout"] = timeout, words
    return known, mounted


def _settings_of_array(array: TopicReport, urdf: Urdf | None) -> dict[str, _Setting]:
    """Return the settings of an array of channels. `ConfigError` with a URDF."""
    topic = array.topic.name
    if urdf is not None:
        raise ConfigError(
            f"no mounts from {urdf.name}: {shown(topic)} is an array of channels, which have no frame each"
        )
    words = (
        "a guess, NOT MEASURED: give axes, or a preset. `fdi calibrate` finds all axes from turns about all axes,"
        " but for those of three reference channels: these must be right"
    )
    return {
        "channels.topic": (topic, ""),
        "geometry.preset": ("cone", words),
        "geometry.cone_channels": (array.channels, ""),
    }


def _noise_setting(chosen: Sequence[TopicReport]) -> tuple[list[float], str]:
    """Return the noise for the config and a remark.

    A mostly moving recording gives the noise in motion.
    """
    noise = [report.segments.noise() for report in chosen]
    share = min(one.share for one in noise)
    levels = np.concatenate([one.moving for one in noise])
    words = f"in motion ({percent(share)} of the recording), vibration included"
    is_known = np.isfinite(levels).all() and (levels > 0).all()
    if not (share > 0.5 and is_known):
        quiet = np.concatenate([one.quiet for one in noise])
        usable = np.isfinite(quiet) & (quiet > 0)
        if not usable.any():
            return [0.0025], "a guess: the recording is too short to tell"
        # A constant channel shows no noise; the noisiest one stands in.
        levels = np.where(usable, quiet, quiet[usable].max())
        words = "when quietest; in motion vibration, and axes that are not quite as given, add"
    return [_rounded_up(value) for value in levels.tolist()], words


def _longer(chosen: Sequence[TopicReport], intervals: float, most: float) -> float:
    """Return a silence, s, longer than these intervals and nearly all gaps.

    0 keeps the default.
    """
    nearly_all = [
        float(np.quantile(np.concatenate(one.intervals), 0.999))
        for one in chosen
        if one.intervals
    ]
    usual = [intervals * report.interval for report in chosen]
    needed = max([*usual, *nearly_all])
    return min(_rounded_up(needed), most) if needed > DEFAULT_TIMEOUT else 0.0


def _starts_at_rest(report: TopicReport) -> bool:
    """Whether nothing moves over the time in which biases could be learned."""
    segments = zip(
        report.segments.all_segments(), report.segments.noise().rest, strict=True
    )
    begin = [
        rest for segment, rest in segments if segment.first - report.first < _REST * 1e9
    ]
    return bool(begin) and all(begin)


def _rounded_up(value: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.2g}")
