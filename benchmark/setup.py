# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What settings made from a recording are worth: python benchmark/setup.py PART [--trials N] [--seed N].

vibration: a recording of rest, turns by hand and a flight of 1 rad/s with white vibration, six channels of
config/two_imus.yaml at 100 Hz without scale and timing errors; `fdi setup` on it; biases of 0.02 rad/s in that flight,
one channel at a time: named within 4 s.

vehicles: simulated vehicles of every kind of recording (`fdi_ros.experiments.simulate`), two and three units: errors of
the estimate over its stated standard deviations, root mean square; and how often the truth lies within two of its
stated uncertainties of what is written: the scale error left between channels, and the delays.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from trials import write_bag

from fdi_ros import Block, Config, Pipeline
from fdi_ros.experiments.simulate import GyroErrors, Motion, regular_stamps
from fdi_ros.model.samples import Array
from fdi_ros.setup.calibrate import calibrate
from fdi_ros.setup.run import set_up

ROOT = Path(__file__).resolve().parents[1]
# The vehicles are those of the tests.
sys.path.append(str(ROOT / "test"))

from vehicles import KINDS, flight, turns_by_hand, vehicle  # noqa: E402

RATE = 100.0
START = 10**18
VIBRATIONS = (0.0, 0.002, 0.003, 0.005, 0.008, 0.02)
"""Standard deviation of the white vibration of every channel in flight, rad/s."""
FAULT, WITHIN = 0.02, 4.0
"""Bias that is to be named, rad/s, and in how many s."""
FLIES = 60.0
"""When the flight begins, s."""
FLIGHT = 60.0
"""How long it lasts, s."""


def recording(vibration: float, seed: int) -> Block:
    """Rest, turns by hand, a flight with white vibration."""
    rng = np.random.default_rng([20, seed])
    geometry = Pipeline.from_config(Config.from_file(ROOT / "config" / "two_imus.yaml")).geometry
    hand = turns_by_hand(20.0)
    flown = flight(rng, FLIES, FLIGHT, 1.0 / np.sqrt(3))
    motion = Motion(np.array([0.0, *hand[0], *flown[0]]), np.array([np.zeros(3), *hand[1], *flown[1]]))
    gyros = GyroErrors(scale_std=0.0, misalignment_std=0.0, delay_std=0.0).draw(geometry, rng)
    block = gyros.measure(motion, regular_stamps(FLIES + FLIGHT, RATE, START), rng)
    flying = (block.stamp - START) * 1e-9 > FLIES
    return Block(block.stamp, block.z + vibration * flying[:, None] * rng.standard_normal(block.z.shape))


def named_in_flight(block: Block, config: Config, channel: int, at: float) -> tuple[float, bool]:
    """When a bias of one channel from a time on, s, is named, and whether anything else was declared before."""
    pipeline = Pipeline.from_config(config)
    since = (block.stamp - block.stamp[0]) * 1e-9 - at
    rows = since < WITHIN + 0.01
    z = block.z[rows].copy()
    z[since[rows] >= 0, channel] += FAULT
    events = [e for e in pipeline.process(Block(block.stamp[rows], z)).events if e.declares]
    times = [(e.stamp - block.stamp[0]) * 1e-9 - at for e in events]
    wrong = any(
        t < 0 or (e.after.name == "FAULTY" and e.channel != channel) for t, e in zip(times, events, strict=True)
    )
    own = [t for t, e in zip(times, events, strict=True) if e.after.name == "FAULTY" and e.channel == channel]
    return (min(own) if own else np.inf), wrong


def of_setup(block: Block, topics: tuple[str, ...]) -> Config:
    """Config that `fdi setup` makes of a recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        write_bag(block, topics, path)
        return set_up(path).config


def vibration(trials: int, seed: int) -> None:
    """Print the table of vibrations."""
    print("| vibration, rad/s | named in 4 s | before or wrong | noise_std | scale_std | timing_std, ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    for v in VIBRATIONS:
        named = wrong = count = 0
        for trial in range(trials):
            block = recording(v, seed + trial)
            config = of_setup(block, ("/imu_1/data_raw", "/imu_2/data_raw"))
            for channel in range(block.z.shape[1]):
                delay, other = named_in_flight(block, config, channel, FLIES + 0.6 * FLIGHT)
                named, wrong, count = named + (delay <= WITHIN), wrong + other, count + 1
        noise = config.noise
        span = f"{min(noise.noise_std):.4f} to {max(noise.noise_std):.4f}"
        print(
            f"| {v:g} | {named} of {count} | {wrong} | {span} | {max(noise.scale_std):.4f} |"
            f" {1e3 * max(noise.timing_std):.2f} |",
            flush=True,
        )


def vehicles(trials: int, seed: int) -> None:
    """Print the table of vehicles."""
    print(f"{trials} vehicles of each kind\n")
    print("| recording | units | axes | axes between channels | biases | delays | scale_std within | delays within |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for kind in KINDS:
        for units in (2, 3):
            rows = [errors_of(seed + trial, kind, units) for trial in range(trials)]
            axes, apart, biases, delays, scale, within = (np.array(column) for column in zip(*rows, strict=True))
            rms = [f"{np.sqrt(np.mean(np.square(column))):.2f}" for column in (axes, apart, biases, delays)]
            print(f"| {kind} | {units} | {' | '.join(rms)} | {scale.mean():.0%} | {within.mean():.0%} |", flush=True)


def errors_of(seed: int, kind: str, units: int) -> tuple[float, ...]:
    """Errors of one estimate over stated standard deviations, root mean square; and whether the rest is within two."""
    made = vehicle(seed, kind, units)
    result = calibrate(made.block, made.config)
    found, n = result.estimate, len(made.axes)
    off = (found.axes - made.axes).ravel()
    # What all channels have in common is no channel's error.
    left = np.linalg.svd(np.kron(np.eye(n) - made.axes @ np.linalg.pinv(made.axes), np.eye(3)))[0][:, : 3 * (n - 3)]
    apart, known = left.T @ off, left.T @ found.axes_covariance @ left
    size, uncertainty = result.scale
    delays = (found.delay[::3] - made.late)[1:] / found.delay_std[3::3]
    return (
        rms(off / np.sqrt(np.diag(found.axes_covariance))),
        float(np.sqrt(apart @ np.linalg.solve(known, apart) / len(apart))),
        rms((found.bias - made.bias) / result.bias_std),
        rms(delays),
        float(abs(rms(apart) - size) < 2 * uncertainty),
        float((np.abs(delays) < 2).mean()),
    )


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


PARTS = {"vibration": vibration, "vehicles": vehicles}


def main() -> None:
    """Measure one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    PARTS[arguments.part](arguments.trials, arguments.seed)


if __name__ == "__main__":
    main()
