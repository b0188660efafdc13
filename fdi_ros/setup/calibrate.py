# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the monitor from a recording: axes, biases and noise with standard errors.

docs/calibration.md has method and formulas.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fdi_ros.config.config import Config
from fdi_ros.config.settings import LEAST_NOISE, Value
from fdi_ros.core.sources import source_of
from fdi_ros.errors import (
    CalibrationError,
    ConfigError,
    DisagreementError,
    FdiError,
)
from fdi_ros.inspection.turns import TURNS
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Block, Int, Mask, flag_runs
from fdi_ros.monitor.building import (
    CHANNEL_DELAY,
    UNIT_DELAY,
    build_geometry,
    build_noise,
)
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.run import Kept, Walk
from fdi_ros.report.spectrum import Spectrum
from fdi_ros.setup.accelerometers import (
    AccelerometerFit,
    Prepared,
    fit_accelerometers,
    prepare_accelerometers,
)
from fdi_ros.setup.agreement import LEAST_RATE, MOUNT_ERRORS, check_agreement
from fdi_ros.setup.blocks import (
    NOT_SHIFTED,
    Data,
    prepare,
    resampled,
    spikes,
)
from fdi_ros.setup.channels import ChannelFit
from fdi_ros.setup.estimate import (
    REFERENCE_STD,
    SCALE_STD,
    Priors,
    StateEstimate,
    estimate,
)
from fdi_ros.setup.positions import Position, find_positions, position_settings
from fdi_ros.system.text import percent


class UnknownAxes(NamedTuple):
    """Errors of axes and scales before the recording shows them."""

    #: error of each component of an axis that may point anywhere: the root of a
    #: third
    mount: float = 0.58
    #: the same of an array, and the error from which axes follow the motion alone
    axes: float = 0.1
    #: scale error of all gyros of a type, which their differences do not show: data
    #: sheets of MEMS gyros state 0.5 to 1.5 %, and calibrations at the works leave
    #: less
    shared_scale: float = 0.005


UNKNOWN_AXES = UnknownAxes()


class _NeededData(NamedTuple):
    """What a recording must have to calibrate with it."""

    #: shortest recording, s
    duration: float = 10.0
    #: fewest samples
    samples: int = 100
    #: longest time from one sample to the next, s
    interval: float = 1.0
    #: share of its samples that a channel must give
    share: float = 0.3
    #: longest fault, as a share of the recording, for which the others decide
    faulty: float = 0.35


NEEDED_DATA = _NeededData()

#: smallest imus.max_skew where smaller delays are taken off, s
LEAST_SKEW = 5e-5
#: smallest imus.timeout, in differences of unit delays
WAITS = 2.5
#: parameters without meaning beside geometry.axes
REPLACED = (
    "imus.mounts",
    "geometry.cone_channels",
)


class StampDelay(NamedTuple):
    """By how much the stamps of a unit are late against those of the first."""

    #: numbers of the channels of the unit
    channels: tuple[int, ...]
    #: s, positive if stamps are late, as in imus.delays
    value: float
    #: s
    error: float

    @property
    def shown(self) -> bool:
        """Whether the data show one."""
        return abs(self.value) > MOUNT_ERRORS.sigmas * self.error


class Span(NamedTuple):
    """Channels of which one is faulty, from start to end, s from the start of the part used."""

    #: numbers of the channels
    channels: tuple[int, ...]
    #: begin, s
    start: float
    #: end, s
    end: float


@dataclass
class Calibration(ChannelFit):
    """Result for the gyros in use, in their order, and for the accelerometers beside them."""

    #: uncertainty of the sampling instants, s, as written
    timing: float
    #: of all units but the first
    delays: tuple[StampDelay, ...]
    #: when channels were faulty
    faults: tuple[Span, ...]
    #: of the recording, s
    duration: float
    #: parameters to be changed, ``{"section.field": value}``
    settings: dict[str, object]
    #: spectrum of differences from the fused rate
    spectrum: Spectrum
    #: of the accelerometers of all units but the first
    positions: tuple[Position, ...] = ()
    #: None if units have no accelerometers, or these cannot be calibrated
    accelerometers: AccelerometerFit | None = None
    #: why accelerometers are not calibrated, or empty
    refused: str = ""


def calibrate(
    block: Block, config: Config, reference: str = "", unknown: Sequence[int] = ()
) -> Calibration:
    """Calibrate all channels that are not excluded.

    ``reference``: a triad, or three channels with commas, taken as configured. Empty
    trusts all alike, and in an array the first three that span space. ``unknown``:
    channels with unknown mounts. `FdiError` if the recording is too short, or gyros
    contradict each other.
    """
    full = build_geometry(config)
    used = np.array(
        [name not in config.excluded_channels for name in full.channel_names]
    )
    active = np.flatnonzero(used)
    nominal = full.subset(used)
    chosen = reference_channels(config, nominal, reference)
    data, spiky = _prepared(block, config, used, nominal)
    lost = np.flatnonzero(np.isin(active, unknown)).tolist()
    if source_of(config).units:
        check_agreement(data, nominal, lost)
    sensors = _sensors(config, nominal, data, chosen, lost)
    trusted = {nominal.channel_names[i].rpartition(".")[0] for i in chosen}
    try:
        found = estimate(data, sensors)
        beside = _Beside(block, config, active, data.step, tuple(trusted), found)
        samples = _as_monitored(block, data, used, found, beside.ready)
        n = len(active)
        faults, spectrum = _watch(samples, beside.config, beside.names, n)
        of_gyros, of_forces = _split(faults, n)
        if of_gyros:
            without = _without(of_gyros, data, nominal.channel_names)
            found = estimate(without, sensors)
        if faults:
            beside = _Beside(
                block, config, active, data.step, tuple(trusted), found, of_forces
            )
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            f"the recording leaves the fit undetermined ({error})"
        ) from error
    return Calibration(
        names=nominal.channel_names,
        nominal=nominal.axes,
        estimate=found,
        timing=float(_timing(config, active, found).max()),
        delays=_stamp_delays(found, sensors),
        faults=of_gyros,
        unusable=data.unusable | {"spikes": np.asarray(spiky.sum(axis=0))},
        duration=len(data.stamp) * data.step,
        settings=beside.settings,
        spectrum=spectrum,
        positions=beside.positions,
        accelerometers=beside.fit,
        refused=beside.refused,
    )


def _split(faults: Sequence[Span], n: int) -> tuple[tuple[Span, ...], tuple[Span, ...]]:
    """Split the faults into those of the n gyros and those of accelerometers, whose channels count from 0."""
    of_gyros = tuple(span for span in faults if min(span.channels) < n)
    of_forces = tuple(
        span._replace(channels=tuple(i - n for i in span.channels))
        for span in faults
        if min(span.channels) >= n
    )
    return of_gyros, of_forces


def _stamp_delays(found: StateEstimate, sensors: Priors) -> tuple[StampDelay, ...]:
    """Return the delay of each unit but the first."""
    delays = []
    for k in range(1, sensors.units):
        unit = tuple(np.flatnonzero(sensors.unit == k).tolist())
        first = unit[0]
        delay = float(found.delay[first])
        std = float(found.delay_std[first])
        delays.append(StampDelay(unit, delay, std))
    return tuple(delays)


def _prepared(
    block: Block, config: Config, used: Mask, nominal: Geometry
) -> tuple[Data, Mask]:
    """Return the usable values of gyros in use, and the spikes (N, n) among them."""
    rates = np.broadcast_to(np.array(config.health.max_rate), len(used))
    data = prepare(
        Block(block.stamp, block.z[:, used], block.delivered[:, used]), rates[used]
    )
    _check_amount(data, nominal.channel_names)
    spiky = spikes(data.z, nominal.axes)
    data.z[spiky] = np.nan
    return data, spiky


class _Beside:
    """Positions and fit of the accelerometers beside calibrated gyros, and all settings."""

    def __init__(
        self,
        block: Block,
        config: Config,
        active: Int,
        step: float,
        trusted: Sequence[str],
        gyros: StateEstimate,
        faults: tuple[Span, ...] = (),
    ) -> None:
        self.positions = find_positions(block, config, gyros)
        self.settings = _settings(config, active, step, gyros)
        # The axes of a trusted unit are true.
        common = config.noise.shared_scale_std or UNKNOWN_AXES.shared_scale
        self.settings["noise.shared_scale_std"] = 0.0 if any(trusted) else common
        self.settings |= position_settings(self.positions, config)
        self.config = config.replaced(self.settings)
        self.ready: Prepared | None = None
        self.fit: AccelerometerFit | None = None
        self.refused = ""
        names = build_geometry(config).channel_names
        self.names = tuple(names[i] for i in active)
        try:
            # The best estimate, even of a position that is not known well enough to be written.
            likely = position_settings(self.positions, config, likely=True)
            placed = self.config.replaced(likely)
            self.ready = prepare_accelerometers(block, placed, gyros, trusted)
            if self.ready is not None:
                of_faults = partial(_without, faults)
                self.fit = fit_accelerometers(
                    self.ready, self.config, of_faults, faults
                )
        except (FdiError, np.linalg.LinAlgError) as error:
            self.refused = str(error)
        if self.fit is not None:
            self.settings |= self.fit.settings
            self.config = self.config.replaced(self.fit.settings)
            self.names += self.fit.names


def _as_monitored(
    block: Block, data: Data, used: Mask, found: StateEstimate, beside: Prepared | None
) -> Block:
    """Return the samples as the monitor will have them once delays are taken off."""
    z = block.z.copy()
    received = block.delivered.copy()
    still = np.isfinite(data.z) & (np.abs(found.delay) < NOT_SHIFTED)
    shifted, _ = resampled(data, found.delay)
    z[:, used] = np.where(still, data.z, shifted)
    # The value of another instant is no substitute.
    received[:, used] = np.isfinite(z[:, used])
    forces = None
    if beside is not None and block.acceleration is not None:
        forces = beside.as_monitored(block.stamp, block.acceleration.z.shape[1])
    return Block(block.stamp, z, received, forces)


def _check_amount(data: Data, names: tuple[str, ...]) -> None:
    """Refuse a recording that is too short, too slow, or lacks too much of a channel."""
    samples = len(data.stamp)
    words = ""
    if samples < 2 or data.duration < NEEDED_DATA.duration:
        words = f"is {data.duration:.1f} s long, a calibration needs at least {NEEDED_DATA.duration:g} s"
    elif samples < NEEDED_DATA.samples:
        words = (
            f"has {samples} samples, a calibration needs at least {NEEDED_DATA.samples}"
        )
    elif data.step > NEEDED_DATA.interval:
        words = f"has a sample every {data.step:g} s, a calibration needs one every {NEEDED_DATA.interval:g} s"
    if words:
        raise CalibrationError(f"the recording {words}")
    for i, name in enumerate(names):
        seconds = data.seconds[np.isfinite(data.z[:, i])]
        # A unit may be slower than others, so its own rate counts.
        usual = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        share = len(seconds) * usual / (samples * data.step)
        if share < NEEDED_DATA.share:
            lost = ", ".join(
                f"{count[i]} {why.replace('_', ' ')}"
                for why, count in data.unusable.items()
            )
            raise CalibrationError(
                f"{name} gives a usable value in {percent(share)} of its samples, expected at least"
                f" {percent(NEEDED_DATA.share)}"
                f" ({lost}): mend it or name it in excluded_channels"
            )


def reference_channels(config: Config, geometry: Geometry, name: str) -> list[int]:
    """Return the reference channels among those in use, empty if all are alike."""
    names = geometry.channel_names
    units = source_of(config).units
    if not name:
        threes = map(list, itertools.combinations(range(geometry.n), 3))
        return (
            []
            if units
            else next(three for three in threes if spans_space(geometry.axes[three]))
        )
    wanted = (
        [f"{name}.{axis}" for axis in "xyz"]
        if name in units
        else [part.strip() for part in name.split(",")]
    )
    chosen = [names.index(part) for part in wanted if part in names]
    if (
        len(wanted) != 3
        or len(set(chosen)) != 3
        or not spans_space(geometry.axes[chosen])
    ):
        triads = f"one of: {', '.join(units)}; or " if units else ""
        raise ConfigError(
            f"--reference is {name!r}, expected {triads}three of: {', '.join(names)}, in use and not in one plane"
        )
    return chosen


def _sensors(
    config: Config, nominal: Geometry, data: Data, chosen: list[int], lost: list[int]
) -> Priors:
    """Return the axes as configured; arrays and unknown mounts take those of the motion."""
    source = source_of(config)
    axes = nominal.axes.copy()
    scale = np.full(nominal.n, SCALE_STD)
    means = data.slow_rates()
    if not source.units and len(means) >= TURNS.least_windows:
        x = means[:, chosen]
        found = np.linalg.lstsq(x, means, rcond=None)[0].T @ axes[chosen]
        least = np.linalg.eigvalsh(x.T @ x / len(x))[0]
        turns = np.sqrt(least) >= TURNS.least_rotation
        if turns and np.abs(found - axes).max() > UNKNOWN_AXES.axes:
            axes = found
            scale = np.full(nominal.n, UNKNOWN_AXES.axes)
    if lost:
        # Directions without rotation stay as configured.
        others = [i for i in range(nominal.n) if i not in lost]
        rate = means[:, others] @ np.linalg.pinv(axes[others]).T
        weak = max(len(means), 1) * LEAST_RATE**2 * np.eye(3)
        normal = rate.T @ rate + weak
        right = rate.T @ means[:, lost] + weak @ axes[lost].T
        axes[lost] = np.linalg.solve(normal, right).T
    scale[chosen] = REFERENCE_STD
    scale[lost] = UNKNOWN_AXES.mount
    # Channels that belong to no unit are of the first.
    units = list(dict.fromkeys(unit for unit in nominal.unit_of if unit)) or [""]
    unit = np.array([units.index(unit) if unit else 0 for unit in nominal.unit_of])
    delay = UNIT_DELAY if source.stamped else CHANNEL_DELAY
    turn_on_std = max(config.bias.turn_on_std, 1e-6)
    expected = np.zeros(len(units))
    return Priors(axes, unit, len(units), scale, turn_on_std, delay, expected)


class _Watched(Kept):
    """Keeps channel states, and the spectrum of differences of gyros from the fused rate."""

    def __init__(self, gyros: Sequence[str], rate: float) -> None:
        super().__init__(lambda output: (output.stamp, output.state))
        self.spectrum = Spectrum(gyros, rate)
        self.count = len(gyros)

    def begin_stretch(self) -> None:
        self.spectrum.begin_stretch()

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        super().add(block, output, pipeline)
        self.spectrum.add(output.residual[:, : self.count])


def _watch(
    block: Block, config: Config, names: Sequence[str], gyros: int
) -> tuple[tuple[Span, ...], Spectrum]:
    """Return the monitor's declarations on the channels, and the spectrum.

    The first ones are ``gyros``, the others accelerometers.
    """
    # Declarations then end with their cause. What the turning of the body adds is off.
    changes: dict[str, Value] = {
        "decision.latch": False,
        "accelerometers.positions": (),
    }
    pipeline = Pipeline(config.replaced(changes))
    watched = _Watched(pipeline.channel_names, config.sample_rate)
    Walk(pipeline, [watched]).take(block)
    known = pipeline.channel_names
    stamp, states = watched.columns
    state = states[:, [known.index(name) for name in names]]
    among = np.asarray(state == ChannelState.AMBIGUOUS)
    runs = [
        ([k], run)
        for k, states in enumerate(state.T)
        for run in flag_runs(states == ChannelState.FAULTY)
    ]
    of_forces = np.arange(len(names)) >= gyros
    for half in (~of_forces, of_forces):
        of_half = among & half
        doubted = np.asarray(of_half.any(axis=1))
        for run in flag_runs(doubted):
            channels = of_half[slice(*run)].any(axis=0)
            runs.append((np.flatnonzero(channels).tolist(), run))
    seconds = (stamp - stamp[0]) * 1e-9
    spans = [
        Span(tuple(channels), float(seconds[first]), float(seconds[end - 1]))
        for channels, (first, end) in runs
    ]
    return tuple(sorted(spans, key=lambda span: span.start)), watched.spectrum


def _without(faults: Sequence[Span], data: Data, names: tuple[str, ...]) -> Data:
    """Leave out short faults of few channels, and refuse lasting ones."""
    # A larger set says too little about which channels are right.
    few = (1 / 3) * len(names)
    clear = [span for span in faults if len(span.channels) <= few]
    z = data.z.copy()
    share = np.zeros(len(names))
    for span in clear:
        share[list(span.channels)] += (span.end - span.start) / data.duration
        # A fault may have begun 1 s before; most are declared sooner.
        rows = (data.seconds >= span.start - 1.0) & (data.seconds <= span.end)
        struck = np.ix_(np.flatnonzero(rows), np.array(span.channels))
        z[struck] = np.nan
    if share.max() > NEEDED_DATA.faulty:
        group = [names[i] for i in np.flatnonzero(share > NEEDED_DATA.faulty)]
        worst = int(share.argmax())
        first = next(span for span in clear if worst in span.channels)
        raise DisagreementError(
            f"{' or '.join(group)} disagrees with the others in {percent(share.max())} of the recording (from"
            f" {first.start:.1f} s): faulty; repair it, leave this part out with --start and --end, or name it in"
            " excluded_channels"
        )
    return replace(data, z=z)


def _settings(
    config: Config, active: Int, step: float, found: StateEstimate
) -> dict[str, object]:
    """Return the changed parameters, for samples every `step` s."""
    geometry = build_geometry(config)
    before = build_noise(config, geometry.n)
    source = source_of(config)

    def changed(values: ArrayLike, new: ArrayLike) -> Array:
        whole = np.broadcast_to(
            np.asarray(values, dtype=float),
            np.shape(geometry.axes)[: np.ndim(new) or 1],
        ).copy()
        whole[active] = new
        return whole

    settings: dict[str, object] = {
        "geometry.preset": "axes",
        "geometry.axes": _rounded(changed(geometry.axes, found.axes).ravel(), 6),
        "noise.noise_std": [
            float(f"{value:.4g}")
            for value in changed(
                before.noise_std, np.maximum(found.noise_std, LEAST_NOISE)
            )
        ],
        "noise.scale_std": _short(changed(before.scale_std, found.disagreement()[0])),
        "noise.timing_std": _short(
            changed(before.timing_std, _timing(config, active, found))
        ),
        "noise.nonlinearity_std": _short(
            changed(before.nonlinearity_std, _nonlinearity(before, active, found))
        ),
        "bias.fixed": _rounded(changed(config.bias.fixed or 0.0, found.bias), 7),
        "bias.startup_bias_duration": 0.0,
        # No single recording shows how biases differ from one start to the next.
        "bias.turn_on_std": config.bias.turn_on_std,
    }
    if found.bias_walk.value > 0:
        settings["noise.bias_walk"] = _short(
            changed(config.noise.bias_walk, found.bias_walk.value)
        )
    if source.stamped:
        total = np.array(source.delays)
        shown = np.abs(found.delay) > np.maximum(
            LEAST_SKEW, MOUNT_ERRORS.sigmas * found.delay_std
        )
        # Of all channels of a unit the first is taken.
        units, first = np.unique(
            [source.chip_of(int(channel)) for channel in active], return_index=True
        )
        total[units] += np.where(shown, found.delay, 0.0)[first]
        settings["imus.delays"] = _rounded(total - total[0], 6)
        if (needed := WAITS * float(np.ptp(total))) > config.imus.timeout:
            settings["imus.timeout"] = float(f"{needed:.2g}")
        # Within max_skew stamps count as one instant: then no delay is taken off.
        offset = np.abs(found.delay - np.round(found.delay / step) * step)
        hidden = offset[(offset > 2 * LEAST_SKEW) & (offset <= config.imus.max_skew)]
        if len(hidden):
            settings["imus.max_skew"] = float(f"{hidden.min() / 2:.2g}")
    return settings


def _timing(config: Config, active: Int, found: StateEstimate) -> Array:
    """Return the uncertainty of sampling instants (n,), s, as configured without motion."""
    before = build_noise(config, build_geometry(config).n).timing_std[active]
    error = (
        float(np.sqrt(np.mean(found.delay_std**2)))
        if source_of(config).stamped
        else 0.0
    )
    return np.where(error < np.maximum(before, LEAST_SKEW), error, before)


def _nonlinearity(before: NoiseModel, active: Int, found: StateEstimate) -> Array:
    """Return the nonlinearity of channels (n,): as configured, or more where the recording shows more.

    A recording shows the rates that were flown, and no larger ones.
    """
    usual = before.nonlinearity_std[active]
    shown = found.nonlinearity
    sure = shown.is_measured and shown.value > MOUNT_ERRORS.sigmas * shown.error
    return np.maximum(usual, shown.value if sure else 0.0)


def _rounded(values: Array, digits: int) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _short(values: Array) -> list[float]:
    numbers = [float(f"{value:.4g}") for value in values]
    return numbers[:1] if len(set(numbers)) == 1 else numbers
