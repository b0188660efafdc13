"""A calibration's recording over time: motion, rest, residuals before and after, noise by time scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.data import Array, Mask, find_rest, prepare
from fdi_ros.calibration.result import Calibration
from fdi_ros.calibration.spectra import allan_deviation, runs_of, spectral_density
from fdi_ros.config.config import Config
from fdi_ros.model.block import Block
from fdi_ros.monitor.pipeline import Pipeline


@dataclass(frozen=True)
class Noise:
    """Noise of n channels by time scale: Allan deviation and spectral density.

    Attributes
    ----------
    seconds
        Length of all that it is taken from, s.
    time, deviation
        (T,) s and (T, n) rad/s.
    frequency, density
        (F,) Hz and (F, n) rad/s per square root of Hz.
    """

    seconds: float
    time: Array
    deviation: Array
    frequency: Array
    density: Array


@dataclass(frozen=True)
class Course:
    """What the monitor makes of the recording, with the settings as they were and as they are now.

    Attributes
    ----------
    seconds
        (N,) from the first sample.
    rate
        (N, 3) fused with the new settings, rad/s; NaN where there is none.
    before, after
        (N, n) residuals of the channels in use with the old and with the new settings, rad/s.
    rest
        First and last time of each span at rest, s.
    still
        Noise of the channels at rest.
    moving
        Noise of the new residuals in motion.
    """

    seconds: Array
    rate: Array
    before: Array
    after: Array
    rest: tuple[tuple[float, float], ...]
    still: Noise
    moving: Noise


def follow(block: Block, config: Config, result: Calibration) -> Course:
    """Run the recording through the monitor with both settings.

    Parameters
    ----------
    block
        The recording that was calibrated on.
    config
        As it was.
    result
        Of the calibration.
    """
    channels = list(result.channels)
    old = Pipeline.from_config(config).process(block)
    tried = Config.from_parameters({**config.parameters(), **result.settings})
    new = Pipeline.from_config(tried).process(block)
    received = None if block.received is None else block.received[:, channels]
    rates = np.broadcast_to(np.array(config.health.max_rate), block.z.shape[1])
    data = prepare(Block(block.stamp, block.z[:, channels], received), rates[channels])
    still = find_rest(data, config.bias.max_rest_rate).window[data.window]
    spans = [data.seconds[[run.start, run.stop - 1]].tolist() for run in runs_of(still, data.seconds, data.step)]
    after = new.residual[:, channels]
    moving = np.isfinite(after).all(axis=1) & ~still
    return Course(
        data.seconds,
        new.rate,
        old.residual[:, channels],
        after,
        tuple((first, last) for first, last in spans),
        _noise(data.z, still & data.complete, data.seconds, data.step),
        _noise(after, moving, data.seconds, data.step),
    )


def _noise(values: Array, rows: Mask, seconds: Array, step: float) -> Noise:
    runs = [values[run] for run in runs_of(rows, seconds, step)]
    return Noise(float(rows.sum()) * step, *allan_deviation(runs, step), *spectral_density(runs, step))
