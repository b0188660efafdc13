# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Performance of a mounting before flight: accuracy, smallest errors found, losses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.errors import GeometryError
from fdi_ros.model.geometry import SAME_DIRECTION, Geometry
from fdi_ros.model.noise import (
    DETECTION,
    NoiseModel,
    assumption_words,
    smallest_detectable,
    summary_line,
)
from fdi_ros.model.samples import Array
from fdi_ros.monitor.building import alarm_probability, build_geometry, build_noise
from fdi_ros.report.layout import (
    PALETTE,
    RADIANS,
    Column,
    Figure,
    Rows,
    Section,
    Unit,
    colour_of,
    drawn,
    figures_of,
    number,
    page,
    text_of,
    told,
)

#: times within which a fault may be found, s
DETECTION_TIMES = (0.02, 0.1, 0.5, 2.0)
#: times by which vibration raises the noise, where noise_std is that at rest: an
#: example
VIBRATION = 5.0
#: |rho| above which isolation takes an error twice as large as detection
HARD_TO_ISOLATE = 0.9


def waiting(config: Config, geometry: Geometry, noise: NoiseModel) -> dict[str, Array]:
    """Return the smallest errors (waits, n), rad/s, found after each of DETECTION_TIMES, by condition.

    Conditions are rest, a turn at integrity.max_rate, and vibration. Infinite means
    never, and NaN a wait below two samples. White noise averages out. Scale and timing
    errors of a turn stay equal from sample to sample, so they add to the variance of
    the mean.
    """
    limits = config.integrity
    V = geometry.parity
    white = noise.noise_std**2
    turning = (noise.scale_std * limits.max_rate) ** 2 + (
        noise.timing_std * limits.max_acceleration
    ) ** 2

    def found_within(wait: float, white: Array, lasting: Array | float) -> Array:
        samples = wait * config.sample_rate
        if samples < 1.5:
            return np.full(geometry.n, np.nan)
        inverse = np.linalg.inv((V * (white + samples * lasting)) @ V.T)
        square = np.einsum("ai,ab,bi->i", V, inverse, V)
        gain = np.sqrt(np.maximum(square, 0))
        shift = smallest_shift(samples, 1 / alarm_probability(config))
        with np.errstate(divide="ignore"):
            return np.where(geometry.detectable, shift / gain, np.inf)

    conditions: dict[str, tuple[Array, Array | float]] = {
        "at rest": (white, 0.0),
        f"turning, {limits.max_rate:g} rad/s and {limits.max_acceleration:g} rad/s^2": (
            white,
            turning,
        ),
        f"in vibration, noise {VIBRATION:g} times": (VIBRATION**2 * white, 0.0),
    }
    return {
        name: np.array([found_within(wait, *each) for wait in DETECTION_TIMES])
        for name, each in conditions.items()
    }


def smallest_shift(samples: float, run_length: float) -> float:
    """Return the shift of a normal variable, in standard deviations, found in a mean delay.

    No test with mean run length A to a false alarm has a worst-case mean delay to a
    shift s below about ``2 ln(A) / s^2`` (Lorden 1971). The CUSUM tuned to s attains
    the minimum (Moustakides 1986). Its run lengths (Siegmund 1985), with x the level in
    units of 1/s, are

            A = 2 (exp(x) - x - 1) / s^2,    delay = 2 (exp(-x) + x - 1) / s^2

    ``samples``: the delay, > 1. ``run_length``: A, in samples.
    """
    level = math.log(run_length)
    shift = math.sqrt(2 * level / samples)
    for _ in range(50):
        level = math.log(run_length * shift**2 / 2 + level + 1)
        shift = math.sqrt(2 * (math.exp(-level) + level - 1) / samples)
    return shift


class Loss(NamedTuple):
    """Performance after the loss of some channels."""

    #: numbers of the lost channels
    lost: tuple[int, ...]
    #: infinite where the rest does not span space
    gdop: float = math.inf
    #: (3,) of the rate about each body axis at rest, rad/s
    std: Array = np.full(3, np.inf)
    #: numbers of the channels whose fault would be detected
    detectable: tuple[int, ...] = ()
    #: numbers of the channels whose fault would be isolated
    isolable: tuple[int, ...] = ()


@dataclass
class Mounting:
    """Consequences of geometry and noise at rest."""

    #: of all channels
    geometry: Geometry
    #: of all channels
    noise: NoiseModel
    #: per sample
    false_alarm_probability: float
    #: (n,) error found in one sample with probability DETECTION, rad/s, or infinite
    smallest: Array
    #: errors (waits, n), rad/s, that an optimal test finds on average within DETECTION_TIMES
    waiting: dict[str, Array]
    #: of nothing, of each channel in turn, of each pair
    losses: tuple[Loss, ...]

    def __post_init__(self) -> None:
        rho = np.triu(np.abs(self.geometry.rho), 1)
        # Pairs of channels that cannot be isolated, or only with effort.
        self.alike = np.argwhere(rho > SAME_DIRECTION).tolist()
        self.similar = np.argwhere(
            (rho > HARD_TO_ISOLATE) & (rho <= SAME_DIRECTION)
        ).tolist()
        self.single = [one for one in self.losses if len(one.lost) < 2]
        self.double = [one for one in self.losses if len(one.lost) == 2]


def assess(config: Config) -> Mounting:
    """Assess the mounting of a configuration. `FdiError` if settings contradict each other."""
    geometry = build_geometry(config)
    noise = build_noise(config, geometry.n)
    probability = alarm_probability(config)
    smallest = smallest_detectable(geometry, noise, probability)
    waited = waiting(config, geometry, noise)
    sets = [
        lost
        for count in range(3)
        for lost in itertools.combinations(range(geometry.n), count)
    ]
    losses = tuple(loss(geometry, noise, lost) for lost in sets)
    return Mounting(geometry, noise, probability, smallest, waited, losses)


def loss(geometry: Geometry, noise: NoiseModel, lost: tuple[int, ...]) -> Loss:
    """Return accuracy, detection and isolation without some channels."""
    kept = np.array([i not in lost for i in range(geometry.n)])
    axes = geometry.axes[kept]
    if np.linalg.matrix_rank(axes, tol=1e-2) < 3:
        return Loss(lost)
    inverse = np.linalg.inv(axes.T @ axes)
    gdop = float(np.sqrt(np.trace(inverse)))
    information = (axes.T / noise.noise_std[kept] ** 2) @ axes
    std = np.sqrt(np.diag(np.linalg.inv(information)))
    try:
        rest = geometry.subset(kept)
        numbers = np.flatnonzero(kept)
    except GeometryError:
        # Three channels give an unchecked rate.
        return Loss(lost, gdop, std)
    return Loss(
        lost,
        gdop,
        std,
        tuple(numbers[rest.detectable].tolist()),
        tuple(numbers[rest.isolable].tolist()),
    )


RHO_TITLE = "Similarity of faults: correlation |rho| of the normalised residuals; 1: indistinguishable"
WAITING_HINT = (
    "Smallest error, rad/s, that the best possible test detects within each time on average. This test knows channel"
    " and size (Lorden 1971, Moustakides 1986): about 2 ln(A) / s^2 samples for a shift of s standard deviations and A"
    " samples between false alarms, in white noise. For the channel with the largest value; the page has all channels."
)


def _channels(result: Mounting, unit: Unit = RADIANS) -> list[Column]:
    """Figures of every channel."""
    g = result.geometry
    return [
        Column("name", g.channel_names, ("channel",)),
        Column("axis", g.axes, ("axis x", "y", "z"), ".4f"),
        Column(
            "noise_std", result.noise.noise_std, ("noise rad/s",), ".5f", unit.factor
        ),
        Column("detectable", g.detectable),
        Column("isolable", g.isolable),
        Column(
            "smallest_in_one_sample",
            result.smallest,
            ("smallest rad/s",),
            _size,
            unit.factor,
        ),
    ]


def _size(value: float) -> str:
    return "never" if np.isinf(value) else number(value, ".5f")


def _losses(
    result: Mounting, losses: Sequence[Loss], unit: Unit = RADIANS
) -> list[Column]:
    """Figures of losses."""
    names = result.geometry.channel_names

    def named(channels: Callable[[Loss], Sequence[int]]) -> list[list[str]]:
        return [[names[i] for i in channels(one)] for one in losses]

    def words(found: list[list[str]]) -> list[str]:
        left = [len(names) - len(one.lost) for one in losses]
        return [
            "all" if len(one) == most else _or_none(one)
            for one, most in zip(found, left, strict=True)
        ]

    seen = named(lambda one: one.detectable)
    isolated = named(lambda one: one.isolable)
    return [
        Column("lost", named(lambda one: one.lost), ("lost",), _or_none),
        Column(
            "gdop",
            [one.gdop for one in losses],
            ("GDOP",),
            lambda v: f"{v:.3f}" if np.isfinite(v) else "no rate",
        ),
        Column(
            "std",
            [one.std for one in losses],
            ("std x rad/s", "y", "z"),
            lambda v: number(v, ".5f"),
            unit.factor,
        ),
        Column("detectable", seen),
        Column("isolable", isolated),
        Column("", words(seen), ("still detected",)),
        Column("", words(isolated), ("still isolated",)),
    ]


def _or_none(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def mounting_figures(result: Mounting) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    g = result.geometry
    names = result.geometry.channel_names
    return {
        "channels": figures_of(_channels(result)),
        "false_alarm_probability": result.false_alarm_probability,
        "smallest_within": [
            {
                "condition": condition,
                "within_s": list(DETECTION_TIMES),
                "rad_s": dict(zip(names, sizes.T, strict=True)),
            }
            for condition, sizes in result.waiting.items()
        ],
        "gdop": g.gdop,
        "covariance": g.covariance(result.noise.noise_std**2),
        "rho": np.abs(g.rho),
        "alike": [[names[i], names[j]] for i, j in result.alike],
        "similar": [[names[i], names[j]] for i, j in result.similar],
        "losses": figures_of(_losses(result, result.losses)),
    }


def pair_lines(result: Mounting) -> list[str]:
    """Describe pairs of channels that look alike."""
    g = result.geometry
    names = result.geometry.channel_names
    lines = []
    for i, j in result.alike:
        cosine = float(
            g.axes[i]
            @ g.axes[j]
            / np.linalg.norm(g.axes[i])
            / np.linalg.norm(g.axes[j])
        )
        why = f"faults of {names[i]} and {names[j]} look the same"
        if abs(cosine) > SAME_DIRECTION:
            why = f"{names[i]} and {names[j]} measure the same axis"
        lines.append(f"{why}: a fault of either is detected, but not which one")
    hard = "{} and {} are almost indistinguishable (|rho| {:.3f})"
    for i, j in result.similar:
        rho = abs(g.rho[i, j])
        lines.append(hard.format(names[i], names[j], rho))
    blind = np.flatnonzero(~g.detectable).tolist()
    lines += [
        f"a fault of {names[i]} is never detected: no other channel checks it"
        for i in blind
    ]
    return lines or ["every single fault can be detected and isolated"]


def _double_words(result: Mounting) -> str:
    """Summary of the losses of two channels."""
    names = result.geometry.channel_names
    spanning = sorted(
        (loss for loss in result.double if np.isfinite(loss.gdop)),
        key=lambda loss: loss.gdop,
    )
    words = f"after the loss of two channels: a rate for {len(spanning)} of {len(result.double)} pairs"
    if not spanning:
        return words
    best = spanning[0].gdop
    worst = max(spanning, key=lambda loss: loss.gdop)
    seen = sum(bool(loss.detectable) for loss in spanning)
    named = sum(bool(loss.isolable) for loss in spanning)
    lost = " and ".join(names[i] for i in worst.lost)
    return (
        f"{words}, GDOP {best:.3f} to {worst.gdop:.3f} (worst without {lost});"
        f" a further fault of at least one channel is detected for {seen}, isolated for {named}"
    )


def summary_lines(result: Mounting, unit: Unit = RADIANS) -> list[str]:
    """Return the first sentence for readers, with the assumptions behind every name."""
    assumed = assumption_words(result.geometry)
    return [
        summary_line(
            result.geometry,
            result.noise,
            result.false_alarm_probability,
            unit.name,
            unit.factor,
        ),
        *([f"naming assumes {assumed}"] if assumed else []),
        *pair_lines(result),
    ]


def fault_sections(result: Mounting, unit: Unit = RADIANS) -> list[Section]:
    """Smallest faults: detected in one sample, and over time."""
    hint = (
        f"Detected in one sample at rest with probability {100 * DETECTION:.0f} %, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample. Smaller faults take longer, see below."
    )
    worst = np.array([sizes.max(axis=1) for sizes in result.waiting.values()])
    heads = [f"{wait:g} s" for wait in DETECTION_TIMES]
    waited = [
        Column("", list(result.waiting), ("condition",), str),
        Column("", worst, heads, _size, unit.factor),
    ]
    return [
        Section(
            "Smallest faults detected in one sample",
            hint,
            told(_channels(result, unit), unit),
        ),
        Section(
            "Smallest faults detected over time",
            unit.named(WAITING_HINT),
            told(waited),
            [_waiting_figure(result, unit)],
        ),
    ]


def _waiting_figure(result: Mounting, unit: Unit) -> Figure:
    """Plot the smallest errors over the wait: a band for all channels, a line for the worst."""
    data: list[dict[str, object]] = []
    for k, (condition, sizes) in enumerate(result.waiting.items()):
        low, high = (
            [drawn(value * unit.factor) for value in values]
            for values in (sizes.min(1), sizes.max(1))
        )
        look = {
            "x": list(DETECTION_TIMES),
            "name": condition,
            "line": {"color": colour_of(k)},
        }
        data.append(
            {"type": "band", **look, "low": low, "high": high, "showlegend": False}
        )
        data.append({"type": "scatter", "mode": "lines+markers", **look, "y": high})
    titles = {"xaxis": "time waited, s", "yaxis": f"smallest error, {unit.name}"}
    axes = {
        name: {"type": "log", "title": {"text": words}}
        for name, words in titles.items()
    }
    return {"data": data, "layout": {"height": 320, **axes}}


def mounting_sections(result: Mounting, unit: Unit = RADIANS) -> list[Section]:
    """Lay out everything."""
    g = result.geometry
    names = result.geometry.channel_names
    covariance = g.covariance(result.noise.noise_std**2) * unit.factor**2
    covariance[np.abs(covariance) < 1e-9 * covariance.max()] = 0.0
    rho = np.abs(g.rho)
    heat = {
        "type": "heatmap",
        "z": np.round(rho, 4).tolist(),
        "x": list(names),
        "y": list(names),
    }
    drawn_rho = {"data": [heat], "layout": {"title": RHO_TITLE}}
    losses = told(_losses(result, result.single, unit), unit)
    return [
        *fault_sections(result, unit),
        Section(
            "Covariance of the rate",
            f"({unit.name})^2, at rest.",
            _matrix("xyz", covariance, ".3e"),
        ),
        Section("Similar faults", RHO_TITLE, _matrix(names, rho, ".3f"), [drawn_rho]),
        Section("After a loss", _double_words(result), losses),
    ]


def _matrix(names: Sequence[str], values: Array, form: str) -> Rows:
    rows = zip(names, values, strict=True)
    return ("", *names), [
        (name, *(f"{value:{form}}" for value in row)) for name, row in rows
    ]


def mounting_text(result: Mounting, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    return text_of(summary_lines(result, unit), mounting_sections(result, unit)) + "\n"


def mounting_page(result: Mounting, title: str, unit: Unit = RADIANS) -> str:
    """Return everything, and the axes in space, as a page."""

    def arrow(
        end: Array, text: str, line: dict[str, str], **named: str
    ) -> dict[str, object]:
        x, y, z = ([0, round(float(v), 4)] for v in end)
        return {
            "type": "scatter3d",
            **named,
            "x": x,
            "y": y,
            "z": z,
            "text": ["", text],
            "line": line,
        }

    g = result.geometry
    arrows = [
        arrow(1.2 * end, f"body {axis}", {"dash": "dash"})
        for end, axis in zip(np.eye(3), "xyz", strict=True)
    ]
    for i, name in enumerate(g.channel_names):
        arrows.append(
            arrow(
                g.axes[i], name, {"color": PALETTE[(i // 3) % len(PALETTE)]}, name=name
            )
        )
    turned = "In the body frame; drag, or press the arrow keys, to turn."
    sections = [
        Section("Axes", turned, "", [{"data": arrows, "layout": {"height": 560}}]),
        *mounting_sections(result, unit),
        Section("After two", "", told(_losses(result, result.double, unit), unit)),
    ]
    return page(f"fdi_ros: mounting of {title}", summary_lines(result, unit), sections)
