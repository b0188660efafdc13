# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings through the pipeline, in one process or many: their rows, and what came of faults injected into them."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, read_block
from fdi_ros.config.config import Config
from fdi_ros.config.parameter_file import parameter_file, parameters_of
from fdi_ros.errors import BagError, FaultError, FdiError
from fdi_ros.fleet.dataset import CONFIGS, VEHICLES, Dataset
from fdi_ros.fleet.flights import Flight, InjectedFault, Judged, vehicle_of
from fdi_ros.fleet.watch import Watch
from fdi_ros.jobs import Cluster, run_jobs
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import RATE_TOLERANCE
from fdi_ros.replay.outcomes import finite
from fdi_ros.replay.summary import SampleRate, sample_rate_notes
from fdi_ros.replay.sweep import DEFAULT_FAULTS, Plan, Subject, parse_swept, sweep
from fdi_ros.setup.calibrate import REPLACED
from fdi_ros.setup.starting_config import starting_config_of
from fdi_ros.text import shown
from fdi_ros.yaml_file import read_yaml

_LIMITS: dict[str, tuple[type[int] | type[float], float, float]] = {
    "times": (int, 1, 1000),
    "within": (float, 0.01, 3600.0),
    "seed": (int, 0, 2**31 - 1),
}


def load_injection(path: Path) -> Plan:
    """Read what is injected: a mapping with any of ``faults``, ``times``, ``within`` (s) and ``seed``.

    ``faults`` lists texts as ``fdi sweep --fault`` takes them, ``kind=bias size=0.05,0.1``; default: those of a sweep.

    Raises
    ------
    FaultError
        If it is missing, or holds something else.
    """
    document = read_yaml(path, "study", FaultError)
    if not isinstance(document, dict):
        raise FaultError(f"study {path}: expected keys and values")
    if unknown := sorted(set(map(str, document)) - {"faults", *_LIMITS}):
        raise FaultError(f"study {path}: unknown key {unknown[0]!r}, expected: faults, {', '.join(_LIMITS)}")
    texts = document.get("faults", list(DEFAULT_FAULTS))
    if not isinstance(texts, list) or not texts or not all(isinstance(text, str) for text in texts):
        raise FaultError(f"study {path}: faults is no list of texts such as 'kind=bias size=0.05,0.1'")
    numbers = {name: _number(path, name, document[name]) for name in _LIMITS if name in document}
    return Plan(tuple(dict.fromkeys(one for text in texts for one in parse_swept(text))), **numbers)


def _number(path: Path, name: str, value: Any) -> Any:
    kind, low, high = _LIMITS[name]
    if isinstance(value, bool) or not isinstance(value, int | kind) or not low <= float(value) <= high:
        raise FaultError(f"study {path}: {name} is {value!r}, expected {low:g} to {high:g}")
    return kind(value)


CALIBRATED = 1_000_000
"""Samples that a calibration takes at most: the first ones of a long flight."""
ON = "on "
"""Begins the words on what a vehicle was calibrated on."""
Calibrate = Literal["none", "each", "first"]


@dataclass(frozen=True)
class Settings:
    """How every recording is judged."""

    parameters: str
    """Text of the parameter file; empty: of each recording what ``fdi inspect`` writes for it."""
    calibrate: Calibrate = "none"
    plan: Plan | None = None
    """Faults to be injected; None: none."""


@dataclass(frozen=True)
class Vehicle:
    """Settings of one vehicle, where they are not those of all."""

    parameters: str
    config: str
    """Where that text lies."""
    calibration: str
    """What it was calibrated on, or why it could not be."""
    rate: float = math.nan
    """Of that recording, Hz."""


def judge(flight: str, path: Path, settings: Settings, vehicle: Vehicle) -> Judged:
    """Judge one recording; what is wrong with it is said in its row.

    Parameters
    ----------
    flight
        Its key.
    path
        Where it lies.
    settings
        How all are judged.
    vehicle
        How this vehicle is.
    """
    row = _row(flight, path, vehicle)
    try:
        return _judged(row, path, settings, vehicle)
    except FdiError as error:
        return Judged(replace(row, error=_line(error)))
    except Exception as error:  # A defect met in one recording must not cost the others.
        return Judged(replace(row, error=f"defect of fdi_ros: {type(error).__name__}: {_line(error)}"))


def _row(flight: str, path: Path, vehicle: Vehicle) -> Flight:
    """Return the row of a recording that nothing is known of yet."""
    return Flight(
        flight=flight,
        path=str(path),
        vehicle=vehicle_of(path),
        config=vehicle.config,
        calibration=vehicle.calibration,
    )


def _judged(row: Flight, path: Path, settings: Settings, vehicle: Vehicle) -> Judged:
    text = own = vehicle.parameters
    row = replace(row, measured=bool(text))
    if not text:
        text = own = starting_config_of(path, "no config").text
    if settings.calibrate == "each":
        try:
            own, _ = calibrated(path, text)
            row = replace(row, calibration="on itself", measured=True)
        except FdiError as error:
            row = replace(row, calibration=f"refused: {_line(error)}")
    config = config_of(own)
    pipeline = Pipeline.from_config(config)
    pipeline.restart()
    watch = Watch(pipeline, row)
    with Recording(path) as recording:
        samples = Samples(recording, config, pipeline.geometry.n)
        for block in samples.blocks():
            watch.take(block)
        row = replace(
            watch.row(),
            messages=samples.messages,
            malformed=sum(samples.malformed.values()),
            damage="; ".join(recording.damage.report()),
        )
    if row.rate is not None and abs(row.rate / vehicle.rate - 1.0) > RATE_TOLERANCE:
        # Judged by the mounts of another vehicle healthy gyros would be called faulty.
        raise BagError(
            f"the vehicle is calibrated {vehicle.calibration} at {vehicle.rate:.4g} Hz, and this has {row.rate:.4g} Hz:"
            " another vehicle; give its recordings a folder of their own"
        )
    row = replace(row, doubts="; ".join(sample_rate_notes(SampleRate(config.sample_rate, row.rate))))
    faults: tuple[InjectedFault, ...] = ()
    if settings.plan is not None:
        faults, why = _injected(row, config, read_block(path, config), settings.plan)
        row = replace(row, not_injected=why)
    return Judged(row, watch.episodes(), watch.events(), faults, own if own != vehicle.parameters else "")


def _injected(row: Flight, config: Config, block: Block, plan: Plan) -> tuple[tuple[InjectedFault, ...], str]:
    """Inject every fault of a plan into every channel; or say why none or not all could be."""
    try:
        (tried,) = sweep([Subject(row.path, config, block)], plan)
    except FdiError as error:
        return (), _line(error)
    why = f"at {len(tried.skipped)} of {plan.times} times something stood declared" if tried.skipped else ""
    faults = tuple(
        InjectedFault(
            flight=row.flight,
            path=row.path,
            vehicle=row.vehicle,
            channel=tried.channels[trial.channel],
            fault=trial.swept.words,
            kind=trial.swept.kind,
            size=trial.swept.size,
            at=trial.fault.start,
            outcome=trial.scored.outcome.value,
            named_after=finite(trial.scored.isolated_after),
            found_after=finite(trial.scored.detected_after),
        )
        for trial in tried.trials
    )
    return faults, why


def calibrated(path: Path, parameters: str) -> tuple[str, float]:
    """Return the text of a parameter file, calibrated on a recording, and the sample rate of that, Hz.

    Raises
    ------
    FdiError
        If the recording does not show what is needed.
    """
    from fdi_ros.setup.calibrate import calibrate

    config = config_of(parameters)
    block = read_block(path, config, end=CALIBRATED / config.sample_rate)
    result = calibrate(block, config)
    values = config.parameters()
    kept = {name: values[name] for name in parameters_of(parameters) if name not in REPLACED}
    text = parameter_file({**kept, **result.settings}, f"made by fdi calibrate from {shown(path.name)}")
    return text, 1e9 / float(np.median(np.diff(block.stamp)))


def vehicle_calibrated(path: Path, parameters: str) -> tuple[str, float, str]:
    """Return the parameters calibrated on a recording, its rate, and nothing; or what to start from, and why not."""
    try:
        text = parameters or starting_config_of(path, "no config").text
    except FdiError as error:
        return parameters, math.nan, _line(error)
    try:
        return *calibrated(path, text), ""
    except FdiError as error:
        return text, math.nan, _line(error)


def config_of(parameters: str) -> Config:
    """Read settings from the text of a parameter file."""
    return Config.from_parameters(parameters_of(parameters))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())


# All recordings -------------------------------------------------------------------------------------------------------


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
        return Judged(replace(_row(key, path, vehicle), error=words))

    with dataset:
        if show is not None:
            show(len(paths) - len(left))
        for count, (_, judged) in enumerate(run_jobs(judge, jobs, workers, cluster, died), 1):
            if judged.parameters:
                config_file = dataset.write(f"{CONFIGS}/{judged.flight.flight}.yaml", judged.parameters)
                judged = replace(judged, flight=replace(judged.flight, config=str(config_file)))
            dataset.add(judged)
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
    found = _kept_vehicles(dataset)
    waiting = sorted({vehicle_of(path) for path in left} - found.keys())
    refusals: dict[str, Vehicle] = {}

    def died(_: int, words: str) -> tuple[str, float, str]:
        return "", math.nan, words

    for number in range(max(map(len, recordings.values()), default=0)):
        waiting = [name for name in waiting if number < len(recordings[name])]
        jobs = [(recordings[name][number], settings.parameters) for name in waiting]
        refused_by = []
        for k, (text, rate, refused) in run_jobs(vehicle_calibrated, jobs, workers, cluster, died):
            name, path = waiting[k], recordings[waiting[k]][number]
            if refused:
                refused_by.append(name)
                # What is said of the first stands if none of them allows it.
                refusals.setdefault(name, Vehicle(settings.parameters, "", f"{REFUSED}{path.name}: {refused}"))
            else:
                # Named by the recording, too: the file of a row stays as it is when recordings are added.
                file = f"{CONFIGS}/{_key(dataset, path)[:12]}.yaml"
                found[name] = Vehicle(text, str(dataset.write(file, text)), f"{ON}{path.name}", rate)
                # Recordings that are added are judged as those before.
                kept = {name: (Path(one.config).name, one.calibration, one.rate) for name, one in found.items()}
                dataset.write(f"{CONFIGS}/{VEHICLES}", json.dumps(kept, indent=2) + "\n")
        waiting = sorted(refused_by)
        if not waiting:
            break
    return refusals | found


def _kept_vehicles(dataset: Dataset) -> dict[str, Vehicle]:
    """Return the vehicles that were calibrated, by name, as far as their parameter files are there."""
    try:
        entries = json.loads(dataset.text(f"{CONFIGS}/{VEHICLES}")).items()
    except (OSError, ValueError, AttributeError, RecursionError):
        return {}
    found = {name: _kept_vehicle(dataset, entry) for name, entry in entries}
    return {name: vehicle for name, vehicle in found.items() if vehicle is not None}


def _kept_vehicle(dataset: Dataset, entry: Any) -> Vehicle | None:
    """Return what was kept of a vehicle; None if it is damaged: it is calibrated again."""
    try:
        file, words, rate = entry
        name = f"{CONFIGS}/{Path(file).name}"
        text = dataset.text(name)
        config_of(text)
        return Vehicle(text, str(dataset.folder / name), str(words), float(rate)) if words and text else None
    except (OSError, ValueError, TypeError, FdiError):
        return None
