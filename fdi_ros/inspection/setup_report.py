# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a setup found, what it could not, and what to do next: in words and tables, as JSON, and as a page."""

from __future__ import annotations

import shlex
from html import escape

import numpy as np

from fdi_ros.calibration.report import CHANNEL_HEAD, CHECK_HEAD, channel_rows, check_rows, noise_lines
from fdi_ros.inspection.inspect import BELIEVED, TopicReport
from fdi_ros.inspection.setup import SetupResult, left_out
from fdi_ros.limits import LINE
from fdi_ros.model.detectability import summary_line
from fdi_ros.mounting.report import (
    SMALLEST_HEAD,
    WAITING_HEAD,
    WAITING_PAGE_HINT,
    pair_lines,
    smallest_rows,
    waiting_rows,
)
from fdi_ros.report.page import PALETTE, Section, html_table, page
from fdi_ros.sources import source_of
from fdi_ros.text import shown

LEAST_JUDGED = 0.5
"""Share of the samples that a monitor should judge."""
TOPIC_HEAD = ("topic", "messages", "rate", "gaps", "longest gap", "largest", "in motion", "used")
NOISE_HEAD = ("channel", "at its quietest, rad/s", "in motion, rad/s", "times", "in the config, rad/s")
MOUNT_HEAD = ("unit", "mount", "motion in common with the first")
NOISE_HINT = (
    "One sample, vibration and fast shaking included, slow motion left out. Where a channel is much noisier in motion"
    " than the others, its unit is loose, badly isolated or faulty."
)
SMALLEST_HINT = (
    "In one sample, with 99 %, at rest or as the noise in the config has it. Smaller faults need time: below."
)
IN_VIBRATION = "in vibration"
CONFIG_HINT = "As written; loaded back, and a monitor was built from it."


def topic_rows(found: SetupResult) -> list[tuple[str, ...]]:
    """One row per topic that carries rates, as recorded."""
    return [
        (
            shown(report.topic.name),
            str(report.received),
            f"{report.rate:.1f} Hz",
            str(report.gaps),
            f"{report.longest:.3f} s",
            f"{report.largest:.3g} rad/s" if np.isfinite(report.largest) else "-",
            f"{report.moving_share():.0%}" if report.all_stretches() else "-",
            "yes" if report in found.chosen else "no",
        )
        for report in found.reports
        if report.could_be_gyros
    ]


def noise_rows(found: SetupResult) -> list[tuple[str, ...]]:
    """One row per channel: noise of one sample at rest, in motion, and as the config has it."""
    quiet, moving = recorded_noise(found)
    std = np.broadcast_to(np.array(found.config.noise.noise_std), len(found.names))
    return [
        (name, _small(quiet[i]), _small(moving[i]), _times(quiet[i], moving[i]), _small(std[i]))
        for i, name in enumerate(found.names)
    ]


def recorded_noise(found: SetupResult) -> tuple[np.ndarray, np.ndarray]:
    """Noise (n,) of one sample of every channel at its quietest and in motion, rad/s; NaN: not shown."""
    return (
        np.concatenate([report.quiet_noise() for report in found.chosen]),
        np.concatenate([report.moving_noise() for report in found.chosen]),
    )


def _small(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "-"


def _times(quiet: float, moving: float) -> str:
    return f"{moving / quiet:.3g}" if np.isfinite(moving) and quiet > 0 else "-"


def mount_rows(found: SetupResult) -> list[tuple[str, ...]]:
    """One row per unit."""
    return [
        (name, mount.words, f"{max(mount.shared, 0.0):.1%}" if k else "-")
        for k, (name, mount) in enumerate(zip(found.config.imu_names, found.mounts, strict=False))
    ]


def found_lines(found: SetupResult) -> list[str]:
    """List what was found, one line each."""
    rate, n = found.config.sample_rate, len(found.names)
    units = f"{len(found.chosen)} units" if source_of(found.config).units else "one array"
    lines = [f"{n} channels in {units} at {rate:.4g} Hz"]
    if known := [mount for mount in found.mounts[1:] if mount.shown]:
        lines.append(f"mounts: {len(known)} of {len(found.mounts) - 1} against {found.config.imu_names[0]}")
    if found.calibration is not None:
        seconds = found.calibration.seconds
        lines.append(f"axes, biases and noise, from {seconds.rest:.1f} s at rest and {seconds.motion:.1f} s in motion")
        lines += noise_lines(found.calibration)
    g = found.mounting
    can = summary_line(g.geometry, g.noise, g.false_alarm_probability, agree=not found.disagree)
    return [*lines, can, _replayed(found)]


def _replayed(found: SetupResult) -> str:
    sound = found.sound
    if not sound.judged:
        return f"replayed with this config the monitor judges NOTHING of it: {sound.note}"
    judged = f"{sound.judged:.0%} of its samples are judged"
    if not sound.declared:
        return f"replayed with this config nothing is declared; {judged}"
    names = ", ".join(dict.fromkeys(found.names[event.channel] for _, event in sound.declared))
    return f"replayed with this config the monitor declares {names}, first at {sound.declared[0][0]:.1f} s; {judged}"


def unknown_lines(found: SetupResult) -> list[str]:
    """List what the recording does not show, and what is taken instead, one line each."""
    config, lines = found.config, list(found.damage)
    if found.calibration is None:
        lines.append(f"no calibration: {found.refused}. Axes, delays and noise in motion are not known")
        lines += _noise_guess(found)
    assumed = (
        "the identity is assumed"
        if found.calibration is None
        else "only the calibration shows its axes, see their errors"
    )
    for name, mount in zip(config.imu_names, found.mounts, strict=False):
        if not mount.shown:
            lines.append(f"mount of {name}: {mount.words}; {assumed}")
    if source_of(config).units:
        lines.append(
            f"where the vehicle's forward, left and up are: the body frame is that of {config.imu_names[0]}, and the"
            " fused rate is in its axes; turn all axes of the config if it is mounted otherwise"
        )
    elif found.calibration is None:
        lines.append(
            "the axes of an array: those in the config are an assumption (a cone); nothing that the monitor says is"
            " worth anything before the true ones stand there (geometry.axes, or a preset)"
        )
    else:
        lines.append(
            "the body frame: of an array only how its channels hang together is seen. The axes of its first three are"
            " an assumption (a cone): faults are found without the true ones, but the fused rate is in no real frame"
        )
    lines += [
        "the range of the gyros (health.max_rate): take it from the data sheet",
        f"how biases differ from start to start (bias.turn_on_std): {config.bias.turn_on_std:g} rad/s is assumed",
    ]
    if others := left_out(found):
        lines.append(f"topics that were not used, though they could be gyros: {', '.join(others)}")
    return [shown(line, LINE) for line in lines]


def limit_lines(found: SetupResult) -> list[str]:
    """List the limits of what was found, one line each."""
    return [] if found.calibration is None else list(found.calibration.notes)


def _noise_guess(found: SetupResult) -> list[str]:
    moving = max((report.moving_share() for report in found.chosen), default=0.0)
    if moving > 0:
        return []
    return ["no motion at all: noise is that at rest, and will be more in flight"]


def warning_lines(found: SetupResult) -> list[str]:
    """List what to look at before the config is trusted, one line each."""
    lines = list(found.calibration.warnings) if found.calibration is not None else []
    lines += [found.refused] if found.disagree else []
    sound = found.sound
    if sound.judged < LEAST_JUDGED:
        lines.append(f"only {sound.judged:.0%} of the samples are judged: {sound.note or 'channels are missing'}")
    if sound.declared:
        lines.append(
            "channels are declared in this very recording: one of its gyros is faulty, or the config does not fit it"
        )
    lines += [
        f"{a} and {b} give the very same values: one sensor on two topics does not check itself"
        for a, b in found.identical
    ]
    lines += [f"in the replay, {line}" for line in sound.degraded]
    lines += [line for line in map(_topic_warning, found.chosen) if line]
    return list(dict.fromkeys([*lines, *geometry_lines(found)]))


def geometry_lines(found: SetupResult) -> list[str]:
    """List which channels cannot be told apart."""
    every = pair_lines(found.mounting)
    return [line for line in every if "not" in line.split(":")[-1] or "never" in line]


def _topic_warning(report: TopicReport) -> str:
    words = [f"{report.gaps} gaps of up to {report.longest:.2g} s"] if report.gaps else []
    words += [f"{lost} values not finite"] if (lost := int(np.sum(report.not_finite))) else []
    words += [f"{lost} values beyond {BELIEVED:g} rad/s"] if (lost := int(np.sum(report.beyond))) else []
    words += [f"{old} values that repeat one for long"] if (old := int(np.sum(report.repeated))) else []
    words += [f"{report.malformed} malformed messages"] if report.malformed else []
    words += [f"{report.backward} stamps that do not increase"] if report.backward else []
    return f"{report.topic.name}: {', '.join(words)}" if words else ""


def next_lines(bag: str, config: str) -> list[str]:
    """List what to do with the config."""
    bag, config = shlex.quote(bag), shlex.quote(config)
    return [
        f"fdi replay {bag} --config {config} --report replay.html   # what the monitor says of this recording",
        f"fdi sweep {bag} --config {config} --report sweep.html     # which faults it would find in it",
        f"fdi calibrate ANOTHER_BAG --config {config} --output better.yaml   # with rest and turns about every axis",
        f"fdi_node --ros-args --params-file {config}   # on the vehicle; in a workspace: ros2 run fdi_ros fdi_node ...",
    ]


def setup_figures(found: SetupResult, bag: str) -> dict[str, object]:
    """Return everything, for programs, in SI units."""
    quiet, moving = recorded_noise(found)
    return {
        "bag": bag,
        "found": found_lines(found),
        "limits": limit_lines(found),
        "not_found": unknown_lines(found),
        "warnings": warning_lines(found),
        "topics": [report.topic.name for report in found.chosen],
        "mounts": [
            {
                "unit": name,
                "known": mount.shown,
                "rotation": mount.rotation.tolist(),
                "error_rad": mount.error if mount.shown else None,
                "off_rad": mount.off,
            }
            for name, mount in zip(found.config.imu_names, found.mounts, strict=False)
        ],
        "noise": {
            name: {"quiet": _finite(quiet[i]), "moving": _finite(moving[i])} for i, name in enumerate(found.names)
        },
        "calibrated": found.calibration is not None,
        "parameters": found.parameters,
        "replayed": {
            "judged": found.sound.judged,
            "declared": [
                {"at_s": round(at, 9), "channel": found.names[event.channel], "state": event.after.name}
                for at, event in found.sound.declared
            ],
        },
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def setup_text(found: SetupResult, bag: str, config: str) -> str:
    """Return everything, for a terminal."""
    parts = [f"{shown(bag, LINE)}: found", *(f"  {line}" for line in found_lines(found))]
    if limits := limit_lines(found):
        parts += ["", "limits of that", *(f"  {line}" for line in limits)]
    parts += ["", "not to be found in this recording", *(f"  {line}" for line in unknown_lines(found))]
    if warnings := warning_lines(found):
        parts += ["", *(f"warning: {line}" for line in warnings)]
    parts += ["", "next", *(f"  {shown(line, LINE)}" for line in next_lines(bag, config)), ""]
    return "\n".join(line.rstrip() for line in parts) + "\n"


def setup_page(found: SetupResult, bag: str, config: str) -> str:
    """Lay out everything."""
    warnings, flown = warning_lines(found), bool(limit_lines(found))
    summary = [
        *(f"{line}." for line in found_lines(found)),
        *(f"Limits: {line}." for line in limit_lines(found)),
        f"{len(unknown_lines(found))} things this recording does not show, {len(warnings)} warnings: see below.",
    ]
    sections = [
        Section("Not to be found in this recording", "", _html_list(unknown_lines(found))),
        Section("Warnings", "" if warnings else "None.", _html_list(warnings)),
        Section("What to do next", "", _text("\n".join(next_lines(bag, config)))),
        Section("Topics", "The whole recording.", html_table(TOPIC_HEAD, topic_rows(found))),
        Section("Noise", NOISE_HINT, html_table(NOISE_HEAD, noise_rows(found)), [_noise_figure(found)]),
        *([Section("Mounts", "", html_table(MOUNT_HEAD, mount_rows(found)))] if found.mounts else []),
        *_calibration(found),
        Section("Smallest faults seen", SMALLEST_HINT, html_table(SMALLEST_HEAD, smallest_rows(found.mounting))),
        *(
            Section(f"Found by waiting, {one.condition}", WAITING_PAGE_HINT, html_table(WAITING_HEAD, rows))
            for one in found.mounting.waiting
            # Noise in flight holds the vibration already.
            if not (flown and one.condition.startswith(IN_VIBRATION))
            for rows in [waiting_rows(found.mounting, one)]
        ),
        Section("The config", CONFIG_HINT, _text(found.text)),
    ]
    return page(f"fdi_ros: setup from {bag}", summary, sections)


def _html_list(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _text(text: str) -> str:
    return f'<div class="scroll"><pre>{escape(text)}</pre></div>'


def _calibration(found: SetupResult) -> list[Section]:
    result = found.calibration
    if result is None:
        return [Section("Axes, delays and biases", f"Not known: {found.refused}.")]
    check = (
        "Root mean square of the residuals over what the settings expect, by how fast the vehicle turns: before (as"
        " inspected) and after (with this config). 1 is right; less is cautious, more brings false alarms."
    )
    delays = " ".join(f"{line}." for line in noise_lines(result))
    return [
        Section("Axes and biases", "Axes against those of the reference, with standard errors.", _channels(found)),
        Section("Delays of the units, other errors in motion", delays),
        Section("Does the config fit the recording?", check, html_table(CHECK_HEAD, check_rows(result))),
    ]


def _channels(found: SetupResult) -> str:
    assert found.calibration is not None
    return html_table(CHANNEL_HEAD, channel_rows(found.calibration))


def _noise_figure(found: SetupResult) -> dict[str, object]:
    data = [
        {
            "type": "bar",
            "name": name,
            "x": list(found.names),
            "y": [float(f"{value:.3g}") if np.isfinite(value) else None for value in values],
            "marker": {"color": PALETTE[k]},
        }
        for k, (name, values) in enumerate(zip(("at its quietest", "in motion"), recorded_noise(found), strict=True))
    ]
    return {
        "data": data,
        "layout": {
            "xaxis": {"title": {"text": "channel"}},
            # In motion it is many times as large.
            "yaxis": {"title": {"text": "noise, rad/s"}, "type": "log"},
            "height": 320,
        },
    }
