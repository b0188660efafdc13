# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""False declarations of sound gyros against what is asked for, through the whole monitor.

Hours of flight, each with a start-up at rest and then motion; axes and clocks are as the config says, and noise is as
strong as it says: white, or coloured by one autoregressive term. The monitor is cleared after each declaration.

    python benchmark/false_alarms.py [--detector NAME] [--events 300] [--workers 1] [--quick] [--json FILE]

Simulated are as many hours as would bring that many events, but at most --hours.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

from conditions import Noise, autoregressive, white
from trials import IDEAL, Rng, Table, arguments_of, configs_of, flight_of, generator, renewed, size_of

from fdi_ros import Config, Pipeline

PER_HOUR = (10.0, 1.0, 0.1)
NOISES: dict[str, Noise] = {"white": white, "AR(1) 0.5": autoregressive(0.5), "AR(1) 0.9": autoregressive(0.9)}
AT_ONCE = 10
"""Hours of one job."""


def fly(pipeline: Pipeline, noise: Noise, rng: Rng) -> int:
    """Fly for an hour; return the declarations."""
    flight = flight_of(pipeline, rng, 3600.0, ideal=True)
    events = 0
    for output in pipeline.steps(flight.block(noise(rng, *flight.clean.shape))):
        if any(event.declares for event in output.events):
            events += 1
            pipeline.reset()
    return events


def job(config: Config, noise: str, seed: int, words: tuple[object, ...], hours: range) -> int:
    pipeline, events = Pipeline.from_config(config), 0
    for hour in hours:
        pipeline = renewed(pipeline)
        events += fly(pipeline, NOISES[noise], generator(seed, *words, hour))
    return events


def main() -> None:
    about: dict[str, dict[str, Any]] = {
        "events": {"type": float, "default": 300.0, "help": "asked for; 60 with --quick"},
        "hours": {"type": float, "default": 600.0, "help": "of each row at most; 20 with --quick"},
        "workers": {"type": int, "default": 1, "help": "processes"},
    }
    arguments = arguments_of(__doc__, **about)
    wanted, most = size_of(arguments, "events", 60.0), size_of(arguments, "hours", 20.0)
    table = Table(
        mounting="<9",
        noise="<9",
        an_hour=">7g",
        hours=">6d",
        asked=">6.1f",
        events=">6d",
        over_asked=">6.2f",
        error=">5.2f",
        took_s=">7.1f",
    )
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        for per_hour in PER_HOUR:
            settings = {**IDEAL, "detector.false_alarms_per_hour": per_hour}
            for mounting, config in configs_of(arguments, settings).items():
                for noise in NOISES:
                    begun, hours = time.perf_counter(), max(round(min(wanted / per_hour, most)), 1)
                    parts = [range(k, min(k + AT_ONCE, hours)) for k in range(0, hours, AT_ONCE)]
                    words = (mounting, noise, per_hour)
                    jobs = [pool.submit(job, config, noise, arguments.seed, words, part) for part in parts]
                    events, asked = sum(done.result() for done in jobs), per_hour * hours
                    table.add(
                        mounting=mounting,
                        noise=noise,
                        an_hour=per_hour,
                        hours=hours,
                        asked=asked,
                        events=events,
                        over_asked=events / asked,
                        error=max(events, 1) ** 0.5 / asked,
                        took_s=time.perf_counter() - begun,
                    )
    table.write(arguments)


if __name__ == "__main__":
    main()
