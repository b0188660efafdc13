# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a setup or a calibration found, with its uncertainty, what is weak, and what to do next.

In words and tables, as JSON, and as a page.
"""

from __future__ import annotations

import shlex

import numpy as np

from fdi_ros.model.samples import Array, Mask
from fdi_ros.model.thresholds import summary_line
from fdi_ros.replay.sweep_report import declared_figures
from fdi_ros.report.layout import (
    RADIANS,
    Column,
    Section,
    Unit,
    colour_of,
    drawn,
    escape,
    figures_of,
    page,
    section_lines,
    time_layout,
    told,
)
from fdi_ros.report.verdict import Severity, Verdict
from fdi_ros.setup.blocks import flag_runs
from fdi_ros.setup.fitness import copy_words
from fdi_ros.setup.inspect import topic_columns, troubles
from fdi_ros.setup.mounting import fault_sections, pair_lines
from fdi_ros.setup.result import Calibration, Delay, calibration_figures, channel_columns, faults_words, noisier
from fdi_ros.setup.run import SIZES, TIMES, WITHIN, SetupResult
from fdi_ros.sources import source_of
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

LEAST_JUDGED = 0.5
"""Share of the samples that a monitor should judge."""
MOST_WARNINGS = 5
MOST_POINTS = 2000
"""Of a curve on the page."""
CONFIG_HINT = "As written; loaded back, and a monitor was built from it."
NOISE_HINT = (
    "Of one sample, over 10 s around, vibration included. noise_std is its lower envelope, marked at the left: what"
    " vibration adds is measured by the monitor as it goes."
)
BIAS_HINT = "Best estimate over the recording, each minus its mean; what all have in common shows at rest alone."


# In words -------------------------------------------------------------------------------------------------------------


def verdict(found: SetupResult, unit: Unit = RADIANS) -> Verdict:
    """Say in one line whether the settings may be used, and why not."""
    proof = found.proof
    tried = proof.before if found.kept else proof.after
    judged = 0.0 if tried.baseline is None else tried.baseline.judged
    if found.disagree:
        return Verdict(Severity.BAD, f"DO NOT USE: {found.refused}")
    if found.calibration is None and not source_of(found.config).units:
        return Verdict(
            Severity.BAD, f"DO NOT USE: the axes of the array are not known (a cone is assumed): {found.refused}"
        )
    if judged < LEAST_JUDGED:
        why = tried.note or "channels are missing"
        return Verdict(Severity.BAD, f"DO NOT USE: only {judged:.0%} of the samples of the proof are judged: {why}")
    if tried.declared:
        words = f"the monitor declares {tried.declared_words} on {proof.source}"
        return Verdict(Severity.BAD, f"DO NOT USE: {words}: a gyro is faulty there, or the settings do not fit it")
    if found.kept:
        words = f"on {proof.source}, {found.kept}; the settings before are written"
        return Verdict(Severity.UNKNOWN, f"NO BETTER THAN BEFORE: {words}")
    if found.calibration is None:
        return Verdict(Severity.UNKNOWN, f"USABLE, NOT CALIBRATED: {found.refused}")
    looks = [copy_words(found.reports), noisier(found.calibration, unit), faults_words(found.calibration)]
    if looks := [words for words in looks if words]:
        return Verdict(Severity.UNKNOWN, f"USABLE, BUT LOOK: {'; '.join(looks)}")
    words = "nothing is declared without a fault"
    if not found.mounting.whole.isolable:
        return Verdict(Severity.GOOD, f"USABLE: {words}; a fault is detected, which channel it is not")
    if tried.isolated:
        isolated, biases = (sum(counts) for counts in zip(*tried.isolated.values(), strict=True))
        words += f"; {isolated} of {biases} biases of {SIZES[0]:g} to {SIZES[-1]:g} rad/s isolated on {proof.source}"
    return Verdict(Severity.GOOD, f"USABLE: {words}")


def found_lines(found: SetupResult, unit: Unit = RADIANS) -> list[str]:
    """List what was found, one line each."""
    rate, n, result = found.config.sample_rate, len(found.names), found.calibration
    units = source_of(found.config).units
    lines = [
        f"{n} channels in {f'{len(units)} units' if units else 'one array'} at {rate:.4g} Hz",
    ]
    if known := [mount for mount in found.mounts[1:] if mount.shown]:
        lines.append(f"mounts: {len(known)} of {len(found.mounts) - 1} against {found.config.imu_names[0]}")
    if result is not None:
        seconds = result.seconds
        lines.append(f"axes, biases and noise, from {seconds.rest:.1f} s at rest and {seconds.motion:.1f} s in motion")
        lines += noise_lines(result, unit)
    g = found.mounting
    return [*lines, summary_line(g.geometry, g.noise, g.false_alarm_probability, agree=not found.disagree)]


def noise_lines(result: Calibration, unit: Unit = RADIANS) -> list[str]:
    """Noise, what is left of the errors in motion, the walk of the biases, and the delays."""
    found, name, factor = result.estimate, unit.name, unit.factor
    std, usual = found.floor.std * factor, np.median(found.moment, axis=0) * factor
    walk = f"biases walk {found.walk.value * factor:.2g} {name} per sqrt(s)"
    if not found.walk.value:
        walk = f"no walk of the biases shown, below {found.walk.possible * factor:.2g} {name} per sqrt(s)"
    return [
        f"noise_std {std.min():.2g} to {std.max():.2g} {name}, from the quietest {found.floor.share:.0%} of the"
        f" recording; usually {usual.min():.2g} to {usual.max():.2g}",
        f"scale_std {result.scale[0]:.2g} +- {result.scale[1]:.1g}, timing_std {1e3 * result.timing:.2g} ms; {walk}",
        *(_delay_line(result, delay) for delay in result.delays),
    ]


def _delay_line(result: Calibration, delay: Delay) -> str:
    names = ", ".join(result.names[i] for i in delay.channels)
    size, error = 1e3 * abs(delay.value), 1e3 * delay.error
    side = "late (measured earlier than stamped)" if delay.value > 0 else "early (measured later than stamped)"
    words = f"{names}: stamps {size:.2f} +- {error:.2f} ms {side} against the first unit"
    if "imus.delays" not in result.settings:
        return f"{words}, not taken off: one message"
    return f"{words}, {'taken off' if delay.shown else 'not taken off: it may be none'}"


def unknown_lines(found: SetupResult) -> list[str]:
    """List what the recording does not show, what is taken instead, and how to get it, one line each."""
    lines = list(found.damage) + list(found.calibration.weak if found.calibration is not None else ())
    if found.calibration is None:
        lines.append(f"no calibration: {found.refused}. Axes, delays and noise in motion are not known")
    unshown = [f"{n} ({m.words})" for n, m in zip(found.config.imu_names, found.mounts, strict=False) if not m.shown]
    if unshown:
        lines.append(f"mounts taken for the identity: {'; '.join(unshown)}")
    if not found.chosen:
        return [shown(line, LINE) for line in lines]
    if source_of(found.config).units:
        lines.append(
            "where the vehicle's forward, left and up are: the body frame is that of the mounts, all units together;"
            " turn all axes of the config if it is mounted otherwise"
        )
    elif found.calibration is None:
        lines.append(
            "the axes of an array: those in the config are an assumption (a cone); nothing that the monitor says is"
            " worth anything before the true ones stand there (geometry.axes, or a preset)"
        )
    else:
        lines.append(
            "the body frame: of an array only how its channels hang together is seen; the axes of its first three are"
            " an assumption (a cone)"
        )
    lines.append(
        f"the range of the gyros (health.max_rate: see the data sheet), and how biases differ from start to start"
        f" (bias.turn_on_std: {found.config.bias.turn_on_std:g} rad/s is assumed)"
    )
    possible = [report for report in found.reports if report.could_be_gyros and report.kind is not None]
    if others := [report.topic.name for report in possible if report not in found.chosen]:
        lines.append(f"topics that were not used, though they could be gyros: {', '.join(others)}")
    return [shown(line, LINE) for line in lines]


def warning_lines(found: SetupResult) -> list[str]:
    """List what to look at before the config is trusted: one line for each kind of trouble, the worst first."""
    lines = list(found.calibration.warnings) if found.calibration is not None else []
    lines += [copies] if (copies := copy_words(found.reports)) else []
    for report in found.chosen:
        words = [f"{report.gaps} gaps of up to {report.longest:.2g} s"] if report.gaps else []
        if words := words + troubles(report):
            lines.append(f"{report.topic.name}: {', '.join(words)}")
    if limits := [line for line in pair_lines(found.mounting) if "not" in line.split(":")[-1] or "never" in line]:
        lines.append("; ".join(limits))
    kept = (
        lines if len(lines) <= MOST_WARNINGS else [*lines[: MOST_WARNINGS - 1], "; ".join(lines[MOST_WARNINGS - 1 :])]
    )
    return [shown(line, LINE) for line in kept]


def next_lines(bag: str, config: str, usable: bool) -> list[str]:
    """List what to do with the config."""
    bag, config = shlex.quote(bag), shlex.quote(config)
    replay = f"fdi replay {bag} --config {config} --report replay.html   # what the monitor says of this recording"
    if not usable:
        return [replay]
    return [
        replay,
        f"fdi sweep {bag} --config {config} --report sweep.html     # which faults it would find in it",
        f"fdi calibrate ANOTHER_BAG --config {config} --output better.yaml   # with rest and turns about every axis",
        f"fdi_node --ros-args --params-file {config}   # on the vehicle; in a workspace: ros2 run fdi_ros fdi_node ...",
    ]


# In tables ------------------------------------------------------------------------------------------------------------


def _mounts(found: SetupResult) -> list[Column]:
    """Figures of the mount of every unit."""
    mounts = found.mounts
    shared = [f"{max(mount.shared, 0.0):.1%}" if k else "-" for k, mount in enumerate(mounts)]
    return [
        Column("unit", found.config.imu_names[: len(mounts)], ("unit",)),
        Column("known", [mount.shown for mount in mounts]),
        Column("rotation", [mount.rotation for mount in mounts]),
        Column("error_rad", [mount.error if mount.shown else None for mount in mounts]),
        Column("off_rad", [mount.off for mount in mounts]),
        Column("", [mount.words for mount in mounts], ("mount",)),
        Column("", shared, ("motion in common with the first",)),
    ]


def _tried(found: SetupResult) -> list[Column]:
    """Figures of the settings before and after on the recording of the proof."""
    both = [found.proof.before, found.proof.after]
    declared = ["-" if one.baseline is None else one.declared_words for one in both]
    shares = [[one.isolated.get(size, (0, 0)) for size in SIZES] for one in both]
    isolated = [[{"size": s, "isolated": n, "tried": m} for s, (n, m) in one.isolated.items()] for one in both]
    return [
        Column("", ("before", "new"), ("settings",)),
        Column("", declared, ("declared",)),
        Column(
            "judged", [one.baseline.judged if one.baseline is not None else 0.0 for one in both], ("judged",), ".0%"
        ),
        Column("declared", [declared_figures(one.baseline) for one in both]),
        Column("isolated", isolated),
        Column(
            "",
            shares,
            [f"{size:g} rad/s isolated" for size in SIZES],
            lambda share: f"{share[0]} of {share[1]}" if share[1] else "-",
        ),
    ]


def setup_figures(found: SetupResult, bag: str) -> dict[str, object]:
    """Return everything, for programs, in SI units."""
    result, first = found.calibration, verdict(found)
    return {
        "bag": bag,
        "verdict": {"severity": first.severity.value, "words": first.words},
        "found": found_lines(found),
        "not_found": unknown_lines(found),
        "warnings": warning_lines(found),
        "topics": [report.topic.name for report in found.chosen],
        "mounts": figures_of(_mounts(found)),
        "calibrated": result is not None,
        "no_better": found.kept,
        **({} if result is None else calibration_figures(result)),
        "parameters": found.parameters,
        "proof": {
            "source": found.proof.source,
            "kept_aside": found.proof.apart,
            "seconds": found.proof.seconds,
            **dict(zip(("before", "after"), figures_of(_tried(found)), strict=True)),
        },
    }


# For a terminal, and as a page ----------------------------------------------------------------------------------------


def setup_sections(found: SetupResult, bag: str, config: str, unit: Unit = RADIANS) -> list[Section]:
    """Lay out what a reader is to know first."""
    proof, result, usable = found.proof, found.calibration, verdict(found).severity is not Severity.BAD
    hint = (
        f"Replay of {proof.source}: as it is, and with a bias on each channel at {TIMES} times,"
        f" to be isolated within {WITHIN:g} s."
    )
    sections = [
        Section("Warnings", "", warning_lines(found)),
        Section("Not shown by this recording", "", unknown_lines(found)),
        Section("Proof", hint, told(_tried(found))),
        Section("What to do next", "", [shown(line, LINE) for line in next_lines(bag, config, usable)]),
    ]
    if result is not None:
        channels = told(channel_columns(result, unit), unit)
        sections.insert(0, Section("Axes, biases and noise", "With standard errors (+-).", channels))
    return sections


def setup_text(found: SetupResult, bag: str, config: str, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    first = shown(verdict(found, unit).words, LINE)
    lines = [first, "", f"{shown(bag, LINE)}: found", *(f"  {line}" for line in found_lines(found, unit))]
    for section in setup_sections(found, bag, config, unit):
        lines += ["", *section_lines(section)]
    return "\n".join([*lines, "", ""])


def setup_page(found: SetupResult, bag: str, config: str) -> str:
    """Return everything, and the course of it over time, as a page."""
    topics = [report for report in found.reports if report.could_be_gyros]
    used = Column("", ["yes" if report in found.chosen else "no" for report in topics], ("used",))
    sections = [
        *setup_sections(found, bag, config),
        *_courses(found.refused, found.calibration),
        *([Section("Mounts", "", told(_mounts(found)))] if found.mounts else []),
        *([Section("Topics", "The whole recording.", told([*topic_columns(topics), used]))] if topics else []),
        *fault_sections(found.mounting),
        Section("The config", CONFIG_HINT, f'<div class="scroll"><pre>{escape(found.text)}</pre></div>'),
    ]
    first = verdict(found)
    summary = [first.words, *(f"Found: {line}." for line in found_lines(found))]
    return page(f"fdi_ros: settings from {bag}", summary, sections, severity=first.severity)


def _courses(refused: str, result: Calibration | None) -> list[Section]:
    """Plot what changes over the recording."""
    if result is None:
        return [Section("Axes, delays and biases", f"Not known: {refused}.")]
    found = result.estimate
    rests = _spans(found.blocks.time, found.rest)
    usual = time_layout(300, yaxis={"type": "log", "title": {"text": "noise, rad/s"}}, shapes=rests)
    walk = time_layout(280, yaxis={"title": {"text": "bias minus its mean, rad/s"}}, shapes=rests)
    rate = time_layout(260, yaxis={"title": {"text": "rate, rad/s"}}, shapes=rests)
    times = found.blocks.time
    floors = [
        {**_curve(name, times[:1], found.floor.std[i : i + 1], i), "mode": "markers", "showlegend": False}
        for i, name in enumerate(result.names)
    ]
    curves = [_curve(name, times, found.moment[:, i], i) for i, name in enumerate(result.names)]
    biases = [_curve(name, found.times, found.curve[:, i] - found.bias[i], i) for i, name in enumerate(result.names)]
    turns = [_curve(axis, found.blocks.seconds, found.rate[:, a], a) for a, axis in enumerate("xyz")]
    shaded = f"Shaded: at rest, {result.seconds.rest:.1f} s." if rests else "Nowhere at rest."
    return [
        Section("Motion", shaded, "", [{"data": turns, "layout": rate}]),
        Section("Noise over time", NOISE_HINT, "", [{"data": [*curves, *floors], "layout": usual}]),
        Section("Biases over time", BIAS_HINT, "", [{"data": biases, "layout": walk}]),
    ]


def _spans(times: Array, rest: Mask) -> list[dict[str, object]]:
    """Shade the times at rest."""
    half = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return [
        {"type": "rect", "kind": "rest", "x0": float(times[a]) - half, "x1": float(times[b - 1]) + half}
        for a, b in flag_runs(rest)
    ]


def _curve(name: str, x: Array, y: Array, channel: int) -> dict[str, object]:
    step = max(len(x) // MOST_POINTS, 1)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": np.round(x[::step], 3).tolist(),
        "y": list(map(drawn, y[::step])),
        "line": {"color": colour_of(channel), "width": 1.2},
    }
