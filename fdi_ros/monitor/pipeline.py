# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The monitor of one vehicle, online and offline: the sample path run over its records."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate, reported
from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.core.alignment import MAX_STAMP
from fdi_ros.core.bias import restart_bias
from fdi_ros.core.decision import clear_declarations, clear_disagreements
from fdi_ros.core.level import update_level
from fdi_ros.core.path import Path, begin_bias, run
from fdi_ros.core.records import EventRow, OutputRow, Sample
from fdi_ros.core.subsets import (
    mask_of,
    prepare_capability,
    prepare_subsets,
    single_losses,
)
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError, FdiError, GeometryError
from fdi_ros.model.geometry import spans_space
from fdi_ros.model.quantity import FORCE, RATE, Quantity
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import (
    accelerometer_config,
    check_accelerometers,
    felt_units,
    lever_arms,
    places,
    position_std,
    possible_names,
    possible_units,
)
from fdi_ros.monitor.building import (
    GUARD,
    alarm_probability,
    build_core,
    build_detector,
    build_geometry,
    build_guard,
    build_noise,
    suit_detector,
)
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.monitor.output import Event, Output, events_of, of_accelerometers
from fdi_ros.monitor.status import Status, status_of
from fdi_ros.system.text import html_table

EVENTS = 1024  # events that the sample path writes down at once
LEAST_STAMPS = 51
"""Samples of a block from which on the unit of their stamps is checked."""
TOO_CLOSE = 500.0
"""Ratio of the configured to the mean interval of stamps in another unit: 1000 for microseconds."""


class Pipeline:
    """Monitor of one vehicle's gyros, and of its accelerometers where their samples come.

    Both halves are monitors of this class: that of the accelerometers has settings of its own, made from the same file
    (`fdi_ros.monitor.accelerometers`), and works each sample after the gyros.

    Parameters
    ----------
    config
        All settings, or a parameter file.
    quantity
        What the channels measure; `FORCE` for the other half.

    Raises
    ------
    FdiError
        If there is no such file, or the settings do not fit each other.
    """

    def __init__(
        self, config: Config | str | PathLike[str], quantity: Quantity = RATE
    ) -> None:
        self.config = config = Config.of(config)
        self.geometry = build_geometry(config)
        self.noise = build_noise(config, self.geometry.n)
        self.quantity = quantity
        self.accelerometers: Pipeline | None = None
        """The other half; None: there are no accelerometers, or no sample has come yet that shows which."""
        self.channel_names = self.geometry.channel_names
        """Names of all channels, gyros first."""
        self.undecided = config.has_units and config.accelerometers.enabled == "auto"
        """Whether the first samples are to show which units have accelerometers."""
        self.felt: tuple[int, ...] = ()
        """Numbers of the units whose accelerometers are judged; of an array those of the accelerometers."""
        self._places = np.zeros(
            0, dtype=np.int64
        )  # among all accelerometers of a sample
        self._built: dict[tuple[int, ...], Pipeline] = {}
        self.core = build_core(config, self.geometry, self.noise)
        """All that the sample path is given and remembers, (1,) `fdi_ros.core.records.Core`."""
        self.subsets = prepare_subsets(
            self.geometry, self.noise
        )  # what every set of channels can do, (2^n,)
        self._events = allocate(EventRow, EVENTS)
        self._last_stamp = self.core["last_stamp"]
        self._in_flight = False
        self.guard: Detector
        """Detector that keeps the estimator."""
        self.detector: Detector
        """Detector whose alarms declare: the guard, or another method on the corrected values."""
        self.integrity: Integrity
        self._equip(config, None)
        check_accelerometers(config, self.geometry.n)
        if not self.undecided:
            self.sense(possible_units(config, self.geometry.n))

    @property
    def halves(self) -> tuple[Pipeline, ...]:
        """The monitor of the gyros, and of the accelerometers if there are any."""
        return (self,) if self.accelerometers is None else (self, self.accelerometers)

    @property
    def paths(self) -> tuple[Path, Path]:
        """What the sample path works on: gyros, then accelerometers; the gyros again where there are none."""
        return self.path, (self.accelerometers or self).path

    def sense(self, units: Iterable[int]) -> None:
        """Judge the accelerometers of these units, by their numbers, from now on; of fewer than two none."""
        chosen = tuple(units)
        self.undecided = False
        self.felt = chosen if len(chosen) > 1 else ()
        self._places = np.array(places(self.config, self.felt), dtype=np.int64)
        self.accelerometers = self.build_accelerometers(chosen) if self.felt else None
        self.channel_names = tuple(
            name for half in self.halves for name in half.geometry.channel_names
        )

    def twin(self) -> Pipeline:
        """Return another monitor with the same settings of the same channels, which has seen nothing."""
        other = Pipeline(self.config)
        if not self.undecided:
            other.sense(self.felt)
        return other

    def arranged(self, block: Block) -> Block:
        """Return a block with the accelerations that are judged; the first one decides which are, if that is open."""
        if self.undecided and len(block):
            self.sense(felt_units(block))
        if self.accelerometers is None:
            return replace(block, acceleration=None)
        given = block.acceleration
        columns = self._places
        if given is None:
            nothing = np.full((len(block), len(columns)), np.nan)
            none = Block(block.stamp, nothing, np.zeros(nothing.shape, dtype=bool))
            return replace(block, acceleration=none)
        if (
            len(columns) == given.z.shape[1]
            or not self.config.has_units
            or given.z.shape[1] != 3 * len(self.config.topics)
        ):
            return block
        received = None if given.received is None else given.received[:, columns]
        chosen = Block(given.stamp, given.z[:, columns], received)
        return replace(block, acceleration=chosen)

    def __repr__(self) -> str:
        states = ", ".join(
            f"{one.name} {one.state.name}"
            for one in self.status().channels
            if one.state.name != "OK"
        )
        count = f"{len(self.channel_names)} channels"
        about = f"{self.detector.name}, {count}, {self.core['samples'][0]} samples"
        return f"Pipeline({about}; {states or 'every channel OK'})"

    def _repr_html_(self) -> str:
        status = self.status()
        head = ("channel", "state", "reason", "bias", "noise, of noise_std")
        rows = [
            (
                one.name,
                one.state.name,
                one.reason.value,
                f"{bias:.4g} {one.unit}",
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
            If the new settings do not fit, or change what cannot change at run time;
            then nothing is changed.
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
        for units, other in self._built.items():
            other.reconfigure(accelerometer_config(config, units))
        try:
            self._equip(config, self.config)
        except FdiError:
            for units, other in self._built.items():
                other.reconfigure(accelerometer_config(self.config, units))
            raise
        self.config = config
        if self.core["samples"][0]:
            update_level(self.core[0], self.subsets)
            self.supply()

    def reset(self) -> None:
        """Clear all that is declared or suspected; bias, counters and copies stay."""
        for half in self.halves:
            declared = clear_declarations(half.core)
            for detector in half.detectors:
                detector.clear(declared)

    def restart(self) -> None:
        """Forget all samples, as if the monitor had just been built with the settings that it has now."""
        for half in self.halves:
            kept = {name: half.core[name].copy() for name in ("excluded", "settings")}
            half.core[:] = build_core(half.config, half.geometry, half.noise)
            for name, value in kept.items():
                half.core[name] = value
            for detector in half.detectors:
                detector.reset()

    def relearn_bias(self) -> None:
        """Learn the bias anew from the next time at rest; until then nothing is checked and there is no rate."""
        restart_bias(self.core)

    def process(self, block: Block) -> Output:
        """Judge and fuse a block of samples, of any length.

        Raises
        ------
        ConfigError
            If the block has another number of channels, stamps that do not increase, or
            stamps in another unit than nanoseconds.
        """
        samples = self._checked(block)
        if not len(samples):
            return self._output((allocate(OutputRow, 0), allocate(OutputRow, 0)), [])
        return next(self._parts(samples, False))

    def steps(self, block: Block) -> Iterator[Output]:
        """Judge and fuse a block as `process` does, in parts that each end at a sample with events, or at the end."""
        return self._parts(self._checked(block), True)

    def status(self) -> Status:
        """Snapshot after the last sample."""
        status, *others = (
            status_of(
                half.core[0],
                half.subsets,
                half.guard,
                half.detector,
                half.integrity,
                half.config,
                half.quantity,
            )
            for half in self.halves
        )
        return status.joined(others[0]) if others else status

    def prepare(self) -> None:
        """Prepare every loss of one channel or unit, now and after each change of detector: in flight none may wait."""
        self._in_flight = True
        for other in self._built.values():
            other.prepare()
        whole = len(self.subsets) - 1
        without_unit = [whole & ~mask_of(unit) for unit in self.geometry.units]
        for left in (whole, *single_losses(whole), *without_unit):
            if self.subsets["spans"][left]:
                self.detector.prepare(left)
        self.integrity.prepare(self.subsets)

    def supply(self) -> None:
        """Prepare what the path has requested.

        A new copy of a unit has spoken as a second witness: what rests on the comparison
        of channels is cleared.
        """
        for half in self.halves:
            half._supply()

    def _supply(self) -> None:
        core = self.core[0]
        if core["copies"]["found"]:
            core["copies"]["found"] = False
            clear_disagreements(self.core)
            for detector in self.detectors:
                detector.reset()
            begin_bias(core)
        if core["now"]["waiting"]:
            self.detector.prepare(int(core["sample"]["mask"]))
        if core["wanted"]:
            self.integrity.fill(self.subsets, int(core["wanted"]))
            update_level(core, self.subsets)

    def build_accelerometers(self, numbers: Iterable[int]) -> Pipeline:
        """Return the monitor of the accelerometers of some units, built once."""
        units = tuple(numbers)
        if units not in self._built:
            try:
                other = Pipeline(accelerometer_config(self.config, units), FORCE)
            except GeometryError as error:
                raise ConfigError(f"accelerometers: {error}") from None
            settings = other.core["settings"][0]
            settings["first"] = self.geometry.n
            settings["natural"] = FORCE.natural
            arms = lever_arms(self.config, units)
            settings["places"][: len(arms)] = places(self.config, units)
            settings["arms"][: len(arms)] = arms
            std = position_std(self.config, units)
            settings["position_std"][: len(arms)] = std / FORCE.natural
            if self._in_flight:
                other.prepare()
            self._built[units] = other
        return self._built[units]

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """The guard, and the method that declares where it is another one."""
        own = self.detector is self.guard
        return (self.guard,) if own else (self.guard, self.detector)

    def _equip(self, config: Config, before: Config | None) -> None:
        """Take over what may change at run time; what suits stays: to prepare all takes 0.1 s and more."""
        names = self.geometry.channel_names
        known = possible_names(config, names)
        if unknown := [name for name in config.excluded_channels if name not in known]:
            raise ConfigError(
                f"excluded_channels names {unknown[0]!r}, expected some of: {', '.join(known)}"
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
                guard = build_guard(config, self.geometry, self.noise, self.quantity)
                own = config.detector.name == GUARD
                detector = (
                    guard if own else build_detector(config, self.geometry, self.noise)
                )
                _ = guard.bank, detector.bank
        else:
            guard = self.guard
            detector = self.detector
        if before is None or alarm_probability(config) != alarm_probability(before):
            self.integrity = Integrity(
                config.integrity, alarm_probability(config), self.geometry, self.noise
            )
            self.subsets["has_level"] = False
        if before is not None and guard is not self.guard:
            # What was learned of the sensors holds for another threshold as well.
            guard.states[:] = self.guard.states
            guard.clear()
        self.guard = guard
        self.detector = detector
        self.path = Path(
            self.core,
            self.subsets,
            guard.bank,
            guard.memory,
            detector.bank,
            detector.memory,
        )
        self.core["excluded"] = mask_of(np.flatnonzero(excluded))
        self.core["now"]["waiting"] = False
        suit_detector(self.core, config, detector)
        possible = [not detector.refuses(k) for k in range(self.geometry.n + 1)]
        prepare_capability(self.subsets, self.geometry, possible)
        if self._in_flight:
            self.prepare()

    def _parts(self, samples: NDArray[Any], stop: bool) -> Iterator[Output]:
        """Process samples in one part, or in parts that stop at a sample with events."""
        halves = self.halves
        paths = self.paths
        size = len(samples)
        of_second = size * (len(halves) - 1)
        outs = allocate(OutputRow, size), allocate(OutputRow, of_second)
        events: list[Event] = []
        first = row = 0
        while row < size:
            row, count, waits = run(
                paths, len(halves), samples, row, outs, self._events, stop
            )
            is_between = bool(self.core["half"][0])  # gyros have worked one sample more
            if count:
                self._events["row"][:count] -= first
                events += events_of(self._events[:count], self.geometry.n)
            if waits:
                self.supply()
                # The level of the row before was not known; otherwise this changes nothing.
                for half, rows in zip(halves, outs, strict=False):
                    if not is_between:
                        level = half.core["last"]["level"][0]
                        rows["level"][row - 1] = half.quantity.natural * level
            if (events and stop and not is_between) or row == size:
                yield self._output((outs[0][first:row], outs[1][first:row]), events)
                first = row
                events = []

    def _output(
        self, rows: tuple[NDArray[Any], NDArray[Any]], events: list[Event]
    ) -> Output:
        """Put together what samples gave, rows (N,) of gyros and accelerometers."""
        names = self.channel_names
        n = self.geometry.n
        acceleration = None
        if self.accelerometers is not None:
            own = [
                of_accelerometers(event, n) for event in events if event.channel >= n
            ]
            acceleration = Output(
                rows[1], self.accelerometers.geometry.n, own, names[n:]
            )
        return Output(rows[0], n, events, names, acceleration)

    def _check_unit_of(self, first: int, end: int, count: int) -> None:
        """Refuse stamps of many samples that are too close together to be in nanoseconds."""
        rate = self.config.sample_rate
        if count < LEAST_STAMPS or (end - first) * rate > 1e9 / TOO_CLOSE * (count - 1):
            return
        raise ConfigError(
            f"{count} stamps lie within {end - first} ns, expected nanoseconds, about"
            f" {1e9 / rate:.4g} ns apart at sample_rate {rate:g} Hz"
        )

    def _checked(self, block: Block) -> NDArray[Any]:
        """Return the samples of a block as the sample path takes them, (N,) `Sample`."""
        if self.undecided or self.accelerometers is not None:
            block = self.arranged(block)
        stamp = np.asarray(block.stamp)
        z = np.asarray(block.z)
        n = self.geometry.n
        count = len(z)
        if z.shape[1] != n:
            raise ConfigError(f"samples have shape {z.shape}, expected (N, {n})")
        if count > 1 and (stamp[1:] <= stamp[:-1]).any():
            raise ConfigError("stamps of the samples do not increase")
        if count:
            first = int(stamp[0])
            end = int(stamp[-1])
            last = int(self._last_stamp[0])
            if not -MAX_STAMP < first <= end < MAX_STAMP:
                raise ConfigError(
                    f"stamps go from {first} to {end} ns, expected within {MAX_STAMP} ns of 0"
                )
            self._check_unit_of(first, end, count)
            if first <= last:
                raise ConfigError(
                    f"stamp {first} ns does not come after the last one, {last} ns"
                )
        samples = allocate(Sample, count)
        samples["stamp"] = stamp
        samples["z"][:, :n] = z
        samples["received"][:, :n] = True if block.received is None else block.received
        if self.accelerometers is not None and block.acceleration is not None:
            force = block.acceleration
            columns = self._places
            if force.z.shape[1] != len(columns):
                raise ConfigError(
                    f"accelerations have shape {force.z.shape}, expected (N, {len(columns)})"
                )
            samples["force"][:, columns] = force.z
            samples["felt"][:, columns] = (
                True if force.received is None else force.received
            )
        return samples
