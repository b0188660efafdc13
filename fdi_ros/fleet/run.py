# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Judge all recordings, in this process, in several, or on a cluster."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fdi_ros.fleet.dataset import CONFIGS, Dataset
from fdi_ros.fleet.judging import ON, Settings, Vehicle, given_up, judge, vehicle_calibrated
from fdi_ros.fleet.recordings import vehicle_of
from fdi_ros.fleet.rows import Judged
from fdi_ros.jobs import Cluster, run_jobs

REFUSED = "refused on "
"""Begins the words on why a vehicle could not be calibrated."""
Show = Callable[[int], object]
"""Is told how many recordings are done."""


def run_fleet(
    paths: Sequence[Path],
    settings: Settings,
    config: str,
    dataset: Dataset,
    workers: int = 1,
    cluster: Cluster | None = None,
    show: Show | None = None,
) -> tuple[set[str], int]:
    """Judge the recordings that are not there yet, and finish the dataset.

    Parameters
    ----------
    paths
        Of all recordings.
    settings
        How they are judged.
    config
        Where the parameter file lies; empty: there is none.
    dataset
        Takes the rows.
    workers, cluster
        As `fdi_ros.jobs.run_jobs` takes them.
    show
        Is told the progress.

    Returns
    -------
    Keys of the flights, and how many flights of other runs are in the tables, too.

    Raises
    ------
    FdiError
        If nothing can be written, or workers are lost.
    """
    keys = {path: _key(dataset, path) for path in paths}
    done = dataset.done()
    left = [path for path in paths if keys[path] not in done]
    common = Vehicle(settings.parameters, config, "")
    own = _vehicles(left, paths, settings, dataset, workers, cluster) if settings.calibrate == "first" else {}
    # What could not be calibrated is judged again as soon as its vehicle is.
    left += [
        path
        for path in paths
        if done.get(keys[path], "").startswith(REFUSED) and own.get(vehicle_of(path), common).calibration.startswith(ON)
    ]
    own = {name: one if one.config else replace(one, config=config) for name, one in own.items()}
    jobs: list[tuple[Any, ...]] = [(keys[path], path, settings, own.get(vehicle_of(path), common)) for path in left]

    def died(number: int, words: str) -> Judged:
        key, path, _, vehicle = jobs[number]
        return given_up(key, path, vehicle, words)

    with dataset:
        if show is not None:
            show(len(paths) - len(left))
        for count, (_, judged) in enumerate(run_jobs(judge, jobs, workers, cluster, died), 1):
            dataset.add(_with_config(judged, dataset))
            if show is not None:
                show(len(paths) - len(left) + count)
    return set(keys.values()), dataset.finish(set(keys.values()))


def _key(dataset: Dataset, path: Path) -> str:
    try:
        return dataset.key_of(path)
    except OSError:
        # Reading it will say what is wrong.
        return hashlib.sha256(os.fsencode(path)).hexdigest()[:32]


def _vehicles(
    left: Sequence[Path],
    paths: Sequence[Path],
    settings: Settings,
    dataset: Dataset,
    workers: int,
    cluster: Cluster | None,
) -> dict[str, Vehicle]:
    """Calibrate each vehicle on the first of its recordings, by name, that allows it; a former choice stands."""
    recordings: dict[str, list[Path]] = {}
    for path in paths:
        recordings.setdefault(vehicle_of(path), []).append(path)
    found = dataset.vehicles()
    waiting = sorted({vehicle_of(path) for path in left} - found.keys())
    refusals: dict[str, Vehicle] = {}
    for number in range(max(map(len, recordings.values()), default=0)):
        waiting = [name for name in waiting if number < len(recordings[name])]
        jobs = [(recordings[name][number], settings.parameters) for name in waiting]
        refused_by = []
        for k, (text, rate, refused) in run_jobs(vehicle_calibrated, jobs, workers, cluster, _not_calibrated):
            name, path = waiting[k], recordings[waiting[k]][number]
            if refused:
                refused_by.append(name)
                # What is said of the first stands if none of them allows it.
                refusals.setdefault(name, Vehicle(settings.parameters, "", f"{REFUSED}{path.name}: {refused}"))
            else:
                # Named by the recording, too: the file of a row stays as it is when recordings are added.
                file = f"{CONFIGS}/{_key(dataset, path)[:12]}.yaml"
                found[name] = Vehicle(text, str(dataset.write(file, text)), f"{ON}{path.name}", rate)
                dataset.keep_vehicles(found)
        waiting = sorted(refused_by)
        if not waiting:
            break
    return refusals | found


def _not_calibrated(_: int, words: str) -> tuple[str, float, str]:
    """Stand for a calibration that killed its worker."""
    return "", math.nan, words


def _with_config(judged: Judged, dataset: Dataset) -> Judged:
    """Keep the parameter file that a recording was calibrated to."""
    if not judged.parameters:
        return judged
    path = dataset.write(f"{CONFIGS}/{judged.flight.flight}.yaml", judged.parameters)
    return replace(judged, flight=replace(judged.flight, config=str(path)))
