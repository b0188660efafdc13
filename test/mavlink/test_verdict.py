# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One flight, judged from a bag of exact values, over MAVLink and from a telemetry log: one verdict."""

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bag.recordings import imu, write_mcap

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.monitor.pipeline import Pipeline
from mavlink.autopilots import NS, UTC, Autopilot, Conversation, Motion

SECONDS, STRIKES = 40.0, 20.0
FILES = Path(__file__).parents[2] / "config"
CONFIG = {
    stack: Config.from_file(FILES / f"{stack}.yaml") for stack in ("px4", "ardupilot")
}
START = 1000 * NS
"""Where the simulated time begins, ns."""


def flight(
    size: float,
    channel: tuple[int, int] = (1, 1),
    noise: float = 0.004,
    motion: float = 0.6,
) -> Motion:
    """Motion of three IMUs, with noise that depends on the time alone, and a bias of one channel in FRD."""
    noises = noise * np.random.default_rng(1).standard_normal((3, 3, 8192))

    def rates(t: float) -> np.ndarray:
        omega = motion * np.array(
            [math.sin(1.3 * t), math.cos(0.9 * t), 0.7 * math.sin(0.6 * t)]
        )
        z = omega + noises[:, :, round(t * 400) % 8192]
        if t >= STRIKES:
            z[channel] += size
        return z

    return rates


class Verdict(NamedTuple):
    faulty: tuple[str, ...]
    delay: float
    """Of the first declaration after the fault, s."""
    early: int
    """Declarations before it."""


def judge(path: Path, config: Config, strikes: float) -> Verdict:
    """Judge a recording; strikes is the stamp of the fault, s."""
    pipeline = Pipeline.from_config(config)
    events = []
    with Recording(path) as recording:
        for block in Samples(recording, config).blocks():
            events += pipeline.process(block).events
    declared = [event for event in events if event.declares]
    after = [
        event.stamp / NS - strikes for event in declared if event.stamp / NS >= strikes
    ]
    names = {
        pipeline.channel_names[e.channel] for e in declared if e.after.name == "FAULTY"
    }
    return Verdict(
        tuple(sorted(names)), min(after, default=math.inf), len(declared) - len(after)
    )


def write(path: Path, stack: str, samples: list[tuple]) -> Path:
    """Write samples, each a time, a unit, a stamp and a rate, as a bag."""
    topics = CONFIG[stack].imus.topics
    return write_mcap(
        path,
        [
            (f"/{topics[unit]}", at, imu(stamp, rate))
            for at, unit, stamp, rate in samples
        ],
    )


def over_mavlink(stack: str, motion: Motion, path: Path) -> tuple[Path, Path]:
    """Fly over a link: what came out of it as a bag, and what a ground station has written down."""
    autopilot, log = Autopilot(stack, motion), path / "flight.tlog"
    step = autopilot.step

    def logged(now: int) -> list[bytes]:
        out = step(now)
        file.writelines(
            struct.pack(">Q", UTC * 10**6 + now // 1000) + data for data in out
        )
        return out

    autopilot.step = logged
    autopilot.start += 10 * NS
    with log.open("wb") as file:
        talk = Conversation(autopilot).run(SECONDS)
    samples = [
        (at, sample.unit, sample.stamp, sample.rate) for at, sample in talk.samples
    ]
    return write(path / "link.mcap", stack, samples), log


def exact(stack: str, motion: Motion, path: Path) -> Path:
    times = [(k / 50, START + k * NS // 50) for k in range(round(50 * SECONDS))]
    samples = [
        (at, unit, at, rate)
        for t, at in times
        for unit, rate in enumerate(motion(t) * [1, -1, -1])
    ]
    return write(path / "exact.mcap", stack, samples)


@pytest.mark.parametrize(
    ("stack", "size", "channel"),
    [("px4", 0.2, (1, 1)), ("ardupilot", -0.1, (2, 0)), ("ardupilot", 0.0, (0, 0))],
)
def test_one_flight_has_one_verdict(
    tmp_path: Path, stack: str, size: float, channel: tuple[int, int]
) -> None:
    motion, config = flight(size, channel), CONFIG[stack]
    bag = judge(exact(stack, motion, tmp_path), config, START / NS + STRIKES)
    link, log = over_mavlink(stack, motion, tmp_path)
    live = judge(link, config, START / NS + STRIKES)
    logged_as = config.replaced({"imus.topics": [f"/imu_{k}" for k in (1, 2, 3)]})
    logged = judge(log, logged_as, UTC + START / NS + STRIKES)
    named = (f"imu_{channel[0] + 1}.{'xyz'[channel[1]]}",) if size else ()
    assert bag.faulty == live.faulty == logged.faulty == named
    assert (bag.early, live.early, logged.early) == (0, 0, 0)
    # A sample apart, and the other noise that steps and instants make.
    assert not size or max(bag.delay, live.delay, logged.delay) < 1.5
    assert size or bag.delay == live.delay == math.inf
    assert logged.delay == pytest.approx(live.delay, abs=0.1)


@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
def test_still_gyros_that_repeat_a_value_for_long_are_no_fault(
    tmp_path: Path, stack: str
) -> None:
    """With noise below the step, a gyro at rest says 0 for minutes, and the others turn their last bit now and then."""
    link, _ = over_mavlink(stack, flight(0.0, noise=0.0004, motion=0.0), tmp_path)
    assert judge(link, CONFIG[stack], START / NS) == Verdict((), math.inf, 0)
