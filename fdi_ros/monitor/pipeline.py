# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The monitor of one vehicle, online and offline: built from settings, and the sample path run over its records."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate, reported
from fdi_ros.config.config import PARAMETERS, Config, check_lengths
from fdi_ros.core.alignment import MAX_STAMP
from fdi_ros.core.bias import EFFICIENCY, FIXED, LEARNING, prepare_limits, restart_bias
from fdi_ros.core.decision import (
    REASONS,
    RETURN_MEAN,
    ChannelState,
    Reason,
    clear_declarations,
)
from fdi_ros.core.fusion import update_level
from fdi_ros.core.path import Path, begin_bias, run
from fdi_ros.core.records import Core, EventRow, OutputRow, Sample
from fdi_ros.core.sources import source_of
from fdi_ros.core.subsets import (
    describe_sensors,
    mask_of,
    prepare_capability,
    prepare_subsets,
    single_losses,
)
from fdi_ros.detectors import create_detector, detector_class
from fdi_ros.detectors.base import Detector, accepted_options
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import FalseAlarmRate, NoiseModel, normal_isf
from fdi_ros.model.samples import Block
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.monitor.output import Event, Output, events_of
from fdi_ros.monitor.status import Status, status_of
from fdi_ros.system.text import html_table

UNIT_DELAY, CHANNEL_DELAY = 0.015, 0.001
"""Standard deviation of what is not known of the delay between units, before motion shows it: with stamps of their own,
and where all channels arrive in one message, s."""
BOUND_IN_NOISE = 4.0  # default guaranteed bound, in noise_std: white noise exceeds it in 6e-5 of samples
REST_NOISE = (
    4.0  # at rest the standard deviation of a channel is at most this many noise_std
)
RETURN_PROBABILITY = 1e-6  # with which a healthy channel disagrees by chance in one sample, where it is to return


def build_geometry(config: Config) -> Geometry:
    """Sensitivity axes of a configuration; `FdiError` if axes, names and topics do not fit each other."""
    geometry = _axes(config)
    source_of(config).check_channels(geometry.n)
    units = config.channels.units
    if units and config.has_units:
        raise ConfigError(
            "channels.units is given, but input is 'imus': each topic is a unit"
        )
    if units and len(units) != geometry.n:
        raise ConfigError(
            f"channels.units has {len(units)} names, expected {geometry.n}, one for each channel"
        )
    # Of the presets some are made of triads; names with a point say the same.
    if (
        not config.has_units
        and not any("." in name for name in config.channel_names)
        and geometry.units
    ):
        units = units or geometry.unit_of
    return Geometry(geometry.axes, config.channel_names or None, units or None)


def build_noise(config: Config, n: int) -> NoiseModel:
    """Error model of a configuration; a bias averaged at start-up is as well known as white noise lets it be."""
    noise = config.noise
    std = np.array(noise.noise_std)
    bound = np.array(noise.bound) if noise.bound else BOUND_IN_NOISE * std
    averaged = EFFICIENCY * config.bias.startup_bias_duration * config.sample_rate
    bias_std = std / np.sqrt(max(averaged, 1.0)) if averaged > 0 else 0.0 * std
    values = (
        std,
        np.array(noise.scale_std),
        np.array(noise.timing_std),
        bound,
        bias_std,
    )
    return NoiseModel(*map(np.squeeze, values)).for_channels(n)


def alarm_probability(config: Config) -> float:
    """False-alarm probability per sample that a configuration asks for."""
    return _false_alarm_rate(config).per_sample()


def _false_alarm_rate(config: Config, by_run_length: bool = False) -> FalseAlarmRate:
    """Of what the settings state the first: a run length, if the detector takes one, a probability, a rate per hour."""
    settings, rate = config.detector, config.sample_rate
    if by_run_length and settings.run_length > 0:
        return FalseAlarmRate(run_length=settings.run_length, sample_rate=rate)
    if settings.false_alarm_probability > 0:
        return FalseAlarmRate(
            false_alarm_probability=settings.false_alarm_probability, sample_rate=rate
        )
    return FalseAlarmRate(
        false_alarms_per_hour=settings.false_alarms_per_hour, sample_rate=rate
    )


_RATES = {"false_alarms_per_hour", "false_alarm_probability", "run_length"}
"""Options in which one false-alarm rate is stated."""


def build_detector(config: Config, geometry: Geometry, noise: NoiseModel) -> Detector:
    """Detector of a configuration, with those of the options that it takes."""
    settings = config.detector
    accepted = accepted_options(detector_class(settings.name))
    known = {field.name for field in fields(settings)} - _RATES
    options: dict[str, Any] = {
        name: getattr(settings, name) for name in accepted if name in known
    }
    delay_std = UNIT_DELAY if source_of(config).stamped else CHANNEL_DELAY
    errors = {"bias_walk": config.noise.bias_walk, "delay_std": delay_std}
    options |= {name: value for name, value in errors.items() if name in accepted}
    # The paper's tolerance keeps no false-alarm rate, and refuses to be given one.
    if options.get("tolerance") != "paper":
        options |= _false_alarm_rate(config, "run_length" in accepted).as_options(
            accepted
        )
    return create_detector(settings.name, geometry, noise, **options)


def build_core(config: Config, geometry: Geometry, noise: NoiseModel) -> NDArray[Any]:
    """Record of a monitor before its first sample, (1,) `Core`; `ConfigError` if a setting has another length."""
    n = geometry.n
    check_lengths(config, "channel", n)
    cores = allocate(Core)
    core = cores[0]
    _fill_settings(core["settings"], config, geometry, noise)
    _fill_bias(core["bias"], config, noise)
    core["remaining"][:n] = noise.bias_std
    core["sample"]["bias_std"][:n] = (
        noise.bias_std if core["bias"]["learning"] else config.bias.turn_on_std
    )
    core["last_stamp"] = -MAX_STAMP
    core["acceleration"]["window"] = _nanoseconds(config.noise.acceleration_window)
    core["state"][:n], core["reason"][:n] = (
        ChannelState.UNCHECKED,
        REASONS.index(Reason.NO_DATA),
    )
    return cores


def suit_detector(core: NDArray[Any], config: Config, detector: Detector) -> None:
    """Set in core (1,) all that may change at run time: the rule of decision, what is followed, what is withheld."""
    settings, rule = core["settings"], config.decision.rule
    settings["publish_under_doubt"] = config.publish_under_doubt
    settings["estimates"] = detector.takes_any
    if not detector.takes_any:
        # What another detector had found of the sensors is taken off no longer.
        core["sample"]["estimate"], core["correction"] = 0, 0.0
    settings["by_evidence"] = rule == "evidence" or (
        rule == "auto" and detector.accumulates
    )
    settings["needs_acceleration"] = (
        bool(detector.noise.timing_std.any()) or detector.accumulates
    )


def _fill_settings(
    settings: Any, config: Config, geometry: Geometry, noise: NoiseModel
) -> None:
    n, integrity = geometry.n, config.integrity
    settings["n"] = n
    describe_sensors(settings["sensors"], geometry, noise)
    settings["largest_noise"] = noise.noise_std.max()
    settings["return_limit"] = normal_isf(RETURN_PROBABILITY / 2)
    settings["turn_on"], settings["learned"][:n] = (
        config.bias.turn_on_std,
        noise.bias_std,
    )
    settings["max_drift"] = config.bias.max_drift
    settings["risk"] = integrity.risk
    settings["prior"][:n] = np.expm1(
        np.array(integrity.fault_rate) * integrity.exposure
    )
    settings["reach"] = normal_isf(integrity.risk / 2) if integrity.risk > 0 else 0.0
    settings["units"] = len(geometry.units)
    settings["members"][: len(geometry.units)] = [
        mask_of(unit) for unit in geometry.units
    ]
    health, decision = config.health, config.decision
    settings["max_rate"][:n] = health.max_rate
    settings["non_finite_time"] = _nanoseconds(health.non_finite_time)
    settings["stuck_time"] = _nanoseconds(health.stuck_time)
    settings["frozen_time"] = _nanoseconds(health.stuck_time_at_rest)
    settings["stale_time"] = _nanoseconds(health.stale_timeout)
    settings["recovery_time"] = _nanoseconds(health.range_recovery_time)
    settings["alarms"], settings["window"] = (
        decision.confirm_alarms,
        decision.confirm_window,
    )
    settings["latch"], settings["clean_time"] = (
        decision.latch,
        _nanoseconds(decision.clean_time),
    )
    settings["mean_limit"][:n] = RETURN_MEAN * noise.noise_std


def _fill_bias(bias: Any, config: Config, noise: NoiseModel) -> None:
    n, fixed, learning = (
        len(noise.noise_std),
        config.bias.fixed,
        config.bias.startup_bias_duration > 0,
    )
    bias["given"] = bool(fixed)
    bias["value"][:n] = bias["centre"][:n] = fixed or 0.0
    bias["known"] = mask_of(range(n))
    bias["duration"] = _nanoseconds(config.bias.startup_bias_duration)
    bias["max_rate"] = config.bias.max_rest_rate
    prepare_limits(bias)
    bias["max_std"][:n] = REST_NOISE * noise.noise_std
    bias["learning"], bias["outcome"] = learning, LEARNING if learning else FIXED


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _axes(config: Config) -> Geometry:
    preset = config.geometry.preset
    if preset == "auto":
        preset = (
            "axes"
            if config.geometry.axes
            else "triads"
            if config.has_units
            else "two_triad_cone"
        )
    if preset == "axes":
        if not config.geometry.axes:
            raise ConfigError("geometry.preset is 'axes', but geometry.axes is empty")
        return Geometry(np.reshape(config.geometry.axes, (-1, 3)))
    if preset == "triads":
        if not (source := source_of(config)).units:
            raise ConfigError(
                f"geometry.preset is 'triads', expected input 'imus', got {config.input!r}"
            )
        return Geometry.from_triads(source.mounts)
    if preset == "cone":
        return Geometry.cone(config.geometry.cone_channels)
    return (
        Geometry.dodecahedron()
        if preset == "dodecahedron"
        else Geometry.two_triad_cone()
    )


# Run ------------------------------------------------------------------------------------------------------------------


EVENTS = 1024  # events that the sample path writes down at once


class Pipeline:
    """Monitor of one vehicle's gyros.

    Parameters
    ----------
    config
        All settings, or a parameter file.

    Raises
    ------
    FdiError
        If there is no such file, or the settings do not fit each other.
    """

    def __init__(self, config: Config | str | PathLike[str]) -> None:
        self.config = config = Config.of(config)
        self.geometry = build_geometry(config)
        self.noise = build_noise(config, self.geometry.n)
        self.channel_names = self.geometry.channel_names
        self.core = build_core(config, self.geometry, self.noise)
        """All that the sample path is given and remembers, (1,) `fdi_ros.core.records.Core`."""
        self.subsets = prepare_subsets(
            self.geometry, self.noise
        )  # what every set of channels can do, (2^n,)
        self._events = allocate(EventRow, EVENTS)
        self._last_stamp = self.core["last_stamp"]
        self._in_flight = False
        self.detector: Detector
        self.integrity: Integrity
        self._equip(config, None)

    def __repr__(self) -> str:
        states = ", ".join(
            f"{one.name} {one.state.name}"
            for one in self.status().channels
            if one.state.name != "OK"
        )
        about = f"{self.detector.name}, {self.geometry.n} channels, {self.core['samples'][0]} samples"
        return f"Pipeline({about}; {states or 'every channel OK'})"

    def _repr_html_(self) -> str:
        status = self.status()
        head = ("channel", "state", "reason", "bias rad/s", "noise, of noise_std")
        rows = [
            (
                one.name,
                one.state.name,
                one.reason.value,
                f"{bias:.4g}",
                f"{one.noise:.3g}" if one.noise else "-",
            )
            for one, bias in zip(status.channels, status.bias, strict=True)
        ]
        return html_table(
            f"{status.detector} after {status.samples} samples", head, rows
        )

    @classmethod
    def from_config(cls, config: Config) -> Pipeline:
        """Build from settings."""
        return cls(config)

    def reconfigure(self, config: Config) -> None:
        """Take over another detector, its options or other excluded channels; bias and declarations stay.

        Raises
        ------
        FdiError
            If the new settings do not fit, or change what cannot change at run time; then nothing is changed.
        """
        before = self.config.parameters()
        fixed = [
            name
            for name, v in config.parameters().items()
            if v != before[name] and not PARAMETERS[name].runtime
        ]
        if fixed:
            raise ConfigError(
                f"{', '.join(fixed)} cannot change while the monitor runs"
            )
        self._equip(config, self.config)
        self.config = config
        if self.core["samples"][0]:
            update_level(self.core[0], self.subsets)
            self.supply()

    def reset(self) -> None:
        """Clear all that is declared or suspected; bias, counters and copies stay."""
        declared = clear_declarations(self.core)
        self.detector.clear(declared)

    def restart(self) -> None:
        """Forget all samples, as if the monitor had just been built with the settings that it has now."""
        excluded = self.core["excluded"].copy()
        self.core[:] = build_core(self.config, self.geometry, self.noise)
        self.core["excluded"] = excluded
        suit_detector(self.core, self.config, self.detector)
        self.detector.reset()

    def relearn_bias(self) -> None:
        """Learn the bias anew from the next time at rest; until then nothing is checked and there is no rate."""
        restart_bias(self.core)

    def process(self, block: Block) -> Output:
        """Judge and fuse a block of samples, of any length.

        Raises
        ------
        ConfigError
            If the block has another number of channels, or stamps that do not increase.
        """
        samples = self._checked(block)
        nothing = Output(
            allocate(OutputRow, 0), self.geometry.n, (), self.channel_names
        )
        return next(self._parts(samples, False), nothing)

    def steps(self, block: Block) -> Iterator[Output]:
        """Judge and fuse a block as `process` does, in parts that each end at a sample with events, or at the end."""
        return self._parts(self._checked(block), True)

    def status(self) -> Status:
        """Snapshot after the last sample."""
        return status_of(
            self.core[0], self.subsets, self.detector, self.integrity, self.config
        )

    def prepare(self) -> None:
        """Prepare every loss of one channel or unit, now and after each change of detector: in flight none may wait."""
        self._in_flight = True
        whole = len(self.subsets) - 1
        without_unit = [whole & ~mask_of(unit) for unit in self.geometry.units]
        for left in (whole, *single_losses(whole), *without_unit):
            if self.subsets["spans"][left]:
                self.detector.prepare(left)
        self.integrity.prepare(self.subsets)

    def supply(self) -> None:
        """Prepare what the sample path has asked for; what was learned by the word of a copy of a unit is void."""
        core = self.core[0]
        if core["copies"]["found"]:
            core["copies"]["found"] = False
            clear_declarations(self.core)
            self.detector.reset()
            begin_bias(core)
        if core["now"]["waiting"]:
            self.detector.prepare(int(core["sample"]["mask"]))
        if core["wanted"]:
            self.integrity.fill(self.subsets, int(core["wanted"]))
            update_level(core, self.subsets)

    def _equip(self, config: Config, before: Config | None) -> None:
        """Take over what may change at run time; what suits stays: to prepare all takes 0.1 s and more."""
        names = self.channel_names
        if unknown := [name for name in config.excluded_channels if name not in names]:
            raise ConfigError(
                f"excluded_channels names {unknown[0]!r}, expected some of: {', '.join(names)}"
            )
        excluded = np.array([name in config.excluded_channels for name in names])
        if not spans_space(self.geometry.axes[~excluded]):
            left = (
                ", ".join(
                    name for name in names if name not in config.excluded_channels
                )
                or "none"
            )
            raise ConfigError(
                f"excluded_channels leaves no rate: {left} do not span three dimensions"
            )
        # All that can be refused comes first: then nothing is changed.
        if before is None or config.detector != before.detector:
            with reported(f"the sample path and {config.detector.name}"):
                detector = build_detector(config, self.geometry, self.noise)
                _ = detector.bank
        else:
            detector = self.detector
        if before is None or alarm_probability(config) != alarm_probability(before):
            self.integrity = Integrity(
                config.integrity, alarm_probability(config), self.geometry, self.noise
            )
            self.subsets["has_level"] = False
        if self.core["samples"][0] and detector.takes_any and self.detector.takes_any:
            # What was learned of the sensors holds for another threshold as well.
            detector.states[:] = self.detector.states
            detector.clear()
        elif before is not None:
            detector.reset()
        self.detector = detector
        self.path: Path = (self.core, detector.bank, detector.memory, self.subsets)
        self.core["excluded"] = mask_of(np.flatnonzero(excluded))
        self.core["now"]["waiting"] = False
        suit_detector(self.core, config, detector)
        possible = [not detector.refuses(k) for k in range(self.geometry.n + 1)]
        prepare_capability(self.subsets, self.geometry, possible)
        if self._in_flight:
            self.prepare()

    def _parts(self, samples: NDArray[Any], stop: bool) -> Iterator[Output]:
        """Process samples in one part, or in parts that stop at a sample with events."""
        rows = allocate(OutputRow, len(samples))
        events: list[Event] = []
        first = row = 0
        while row < len(rows):
            row, count, waits = run(self.path, samples, row, rows, self._events, stop)
            if count:
                self._events["row"][:count] -= first
                events += events_of(self._events[:count])
            if waits:
                self.supply()
                # The level of the row before was not known; otherwise this changes nothing.
                rows["level"][row - 1] = self.core["last"]["level"][0]
            if (events and stop) or row == len(rows):
                yield Output(
                    rows[first:row], self.geometry.n, events, self.channel_names
                )
                first, events = row, []

    def _checked(self, block: Block) -> NDArray[Any]:
        """Return the samples of a block as the sample path takes them, (N,) `Sample`."""
        stamp, z, n = np.asarray(block.stamp), np.asarray(block.z), self.geometry.n
        count = len(z)
        if z.shape[1] != n:
            raise ConfigError(f"samples have shape {z.shape}, expected (N, {n})")
        if count > 1 and (stamp[1:] <= stamp[:-1]).any():
            raise ConfigError("stamps of the samples do not increase")
        if count:
            first, end, last = int(stamp[0]), int(stamp[-1]), int(self._last_stamp[0])
            if not -MAX_STAMP < first <= end < MAX_STAMP:
                raise ConfigError(
                    f"stamps go from {first} to {end} ns, expected within {MAX_STAMP} ns of 0"
                )
            if first <= last:
                raise ConfigError(
                    f"stamp {first} ns does not come after the last one, {last} ns"
                )
        samples = allocate(Sample, count)
        samples["stamp"], samples["z"][:, :n] = stamp, z
        samples["received"][:, :n] = True if block.received is None else block.received
        return samples
