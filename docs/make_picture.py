# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Make isolation.svg, the picture of the README: a recorded flight with a fault, by settings from another flight.

    fdi inspect DATA/phantom4/h04 --output four_imus.yaml
    fdi calibrate DATA/phantom4/h04 --config four_imus.yaml --output h04.yaml
    python docs/make_picture.py DATA/phantom4/h05 h04.yaml

The flight is of a Phantom 4 with four units (Quadrotor Dead Reckoning with Multiple Inertial Sensors, CC BY 4.0).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi_ros import Config, Pipeline
from fdi_ros.bag.samples import read_block
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.monitor.output import ChannelState

BAD = "imu_2.y"
FAULTS = (f"channel={BAD} kind=bias size=1.0 start=14.5 stop=14.515", f"channel={BAD} kind=bias size=0.3 start=16")
BEGIN, END = 13.5, 18.5
WIDTH, LEFT, TOP, GAP, ROW = 720, 70, 34, 46, 11
AXIS_COLOURS = {"x": "#d55e00", "y": "#009e73", "z": "#0072b2"}
"""Colours that people with impaired colour vision tell apart too (after Okabe and Ito)."""
STATE_COLOURS = {
    ChannelState.SUSPECT: "#e69f00",
    ChannelState.AMBIGUOUS: "#b35900",
    ChannelState.UNCHECKED: "#8a8f98",
    ChannelState.FAULTY: "#cc0033",
}
LETTER = 10.0
"""Of a name of a state, at most."""
GREY, INK = "#d0d7de", "#24292f"
NIGHT = {INK: "#e6e9ed", GREY: "#343b44", "#0072b2": "#56b4e9", "#cc0033": "#ff5c7a", "white": "#14171c"}
"""Colours on a dark page, by those on a light one."""

Array = NDArray[np.float64]
States = NDArray[np.uint8]


@dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    values: Array
    colour: str
    width: float = 1.0
    opacity: float = 1.0


@dataclass(frozen=True)
class Plot:
    """Curves over time, in rad/s."""

    title: str
    height: float
    low: float
    high: float
    ticks: tuple[float, ...]
    curves: list[Curve]


@dataclass(frozen=True)
class Replay:
    """What is shown of the flight."""

    time: Array
    """(N,) s"""
    names: tuple[str, ...]
    state: States
    """(N, n)"""
    rate: Array
    """(N, 3) fused, rad/s"""
    residual: Array
    """(N, n) rad/s"""
    errors: tuple[Array, Array]
    """(N,) each, rad/s: of the average of all gyros and of the fused rate, against the flight without faults."""


def night_style() -> str:
    """Return the style by which the picture follows a page that is dark."""
    rules = [f'[{what}="{day}"] {{ {what}: {night} }}' for day, night in NIGHT.items() for what in ("stroke", "fill")]
    return f"<style>@media (prefers-color-scheme: dark) {{ {' '.join(rules)} }}</style>"


def replay(recording: Path, settings: Path) -> Replay:
    """Replay the flight with the faults in it, and without."""
    config = Config.from_file(settings)
    pipeline, sound = Pipeline.from_config(config), Pipeline.from_config(config)
    clean = read_block(recording, config)
    faulty = Injector([parse_fault(fault) for fault in FAULTS], pipeline.channel_names).apply(clean)
    output, truth = pipeline.process(faulty), sound.process(clean)
    average = (faulty.z - np.array(pipeline.status().bias)) @ pipeline.geometry.least_squares.T
    time = (clean.stamp - clean.stamp[0]) * 1e-9
    shown = (time >= BEGIN) & (time <= END)
    errors = [np.linalg.norm(rate - truth.rate, axis=1)[shown] for rate in (average, output.rate)]
    names = tuple(pipeline.channel_names)
    return Replay(
        time[shown],
        names,
        output.state[shown],
        output.rate[shown],
        output.residual[shown],
        (errors[0], errors[1]),
    )


def plots(flight: Replay) -> list[Plot]:
    """Rate, residuals and errors."""
    rate = [Curve(c, colour, 1.3) for c, colour in zip(flight.rate.T, AXIS_COLOURS.values(), strict=True)]
    residuals = [
        Curve(flight.residual[:, i], AXIS_COLOURS[name[-1]], 0.6, 0.55)
        for i, name in enumerate(flight.names)
        if name != BAD
    ]
    residuals.append(Curve(flight.residual[:, flight.names.index(BAD)], AXIS_COLOURS[BAD[-1]], 1.8))
    return [
        Plot("fused body rate in flight, rad/s", 105, -3.4, 3.9, (-3.0, 0.0, 3.0), rate),
        Plot(f"residual of each of the 12 gyros, rad/s; {BAD} thick", 125, -0.6, 1.1, (-0.5, 0.0, 0.5, 1.0), residuals),
        Plot(
            "error of the rate, rad/s: all gyros averaged (grey), fused",
            75,
            0.0,
            0.15,
            (0.0, 0.1),
            [Curve(flight.errors[0], "#8a8f98", 1.3), Curve(flight.errors[1], INK, 1.3)],
        ),
    ]


def draw(flight: Replay) -> str:
    """All panels one under the other, as SVG."""
    rate, residuals, errors = plots(flight)
    rows = len(flight.names) * ROW
    tops = [TOP]
    for height in (rate.height, residuals.height, rows, errors.height):
        tops.append(tops[-1] + height + GAP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {LEFT + WIDTH + 20} {tops[-1] - GAP + 30:g}"'
        f' font-family="sans-serif" font-size="13" fill="{INK}">',
        night_style(),
        '<rect width="100%" height="100%" fill="white"/>',
        *_shades(flight, TOP, tops[-1] - GAP - TOP),
        *_plot(flight.time, rate, tops[0]),
        *_axes_legend(tops[0]),
        *_plot(flight.time, residuals, tops[1]),
        *_states(flight, tops[2]),
        *_plot(flight.time, errors, tops[3]),
    ]
    parts += [
        f'<text x="{_x(t):.1f}" y="{tops[-1] - GAP + 18:g}" text-anchor="middle">{t:g} s</text>'
        for t in np.arange(np.ceil(BEGIN), END + 0.5)
    ]
    return "\n".join([*parts, "</svg>", ""])


def _x(t: float) -> float:
    return LEFT + (t - BEGIN) / (END - BEGIN) * WIDTH


def _spans(flight: Replay, i: int) -> list[tuple[ChannelState, float, float]]:
    """Find the times of channel i in a state other than OK: state, from, to."""
    state = flight.state[:, i]
    cuts = np.flatnonzero(np.diff(state)) + 1
    begins, ends = [0, *cuts.tolist()], [*cuts.tolist(), len(state) - 1]
    spans = zip(begins, ends, strict=True)
    return [(ChannelState(state[a]), flight.time[a], flight.time[b]) for a, b in spans if state[a] != ChannelState.OK]


def _shades(flight: Replay, top: float, height: float) -> list[str]:
    return [
        f'<rect x="{_x(a):.1f}" y="{top}" width="{max(_x(b) - _x(a), 2):.1f}" height="{height:g}"'
        f' fill="{STATE_COLOURS[state]}" opacity="0.13"/>'
        for state, a, b in _spans(flight, flight.names.index(BAD))
    ]


def _plot(time: Array, plot: Plot, top: float) -> list[str]:
    def y(value: float) -> float:
        return top + (plot.high - min(max(value, plot.low), plot.high)) / (plot.high - plot.low) * plot.height

    parts = [
        f'<text x="{LEFT}" y="{top - 9:g}" font-weight="bold">{plot.title}</text>',
        f'<rect x="{LEFT}" y="{top:g}" width="{WIDTH}" height="{plot.height:g}" fill="none" stroke="{GREY}"/>',
    ]
    for value in plot.ticks:
        parts += [
            f'<text x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:g}</text>',
            f'<path d="M{LEFT} {y(value):.1f}h{WIDTH}" stroke="{GREY}" stroke-width="0.6"/>',
        ]
    for curve in plot.curves:
        points = " ".join(f"{_x(t):.1f},{y(v):.1f}" for t, v in zip(time, curve.values, strict=True))
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{curve.colour}" stroke-width="{curve.width}"'
            f' stroke-opacity="{curve.opacity}" stroke-linejoin="round"/>'
        )
    return parts


def _axes_legend(top: float) -> list[str]:
    words = "".join(
        f'<tspan fill="{colour}" font-weight="bold"> {axis}</tspan>' for axis, colour in AXIS_COLOURS.items()
    )
    return [f'<text x="{LEFT + WIDTH}" y="{top - 9:g}" text-anchor="end">axis{words}</text>']


def _states(flight: Replay, top: float) -> list[str]:
    """One row per channel: a thin line where it is OK, a bar with the name of the state elsewhere."""
    parts = [f'<text x="{LEFT}" y="{top - 9:g}" font-weight="bold">state of each channel; thin: OK</text>']
    for i, name in enumerate(flight.names):
        y = top + (i + 0.5) * ROW
        colour = AXIS_COLOURS[name[-1]]
        parts += [
            f'<text x="{LEFT - 6}" y="{y + 3.5:g}" text-anchor="end" font-size="10">{name}</text>',
            f'<path d="M{LEFT} {y:g}h{WIDTH}" stroke="{colour}" stroke-width="1.2"/>',
        ]
        # No name lies over another, or over a bar.
        free = 0.0
        for state, a, b in _spans(flight, i):
            colour, width = STATE_COLOURS[state], max(_x(b) - _x(a), 2)
            parts.append(f'<rect x="{_x(a):.1f}" y="{y - 5:g}" width="{width:.1f}" height="10" fill="{colour}"/>')
            long = LETTER * len(state.name)
            if _x(a) - long >= free:
                place, around = f'x="{_x(a) - 4:.1f}" text-anchor="end"', f' fill="{colour}" stroke="white"'
            else:
                place, around = f'x="{_x(a) + 5:.1f}"', ' fill="white"'
            if _x(a) - long >= free or width >= long:
                parts.append(
                    f'<text {place} y="{y + 4.5:g}" font-size="12" font-weight="bold"{around} stroke-width="3"'
                    f' paint-order="stroke">{state.name}</text>'
                )
            free = _x(b)
    return parts


if __name__ == "__main__":
    picture = draw(replay(Path(sys.argv[1]), Path(sys.argv[2])))
    (Path(__file__).parent / "isolation.svg").write_text(picture, encoding="utf-8")
