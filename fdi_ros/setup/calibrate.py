# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording of the channels to the settings of the monitor: axes, biases, noise, and their standard errors.

`calibrate` takes samples; ``fdi setup`` and ``fdi calibrate`` read them from a recording and write the settings. Method
and formulas are in docs/calibration.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.errors import CalibrationError, ConfigError, DisagreementError
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.samples import Array, Block, Int
from fdi_ros.monitor.build import CHANNEL_DELAY, UNIT_DELAY, build_geometry, build_noise
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.run import Kept, Sink, Walk
from fdi_ros.report.spectrum import Spectrum
from fdi_ros.setup.agreement import LEAST_RATE, LEAST_ROTATION, LEAST_WINDOWS, SHOWN, check_agreement
from fdi_ros.setup.blocks import NOT_SHIFTED, PORTION, Data, Resampled, flag_runs, prepare_channels, spikes
from fdi_ros.setup.estimate import SCALE_STD, Priors, StateEstimate, estimate
from fdi_ros.setup.result import Calibration, Span, StampDelay
from fdi_ros.sources import source_of

UNKNOWN_MOUNT = 0.58
"""Of each component of an axis that may point anywhere."""
UNKNOWN_AXES = 0.1
"""The same of an array whose axes are found from the motion alone; those configured are not if they are off by more."""
REFERENCE_STD = 1e-6
"""Of channels that are taken for as configured."""
LEAST_DURATION = 10.0
"""s."""
LEAST_SAMPLES, LONGEST_STEP = 100, 1.0
"""Samples, and s from one to the next."""
LEAST_USABLE = 0.3
"""Share of its samples that a channel must give."""
MOST_FAULTY = 0.35
"""Share of the recording in which a channel may be faulty; with more, it cannot be said which channel is right."""
MOST_LEFT_OUT = 1 / 3
"""Share of the channels of a set that is left out: of a larger one nobody knows which are right."""
LOUDER = 4.0
"""A channel is given as at least so many times quieter than it usually is in motion: of more than that the monitor
would not believe, as the motion begins, that it is vibration."""
LEAD = 1.0
"""s before a declaration that a fault may have begun."""
LEAST_SKEW = 5e-5
"""What imus.max_skew is at least where delays smaller than it are to be taken off, s."""
WAITS = 2.5
"""What imus.timeout is at least, in differences of the delays of units."""
REPLACED = ("imus.mounts", "geometry.cone_channels")
"""Parameters that say nothing any more beside geometry.axes."""


def calibrate(block: Block, config: Config, reference: str = "", unknown: Sequence[int] = ()) -> Calibration:
    """Calibrate all channels that are not excluded.

    Parameters
    ----------
    block
        The recording: the more rest and rotation about all axes, the more is shown.
    config
        Nominal mounting, range of the gyros, excluded channels, and what else the monitor needs.
    reference
        Name of the triad that is taken for as configured, or of three channels with commas between; empty: no
        channel is believed more than the others (of an array: the first three that span space).
    unknown
        Numbers of channels of which nobody knows how they are mounted.

    Raises
    ------
    FdiError
        If the recording is too short, or its channels contradict each other, naming which.
    """
    full = build_geometry(config)
    active = np.array([i for i, name in enumerate(full.channel_names) if name not in config.excluded_channels])
    nominal, source = full.subset(np.isin(np.arange(full.n), active)), source_of(config)
    chosen = reference_channels(config, nominal, reference)
    data = prepare_channels(block, config, active.tolist())
    _check_amount(data, nominal.channel_names)
    spiky = spikes(data.z, nominal.axes)
    data.z[spiky] = np.nan
    lost = np.flatnonzero(np.isin(active, unknown)).tolist()
    if source.units:
        check_agreement(data, nominal, lost)
    sensors = _sensors(config, nominal, data, chosen)
    if lost:
        sensors.axes[lost] = _axes_against_others(data, sensors.axes, lost)
        sensors.scale_std[lost] = UNKNOWN_MOUNT
    try:
        found = estimate(data, sensors)
        settings = _settings(config, active, data.step, found)
        tried = Config.from_parameters({**config.parameters(), **settings})
        faults, spectrum = _watch(_aligned(block, data, found.delay, active), tried, active)
        if faults:
            _check_share(faults, data, nominal.channel_names)
            found = estimate(_left_out(data, faults), sensors)
            settings = _settings(config, active, data.step, found)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"the recording leaves the fit undetermined ({error})") from error
    delays = []
    for k in range(1, sensors.units):
        unit = np.flatnonzero(sensors.unit == k).tolist()
        delays.append(StampDelay(tuple(unit), float(found.delay[unit[0]]), float(found.delay_std[unit[0]])))
    return Calibration(
        names=nominal.channel_names,
        nominal=nominal.axes,
        estimate=found,
        timing=float(_timing(config, active, found).max()),
        delays=tuple(delays),
        faults=faults,
        unusable=data.unusable | {"spikes": np.asarray(spiky.sum(axis=0))},
        duration=len(data.stamp) * data.step,
        settings=settings,
        spectrum=spectrum,
    )


def _aligned(block: Block, data: Data, delay: Array, active: Int) -> Iterator[Block]:
    """Give the usable values, part by part, as the monitor will have them once the delays (n,), s, are taken off."""
    source, shifted = Resampled(data, delay), np.abs(delay) >= NOT_SHIFTED
    for first, end in itertools.pairwise([*range(0, len(block), PORTION), len(block)]):
        part, usable, moved = block[first:end], data.z[first:end], source.part(first, end)
        z, received = part.z.copy(), part.delivered.copy()
        z[:, active] = np.where(np.isfinite(usable) & ~shifted, usable, moved)
        # Where there is none for the instant, the value of another one is not it.
        received[:, active] = np.isfinite(z[:, active])
        yield Block(part.stamp, z, received)


def _check_amount(data: Data, names: tuple[str, ...]) -> None:
    """Refuse a recording that is too short, too slow, or lacks too much of a channel."""
    samples, duration = len(data.stamp), data.duration if len(data.stamp) else 0.0
    for few, words, needed in (
        (samples < 2 or duration < LEAST_DURATION, f"is {duration:.1f} s long", f"at least {LEAST_DURATION:g} s"),
        (samples < LEAST_SAMPLES, f"has {samples} samples", f"at least {LEAST_SAMPLES}"),
        (samples > 1 and data.step > LONGEST_STEP, "has a sample every {step:g} s", f"one every {LONGEST_STEP:g} s"),
    ):
        if few:
            step = data.step if samples > 1 else 0.0
            raise CalibrationError(f"the recording {words.format(step=step)}, a calibration needs {needed}")
    for i, name in enumerate(names):
        seconds = data.seconds[np.isfinite(data.z[:, i])]
        # Of those that it would give at its own rate: a unit may be slower than the others.
        usual = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        share = len(seconds) * usual / (samples * data.step)
        if share < LEAST_USABLE:
            lost = ", ".join(f"{count[i]} {why.replace('_', ' ')}" for why, count in data.unusable.items())
            raise CalibrationError(
                f"{name} gives a usable value in {share:.0%} of its samples, expected at least {LEAST_USABLE:.0%}"
                f" ({lost}): mend it or name it in excluded_channels"
            )


def reference_channels(config: Config, geometry: Geometry, name: str) -> list[int]:
    """Return the places of the reference channels among those in use; none: all are alike.

    Raises
    ------
    ConfigError
        If these are no three channels in use that span space.
    """
    names, units = geometry.channel_names, source_of(config).units
    if not name and units:
        return []
    if not name:
        return next(
            list(one) for one in itertools.combinations(range(geometry.n), 3) if spans_space(geometry.axes[list(one)])
        )
    wanted = [f"{name}.{axis}" for axis in "xyz"] if name in units else [part.strip() for part in name.split(",")]
    chosen = [names.index(part) for part in wanted if part in names]
    if len(wanted) != 3 or len(set(chosen)) != 3 or not spans_space(geometry.axes[chosen]):
        triads = f"one of: {', '.join(units)}; or " if units else ""
        raise ConfigError(
            f"--reference is {name!r}, expected {triads}three of: {', '.join(names)}, in use and not in one plane"
        )
    return chosen


def _sensors(config: Config, nominal: Geometry, data: Data, chosen: list[int]) -> Priors:
    source, axes, scale = source_of(config), nominal.axes.copy(), np.full(nominal.n, SCALE_STD)
    if not source.units:
        found = _axes_from_motion(data, axes, chosen)
        if np.abs(found - axes).max() > UNKNOWN_AXES:
            axes, scale = found, np.full(nominal.n, UNKNOWN_AXES)
    scale[chosen] = REFERENCE_STD
    # Channels that belong to no unit are of the first.
    units = list(dict.fromkeys(unit for unit in nominal.unit_of if unit)) or [""]
    unit = np.array([units.index(unit) if unit else 0 for unit in nominal.unit_of])
    delay = UNIT_DELAY if source.stamped else CHANNEL_DELAY
    return Priors(axes, unit, len(units), scale, max(config.bias.turn_on_std, 1e-6), delay)


def _axes_from_motion(data: Data, axes: Array, chosen: list[int]) -> Array:
    """Axes (n, 3) of all channels from those of three, by plain least squares; as they were where nothing turns."""
    means = data.slow_rates()
    x = means[:, chosen]
    if len(x) < LEAST_WINDOWS or np.sqrt(np.linalg.eigvalsh(x.T @ x / len(x))[0]) < LEAST_ROTATION:
        return axes
    return np.asarray(np.linalg.lstsq(x, means, rcond=None)[0].T @ axes[chosen])


def _axes_against_others(data: Data, axes: Array, lost: list[int]) -> Array:
    """Axes of channels of unknown mount by the rate that the others show; about what does not turn as they were."""
    means, others = data.slow_rates(), [i for i in range(len(axes)) if i not in lost]
    rate = means[:, others] @ np.linalg.pinv(axes[others]).T
    weak = max(len(means), 1) * LEAST_RATE**2 * np.eye(3)
    return np.asarray(np.linalg.solve(rate.T @ rate + weak, rate.T @ means[:, lost] + weak @ axes[lost].T).T)


class _Residuals(Sink):
    """Takes the spectrum of what channels differ by from the fused rate."""

    def __init__(self, names: Sequence[str], rate: float) -> None:
        self.spectrum = Spectrum(names, rate)

    def begin_stretch(self) -> None:
        self.spectrum.begin_stretch()

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        self.spectrum.add(output.residual)


def _watch(parts: Iterable[Block], config: Config, active: Int) -> tuple[tuple[Span, ...], Spectrum]:
    """Find when the monitor itself, with the settings found, has something declared, and the spectrum of residuals."""
    # So that what was declared ends when it has gone.
    pipeline = Pipeline.from_config(Config.from_parameters({**config.parameters(), "decision.latch": False}))
    kept = Kept(lambda output: (output.stamp, output.state[:, active]))
    residuals = _Residuals(pipeline.channel_names, config.sample_rate)
    walk = Walk(pipeline, [kept, residuals])
    for part in parts:
        walk.take(part)
    stamp, state = kept.columns
    seconds = (stamp - stamp[0]) * 1e-9
    spans = [
        Span((place,), float(seconds[first]), float(seconds[end - 1]))
        for place, states in enumerate(state.T)
        for first, end in flag_runs(states == ChannelState.FAULTY)
    ]
    among = np.asarray(state == ChannelState.AMBIGUOUS)
    for first, end in flag_runs(np.asarray(among.any(axis=1))):
        sets = tuple(int(place) for place in np.flatnonzero(among[first:end].any(axis=0)))
        spans.append(Span(sets, float(seconds[first]), float(seconds[end - 1])))
    return tuple(sorted(spans, key=lambda span: span.start)), residuals.spectrum


def _left_out(data: Data, faults: tuple[Span, ...]) -> Data:
    """Leave faults out that are of so few channels that the others are known to be right."""
    z = data.z.copy()
    for span in faults:
        if len(span.channels) <= MOST_LEFT_OUT * data.z.shape[1]:
            rows = (data.seconds >= span.start - LEAD) & (data.seconds <= span.end)
            z[np.ix_(np.flatnonzero(rows), np.array(span.channels))] = np.nan
    return replace(data, z=z)


def _check_share(faults: tuple[Span, ...], data: Data, names: tuple[str, ...]) -> None:
    """Refuse a channel that is faulty for so long that it may be the others that are wrong."""
    share = np.zeros(len(names))
    for span in faults:
        if len(span.channels) <= MOST_LEFT_OUT * len(names):
            share[list(span.channels)] += (span.end - span.start) / data.duration
    if share.max() > MOST_FAULTY:
        group = [names[i] for i in np.flatnonzero(share > MOST_FAULTY)]
        first = next(span for span in faults if int(share.argmax()) in span.channels)
        raise DisagreementError(
            f"{' or '.join(group)} disagrees with the others in {share.max():.0%} of the recording (from"
            f" {first.start:.1f} s): faulty; mend it, cut it out with --start and --end, or name it in"
            " excluded_channels"
        )


# Settings -------------------------------------------------------------------------------------------------------------


def _settings(config: Config, active: Int, step: float, found: StateEstimate) -> dict[str, object]:
    """Parameters to be changed, of samples every `step` s; channels that are not in use keep what they have."""
    all_axes = build_geometry(config).axes.copy()
    n = len(all_axes)
    all_axes[active] = found.axes
    all_bias = np.array(config.bias.fixed) if config.bias.fixed else np.zeros(n)
    all_bias[active] = found.bias
    before = build_noise(config, n)
    std, scale, timing = before.noise_std.copy(), before.scale_std.copy(), before.timing_std.copy()
    std[active], scale[active] = np.maximum(_noise(found), LEAST_NOISE), found.disagreement()[0]
    timing[active] = _timing(config, active, found)
    changed: dict[str, object] = {
        "geometry.preset": "axes",
        "geometry.axes": _rounded(all_axes.ravel(), 6),
        "noise.noise_std": [float(f"{value:.4g}") for value in std],
        "noise.scale_std": _short(scale),
        "noise.timing_std": _short(timing),
        "bias.fixed": _rounded(all_bias, 7),
        "bias.startup_bias_duration": 0.0,
        # No single recording shows how biases differ from one start to the next.
        "bias.turn_on_std": config.bias.turn_on_std,
    }
    if found.bias_walk.value > 0:
        walk = np.broadcast_to(np.array(config.noise.bias_walk), n).copy()
        walk[active] = found.bias_walk.value
        changed["noise.bias_walk"] = _short(walk)
    source = source_of(config)
    if source.stamped:
        total = np.array(source.delays)
        shown = np.abs(found.delay) > np.maximum(LEAST_SKEW, SHOWN * found.delay_std)
        # Of all channels of a unit the first is taken.
        units, first = np.unique([source.chip_of(int(channel)) for channel in active], return_index=True)
        total[units] += np.where(shown, found.delay, 0.0)[first]
        changed["imus.delays"] = _rounded(total - total[0], 6)
        if (needed := WAITS * float(np.ptp(total))) > config.imus.timeout:
            changed["imus.timeout"] = float(f"{needed:.2g}")
        if (narrow := _skew(config, step, found.delay)) < config.imus.max_skew:
            changed["imus.max_skew"] = narrow
    return changed


def _noise(found: StateEstimate) -> Array:
    """Noise (n,) of one sample as written, rad/s: the channels' own."""
    moving = found.moment[~found.rest]
    return np.maximum(found.floor.std, np.median(moving, axis=0) / LOUDER) if len(moving) else found.floor.std


def _timing(config: Config, active: Int, found: StateEstimate) -> Array:
    """Find what is not known of the sampling instants (n,), s; as configured where no motion shows it."""
    before = build_noise(config, build_geometry(config).n).timing_std[active]
    error = float(np.sqrt(np.mean(found.delay_std**2))) if source_of(config).stamped else 0.0
    return np.where(error < np.maximum(before, LEAST_SKEW), error, before)


def _skew(config: Config, step: float, delay: Array) -> float:
    """Find imus.max_skew, s, with which the delays (n,) s are taken off: within it, stamps count as one instant."""
    offset = np.abs(delay - np.round(delay / step) * step)
    hidden = offset[(offset > 2 * LEAST_SKEW) & (offset <= config.imus.max_skew)]
    return float(f"{hidden.min() / 2:.2g}") if len(hidden) else config.imus.max_skew


def _rounded(values: Array, digits: int) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _short(values: Array) -> list[float]:
    numbers = [float(f"{value:.4g}") for value in values]
    return numbers[:1] if len(set(numbers)) == 1 else numbers
