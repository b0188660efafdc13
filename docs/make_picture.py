"""Make isolation.svg, the picture of the README: python docs/make_picture.py. A replay of the bundled flight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi_ros import Block
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import parse_fault
from fdi_ros.faults.injection import Injector
from fdi_ros.monitor.pipeline import Pipeline

ROOT = Path(__file__).parents[1]
FAULT = "channel=imu_2.y kind=bias size=0.15 start=30 stop=33"
BEGIN, END = 26.0, 36.0
WIDTH, HEIGHT, LEFT, TOP, GAP = 780, 118, 62, 36, 44
GREY, RED, BLUE, ORANGE = "#8a8f98", "#d1242f", "#0969da", "#bc6c25"

Array = NDArray[np.float64]
Curve = tuple[Array, str, float]


@dataclass
class Panel:
    """One plot: its title, the largest value on its axis, curves of value, colour and width."""

    title: str
    high: float
    curves: list[Curve]

    @property
    def low(self) -> float:
        """Smallest value on its axis: all of the values and a little more."""
        return min(0.0, *(float(np.nanmin(values)) for values, _, _ in self.curves)) - 0.05 * self.high


def replay() -> tuple[Array, list[Panel]]:
    """Replay the flight with the fault in it: times and panels."""
    config = Config.from_file(ROOT / "config" / "two_imus.yaml")
    pipeline, sound = Pipeline.from_config(config), Pipeline.from_config(config)
    geometry = pipeline.geometry
    with Recording(ROOT / "bags" / "cone_flight") as recording:
        blocks = list(Samples(recording, config, geometry.n).blocks())
    clean = Block(np.concatenate([b.stamp for b in blocks]), np.concatenate([b.z for b in blocks]))
    faulty = Injector([parse_fault(FAULT)], geometry.channel_names).apply(clean)
    output, truth = pipeline.process(faulty), sound.process(clean)
    bias = np.array(pipeline.status().bias)
    average = (faulty.z - bias) @ geometry.least_squares.T
    time = (clean.stamp - clean.stamp[0]) * 1e-9
    shown = (time >= BEGIN) & (time <= END)
    bad = geometry.channel_names.index("imu_2.y")
    others = [(output.residual[shown, i], GREY, 0.8) for i in range(geometry.n) if i != bad]
    errors = [np.linalg.norm(rate - truth.rate, axis=1)[shown] for rate in (average, output.rate)]
    return time[shown], [
        Panel("body rate in flight, x y z, rad/s", 2.2, [(c, BLUE, 1.2) for c in output.rate[shown].T]),
        Panel(
            "each gyro against the fused rate, rad/s: imu_2.y gets a bias of 0.15 at 30 s and loses it at 33 s",
            0.2,
            [*others, (output.residual[shown, bad], RED, 1.4)],
        ),
        Panel(
            "error of the rate, rad/s: all six gyros averaged (orange), fdi_ros (blue)",
            0.1,
            [(errors[0], ORANGE, 1.4), (errors[1], BLUE, 1.4)],
        ),
    ]


def draw(time: Array, panels: list[Panel]) -> str:
    """Panels one under the other, as SVG."""
    height = TOP + len(panels) * (HEIGHT + GAP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {LEFT + WIDTH + 20} {height}"'
        ' font-family="sans-serif" font-size="13" fill="#24292f">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for k, panel in enumerate(panels):
        parts += _panel(time, panel, TOP + k * (HEIGHT + GAP), last=k == len(panels) - 1)
    return "\n".join([*parts, "</svg>", ""])


def _panel(time: Array, panel: Panel, top: float, last: bool) -> list[str]:
    def x(t: Array | float) -> Array:
        return LEFT + (np.asarray(t) - BEGIN) / (END - BEGIN) * WIDTH

    def y(value: Array | float) -> Array:
        inside = np.clip(value, panel.low, panel.high)
        return top + (panel.high - inside) / (panel.high - panel.low) * HEIGHT

    parts = [
        f'<text x="{LEFT}" y="{top - 8}" font-weight="bold">{panel.title}</text>',
        f'<rect x="{x(30.0):.1f}" y="{top}" width="{x(33.0) - x(30.0):.1f}" height="{HEIGHT}" fill="#ffebe9"/>',
        f'<rect x="{LEFT}" y="{top}" width="{WIDTH}" height="{HEIGHT}" fill="none" stroke="#d0d7de"/>',
    ]
    parts += [
        f'<text x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:g}</text>' for value in (0.0, panel.high)
    ]
    for values, colour, width in panel.curves:
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(time), y(values), strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}"/>')
    if last:
        parts += [
            f'<text x="{x(t):.1f}" y="{top + HEIGHT + 18}" text-anchor="middle">{t:g} s</text>'
            for t in np.arange(BEGIN, END + 1, 2)
        ]
    return parts


if __name__ == "__main__":
    (Path(__file__).parent / "isolation.svg").write_text(draw(*replay()))
