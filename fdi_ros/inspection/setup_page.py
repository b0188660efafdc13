"""The page of a setup: what was found in the recording, what was not, the config, and what to do next."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from fdi_ros.calibration.report import CHANNEL_HEAD, CHECK_HEAD, channel_rows, check_rows, noise_lines
from fdi_ros.inspection.setup import Found
from fdi_ros.inspection.setup_report import (
    MOUNT_HEAD,
    NOISE_HEAD,
    TOPIC_HEAD,
    found_lines,
    limit_lines,
    mount_rows,
    next_lines,
    noise_rows,
    recorded_noise,
    topic_rows,
    unknown_lines,
    warning_lines,
)
from fdi_ros.mounting.report import SMALLEST_HEAD, WAITING_HEAD, WAITING_HINT, smallest_rows, waiting_rows
from fdi_ros.report.page import PALETTE, Section, html_table, page

NOISE_HINT = (
    "One sample, vibration and fast shaking included, slow motion left out. Where a channel is much noisier in motion"
    " than the others, its unit is loose, badly isolated or faulty."
)
SMALLEST_HINT = (
    "In one sample, with 99 %, at rest or as the noise in the config has it. Smaller faults need time: below."
)
IN_VIBRATION = "in vibration"
CONFIG_HINT = "As written; loaded back, and a monitor was built from it."


def setup_page(found: Found, bag: str, config: str) -> str:
    """Lay out everything."""
    warnings, flown = warning_lines(found), bool(limit_lines(found))
    summary = [
        *(f"Found: {line}." for line in found_lines(found)),
        *(f"Limits: {line}." for line in limit_lines(found)),
        f"{len(unknown_lines(found))} things this recording does not show, {len(warnings)} warnings: see below.",
    ]
    sections = [
        Section("Not to be found in this recording", "", _list(unknown_lines(found))),
        Section("Warnings", "" if warnings else "None.", _list(warnings)),
        Section("What to do next", "", _text("\n".join(next_lines(bag, config)))),
        Section("Topics", "The whole recording.", html_table(TOPIC_HEAD, topic_rows(found))),
        Section("Noise", NOISE_HINT, html_table(NOISE_HEAD, noise_rows(found)), [_noise(found)]),
        *([Section("Mounts", "", html_table(MOUNT_HEAD, mount_rows(found)))] if found.mounts else []),
        *_calibration(found),
        Section("Smallest faults seen", SMALLEST_HINT, html_table(SMALLEST_HEAD, smallest_rows(found.mounting))),
        *(
            Section(f"Found by waiting, {one.condition}", WAITING_HINT, html_table(WAITING_HEAD, rows))
            for one in found.mounting.waiting
            # Noise in flight holds the vibration already.
            if not (flown and one.condition.startswith(IN_VIBRATION))
            for rows in [waiting_rows(found.mounting, one)]
        ),
        Section("The config", CONFIG_HINT, _text(found.text)),
    ]
    return page(f"fdi_ros: setup from {bag}", summary, sections)


def _list(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _text(text: str) -> str:
    return f'<div class="scroll"><pre>{escape(text)}</pre></div>'


def _calibration(found: Found) -> list[Section]:
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


def _channels(found: Found) -> str:
    assert found.calibration is not None
    return html_table(CHANNEL_HEAD, channel_rows(found.calibration))


def _noise(found: Found) -> dict[str, Any]:
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
    return {"data": data, "layout": {"barmode": "group", "yaxis": {"title": {"text": "rad/s"}}, "height": 320}}
