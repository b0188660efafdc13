# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a mounting can do before it flies: accuracy, smallest errors found at once and by waiting, better turns.

In figures, in words and tables for a terminal, and as a page: the axes in space, look-alikes, losses.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.errors import GeometryError
from fdi_ros.model.geometry import SAME_DIRECTION, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array
from fdi_ros.model.thresholds import DETECTION, assumption_words, smallest_detectable, summary_line
from fdi_ros.monitor.build import alarm_probability, build_geometry, build_noise
from fdi_ros.report.layout import (
    PALETTE,
    RADIANS,
    Column,
    Rows,
    Section,
    Unit,
    figures_of,
    number,
    page,
    table,
    told,
)

ORTHOGONAL = 0.8
"""Determinant of the axes of a triad at least."""
OPTIMUM = 2 / 3
"""Smallest largest |rho| of two orthogonal triads, at ``R = 2/3 ones - I`` and equivalent rotations."""


@dataclass(frozen=True)
class Turn:
    """The second of two triads, turned so that faults are easier to tell apart."""

    largest_rho: float
    """Between channels of different triads, as mounted."""
    freedom: float
    """Angle by which the triad may be turned, rad."""
    better: float
    """Largest |rho| then."""
    rotation: Array
    """(3, 3) to be applied to the second triad, in the body frame: ``R_new = rotation @ R``."""

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1)))

    @property
    def axis(self) -> Array:
        """(3,) axis of the rotation in the body frame; zero where there is none."""
        vector = np.array([self.rotation[2, 1], self.rotation[0, 2], self.rotation[1, 0]]) - [
            self.rotation[1, 2],
            self.rotation[2, 0],
            self.rotation[0, 1],
        ]
        norm = float(np.linalg.norm(vector))
        return vector / norm if norm > 1e-9 else np.zeros(3)


def best_turn(geometry: Geometry, freedom: float) -> Turn:
    """Turn the second of two triads within a cone so that the largest |rho| between the triads becomes smallest.

    Parameters
    ----------
    geometry
        Six channels, three of each triad.
    freedom
        Largest angle of the turn, rad.
    """
    rng = np.random.default_rng(0)
    best, found = np.zeros(3), _largest_turned(geometry.axes, np.zeros(3))
    # |rho| between triads is a matter of one rotation: three numbers, a kinked function, many equal optima. Draws
    # over the cone, then smaller and smaller steps around the best few, are as good as anything and need no solver.
    direction = rng.standard_normal((1500, 3))
    radius = freedom * rng.random(1500) ** (1 / 3)
    draws = direction / np.linalg.norm(direction, axis=1)[:, None] * radius[:, None]
    values = np.array([_largest_turned(geometry.axes, vector) for vector in draws])
    for k in np.argsort(values)[:4]:
        vector, value = _descended(geometry.axes, draws[k], float(values[k]), freedom, rng)
        if value < found - 1e-6:
            best, found = vector, value
    return Turn(float(np.abs(geometry.rho[:3, 3:]).max()), freedom, found, rotation_of(best))


def _descended(
    axes: Array, vector: Array, value: float, freedom: float, rng: np.random.Generator
) -> tuple[Array, float]:
    step = 0.2 * freedom
    while step > 1e-5:
        for _ in range(30):
            tried = vector + step * rng.standard_normal(3)
            norm = float(np.linalg.norm(tried))
            tried *= min(1.0, freedom / max(norm, 1e-12))
            if (other := _largest_turned(axes, tried)) < value:
                vector, value = tried, other
        step *= 0.6
    return vector, value


def _largest_turned(axes: Array, vector: Array) -> float:
    """Largest |rho| between the triads with the second one turned by a rotation vector, rad."""
    turned = np.vstack([axes[:3], axes[3:] @ rotation_of(vector).T])
    S = np.eye(6) - turned @ np.linalg.pinv(turned)
    scale = np.sqrt(np.maximum(np.diag(S), 1e-9))
    return float(np.abs((S / np.outer(scale, scale))[:3, 3:]).max())


def rotation_of(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) rad, by Rodrigues."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


# Found by waiting ----------------------------------------------------------------------------------------------------


WAITS = (0.02, 0.1, 0.5, 2.0)
"""Times within which a fault may be found, s."""
VIBRATION = 5.0
"""Times by which vibration raises the noise, where noise_std is that at rest."""
LEAST_SAMPLES = 1.5
"""Below so many samples a mean delay is not computed: it depends on single samples."""


@dataclass(frozen=True)
class Waiting:
    """Smallest errors that are found by waiting, in one condition."""

    condition: str
    size: Array
    """(waits, n) rad/s, in the order of WAITS; infinite: never, NaN: the wait is shorter than two samples."""


def waiting(config: Config, geometry: Geometry, noise: NoiseModel) -> tuple[Waiting, ...]:
    """Smallest errors found by waiting: at rest, while turning as fast as integrity.max_rate, and in vibration.

    White noise averages out in time. What scale and timing errors make of a turn does not while the turn lasts: they
    stay the same from sample to sample and add to the variance of the mean.
    """
    limits = config.integrity
    white = noise.noise_std**2
    lasting = (noise.scale_std * limits.max_rate) ** 2 + (noise.timing_std * limits.max_acceleration) ** 2
    turning = f"turning, {limits.max_rate:g} rad/s and {limits.max_acceleration:g} rad/s^2"
    return tuple(
        Waiting(condition, np.array([_found_within(config, geometry, wait, *variances) for wait in WAITS]))
        for condition, *variances in (
            ("at rest", white, np.zeros_like(white)),
            (turning, white, lasting),
            (f"in vibration, noise {VIBRATION:g} times", VIBRATION**2 * white, np.zeros_like(white)),
        )
    )


def _found_within(config: Config, geometry: Geometry, wait: float, white: Array, lasting: Array) -> Array:
    """Error (n,) rad/s of each channel that is found within a time, s, on average."""
    samples = wait * config.sample_rate
    if samples < LEAST_SAMPLES:
        return np.full(geometry.n, np.nan)
    V = geometry.parity
    inverse = np.linalg.inv((V * (white + samples * lasting)) @ V.T)
    gain = np.sqrt(np.maximum(np.einsum("ai,ab,bi->i", V, inverse, V), 0))
    shift = smallest_shift(samples, 1 / alarm_probability(config))
    with np.errstate(divide="ignore"):
        return np.where(geometry.detectable, shift / gain, np.inf)


def smallest_shift(samples: float, run_length: float) -> float:
    """Shift of a normal variable, in standard deviations, that the best sequential test finds within a mean delay.

    No test whose mean run length to a false alarm is A has a worst-case mean delay to a shift s below about
    ``2 ln(A) / s^2`` (Lorden 1971); the CUSUM tuned to s attains the least there is (Moustakides 1986). Its run
    lengths in closed form (Siegmund 1985): with x the level in units of 1/s,

        A = 2 (exp(x) - x - 1) / s^2,    delay = 2 (exp(-x) + x - 1) / s^2

    Parameters
    ----------
    samples
        Mean delay, samples, > 1.
    run_length
        Mean number A of samples to a false alarm.
    """
    shift = math.sqrt(2 * math.log(run_length) / samples)
    level = math.log(run_length)
    for _ in range(50):
        level = math.log(run_length * shift**2 / 2 + level + 1)
        shift = math.sqrt(2 * (math.exp(-level) + level - 1) / samples)
    return shift


# The whole mounting --------------------------------------------------------------------------------------------------


ALIKE = 0.9
"""Above this |rho| telling two channels apart takes an error twice as large as seeing it."""


@dataclass(frozen=True)
class Loss:
    """What is left after some channels are lost."""

    lost: tuple[int, ...]
    gdop: float
    """Infinite where the rest does not span space."""
    std: Array
    """(3,) of the rate about each body axis at rest, rad/s."""
    detectable: tuple[int, ...]
    isolable: tuple[int, ...]


@dataclass(frozen=True)
class Mounting:
    """What follows from the geometry and the noise at rest."""

    geometry: Geometry
    noise: NoiseModel
    false_alarm_probability: float
    """Per sample."""
    smallest: Array
    """(n,) error of each channel that is seen in one sample with probability DETECTION, rad/s; infinite: never."""
    waiting: tuple[Waiting, ...]
    """The errors that an optimal sequential test finds, on average, within WAITS."""
    whole: Loss
    single: tuple[Loss, ...]
    """After the loss of each channel in turn."""
    double: tuple[Loss, ...]
    """After the loss of each pair."""
    turn: Turn | None
    """Where there are two triads."""

    @property
    def alike(self) -> tuple[tuple[int, int], ...]:
        """Pairs of channels that cannot be told apart."""
        return self._pairs(SAME_DIRECTION, np.inf)

    @property
    def similar(self) -> tuple[tuple[int, int], ...]:
        """Pairs that can be told apart with effort."""
        return self._pairs(ALIKE, SAME_DIRECTION)

    def _pairs(self, low: float, high: float) -> tuple[tuple[int, int], ...]:
        """Pairs of channels whose |rho| is above the one and not above the other."""
        rho = np.abs(self.geometry.rho)
        return tuple(zip(*np.nonzero(np.triu((rho > low) & (rho <= high), 1)), strict=True))


def assess(config: Config, freedom: float = math.radians(10.0)) -> Mounting:
    """Assess the mounting of a configuration.

    Parameters
    ----------
    config
        Mounting, noise and false-alarm rate.
    freedom
        Angle by which the second of two triads may be turned, rad, 0 to pi.

    Raises
    ------
    FdiError
        If the settings do not fit each other.
    """
    geometry = build_geometry(config)
    noise = build_noise(config, geometry.n)
    probability = alarm_probability(config)
    n = geometry.n
    triads = n == 6 and all(abs(np.linalg.det(half)) > ORTHOGONAL for half in np.split(geometry.axes, 2))
    return Mounting(
        geometry,
        noise,
        probability,
        smallest_detectable(geometry, noise, probability),
        waiting(config, geometry, noise),
        loss(geometry, noise, ()),
        tuple(loss(geometry, noise, (i,)) for i in range(n)),
        tuple(loss(geometry, noise, pair) for pair in itertools.combinations(range(n), 2)),
        best_turn(geometry, freedom) if triads else None,
    )


def loss(geometry: Geometry, noise: NoiseModel, lost: tuple[int, ...]) -> Loss:
    """Accuracy and what can still be seen and named, without some channels."""
    kept = np.array([i not in lost for i in range(geometry.n)])
    axes = geometry.axes[kept]
    if np.linalg.matrix_rank(axes, tol=1e-2) < 3:
        return Loss(lost, math.inf, np.full(3, np.inf), (), ())
    unit = np.linalg.inv(axes.T @ axes)
    weighted = np.linalg.inv((axes.T / noise.noise_std[kept] ** 2) @ axes)
    detectable: tuple[int, ...] = ()
    isolable: tuple[int, ...] = ()
    try:
        rest = geometry.subset(kept)
        numbers = np.flatnonzero(kept)
        detectable = tuple(numbers[rest.detectable].tolist())
        isolable = tuple(numbers[rest.isolable].tolist())
    except GeometryError:
        # Three channels still give a rate; nothing checks it.
        pass
    return Loss(lost, float(np.sqrt(np.trace(unit))), np.sqrt(np.diag(weighted)), detectable, isolable)


def mounting_figures(result: Mounting) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    g, turn = result.geometry, result.turn
    names = g.channel_names
    return {
        "channels": figures_of(_channels(result)),
        "false_alarm_probability": result.false_alarm_probability,
        "smallest_within": [
            {
                "condition": waiting.condition,
                "within_s": list(WAITS),
                "rad_s": dict(zip(names, waiting.size.T, strict=True)),
            }
            for waiting in result.waiting
        ],
        "gdop": g.gdop,
        "covariance": g.covariance(result.noise.noise_std**2),
        "rho": np.abs(g.rho),
        "alike": [[names[i], names[j]] for i, j in result.alike],
        "similar": [[names[i], names[j]] for i, j in result.similar],
        "losses": figures_of(_losses(result, (result.whole, *result.single, *result.double))),
        "turn": None
        if turn is None
        else {"largest_rho": turn.largest_rho, "better": turn.better, "angle_rad": turn.angle, "axis": turn.axis},
    }


RHO_TITLE = "|rho| of the normalised residuals: 1 is not to be told apart"
WAITING_TITLE = "smallest error found on average within a time, rad/s"
WAITING_HINT = (
    "The bound of the best test, which knows channel and size (Lorden 1971, Moustakides 1986): about 2 ln(A) / s^2"
    " samples for a shift of s standard deviations and A samples to a false alarm; noise taken as white."
)


def pair_lines(result: Mounting) -> list[str]:
    """Describe pairs of channels that look alike."""
    g = result.geometry
    lines = []
    for i, j in result.alike:
        a, b = g.channel_names[i], g.channel_names[j]
        cosine = float(g.axes[i] @ g.axes[j] / np.linalg.norm(g.axes[i]) / np.linalg.norm(g.axes[j]))
        if abs(cosine) > SAME_DIRECTION:
            lines.append(f"{a} and {b} measure the same axis: a fault in either is seen, which one is not")
        else:
            lines.append(f"faults of {a} and {b} look the same: a fault in either is seen, which one is not")
    lines += [
        f"{g.channel_names[i]} and {g.channel_names[j]} are hard to tell apart (|rho| {abs(g.rho[i, j]):.3f})"
        for i, j in result.similar
    ]
    blind = np.flatnonzero(~g.detectable).tolist()
    lines += [f"a fault of {g.channel_names[i]} is never seen: no other channel checks it" for i in blind]
    return lines or ["every single fault is seen and can be told from all others"]


def _losses(result: Mounting, losses: Sequence[Loss], unit: Unit = RADIANS) -> list[Column]:
    """Figures of losses."""
    names = result.geometry.channel_names

    def named(numbers: Sequence[int]) -> list[str]:
        return [names[i] for i in numbers]

    def words(loss: Loss, numbers: Sequence[int]) -> str:
        return "all" if len(numbers) == len(names) - len(loss.lost) else _or_none(named(numbers))

    return [
        Column("lost", [named(one.lost) for one in losses], ("lost",), _or_none),
        Column("gdop", [one.gdop for one in losses], ("GDOP",), lambda v: f"{v:.3f}" if np.isfinite(v) else "no rate"),
        Column("std", [one.std for one in losses], ("std x rad/s", "y", "z"), lambda v: number(v, ".5f"), unit.factor),
        Column("detectable", [named(one.detectable) for one in losses]),
        Column("isolable", [named(one.isolable) for one in losses]),
        Column("", [words(one, one.detectable) for one in losses], ("still seen",)),
        Column("", [words(one, one.isolable) for one in losses], ("still isolated",)),
    ]


def _or_none(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def double_lines(result: Mounting) -> list[str]:
    """Summary of the losses of two channels."""
    spanning = [loss for loss in result.double if np.isfinite(loss.gdop)]
    names = result.geometry.channel_names
    lines = [f"two lost: {len(spanning)} of {len(result.double)} pairs leave a rate"]
    if spanning:
        worst = max(spanning, key=lambda loss: loss.gdop)
        lines[0] += f", GDOP {min(loss.gdop for loss in spanning):.3f} to {worst.gdop:.3f}"
        lines[0] += f" (worst without {' and '.join(names[i] for i in worst.lost)})"
        named = sum(1 for loss in spanning if loss.isolable)
        seen = sum(1 for loss in spanning if loss.detectable)
        lines.append(f"of these, {seen} still see a third fault in some channel and {named} can isolate it in some")
    return lines


def turn_lines(result: Mounting) -> list[str]:
    """How far two triads are from the best turn, and a better one within reach."""
    turn = result.turn
    if turn is None:
        return []
    lines = [
        f"largest |rho| between the two triads {turn.largest_rho:.3f}; the best turn of the second has {OPTIMUM:.3f}"
        " (the first one's axes seen as 2/3, 2/3, -1/3)"
    ]
    if turn.better < turn.largest_rho - 1e-3:
        axis = ", ".join(f"{v:.3f}" for v in turn.axis)
        lines.append(
            f"within {np.degrees(turn.freedom):.0f} deg: turn the second triad by {np.degrees(turn.angle):.1f} deg"
            f" about ({axis}) of the body: largest |rho| {turn.better:.3f}"
        )
    else:
        lines.append(f"within {np.degrees(turn.freedom):.0f} deg there is no better turn")
    return lines


def _rho(result: Mounting) -> Rows:
    """Matrix of |rho|."""
    g = result.geometry
    rows = [(name, *(f"{abs(v):.3f}" for v in own)) for name, own in zip(g.channel_names, g.rho, strict=True)]
    return ("", *g.channel_names), rows


def _channels(result: Mounting, unit: Unit = RADIANS) -> list[Column]:
    """Figures of every channel."""
    g = result.geometry
    return [
        Column("name", g.channel_names, ("channel",)),
        Column("axis", g.axes, ("axis x", "y", "z"), ".4f"),
        Column("noise_std", result.noise.noise_std, ("noise rad/s",), ".5f", unit.factor),
        Column("detectable", g.detectable),
        Column("isolable", g.isolable),
        Column("smallest_in_one_sample", result.smallest, ("smallest rad/s",), _size, unit.factor),
    ]


def smallest_table(result: Mounting, unit: Unit = RADIANS) -> Rows:
    """Smallest detectable error of each channel."""
    return told(_channels(result, unit), unit)


def _covariance(result: Mounting, unit: Unit = RADIANS) -> Rows:
    """Covariance of the least-squares rate at rest, square of the unit."""
    covariance = result.geometry.covariance(result.noise.noise_std**2) * unit.factor**2
    covariance[np.abs(covariance) < 1e-9 * covariance.max()] = 0.0
    return ("", *"xyz"), [("xyz"[i], *(f"{v:.3e}" for v in covariance[i])) for i in range(3)]


def _waiting(result: Mounting, one: Waiting, unit: Unit = RADIANS) -> Rows:
    """Smallest errors found by waiting in one condition."""
    sizes = [tuple(map(_size, row)) for row in one.size.T * unit.factor]
    rows = [(name, *row) for name, row in zip(result.geometry.channel_names, sizes, strict=True)]
    return ("channel", *(f"{wait:g} s" for wait in WAITS)), rows


def waiting_sections(result: Mounting) -> list[Section]:
    """Sections of a page on what is found by waiting, one for each condition."""
    hint = f"Smallest error, rad/s, found on average within a time. {WAITING_HINT}"
    return [Section(f"Found by waiting, {one.condition}", hint, _waiting(result, one)) for one in result.waiting]


def _size(value: float) -> str:
    return "never" if np.isinf(value) else number(value, ".5f")


def assumption_lines(result: Mounting) -> list[str]:
    """Say what no data can tell and every name rests on."""
    words = assumption_words(result.geometry)
    return [f"names rest on {words}"] if words else []


def mounting_text(result: Mounting, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    g = result.geometry
    lines = [
        summary_line(g, result.noise, result.false_alarm_probability, unit.name, unit.factor),
        "",
        f"smallest error seen with {DETECTION:.0%} in one sample, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample",
        *table(*smallest_table(result, unit)),
        "",
        unit.named(WAITING_TITLE),
        *textwrap.wrap(WAITING_HINT, 110),
        *(line for one in result.waiting for line in (f"{one.condition}:", *table(*_waiting(result, one, unit)))),
        "",
        f"covariance of the rate, ({unit.name})^2",
        *table(*_covariance(result, unit)),
        "",
        RHO_TITLE,
        *table(*_rho(result)),
        "",
        *assumption_lines(result),
        *pair_lines(result),
        "",
        "after each possible first fault",
        *table(*told(_losses(result, [result.whole, *result.single], unit), unit)),
        *double_lines(result),
        *(["", *turn_lines(result)] if result.turn else []),
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def mounting_page(result: Mounting, title: str) -> str:
    """Lay out everything."""
    summary = [
        summary_line(result.geometry, result.noise, result.false_alarm_probability),
        *assumption_lines(result),
        *pair_lines(result),
        *turn_lines(result),
    ]
    smallest = (
        f"Seen in one sample at rest with {DETECTION:.0%}, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample."
    )
    sections = [
        Section("Axes", "In the body frame; drag, or press the arrow keys, to turn.", "", [_axes_figure(result)]),
        Section("Smallest detectable error", smallest, smallest_table(result)),
        *waiting_sections(result),
        Section("Covariance of the rate", "(rad/s)^2, at rest.", _covariance(result)),
        Section("Look-alikes", RHO_TITLE, _rho(result), [_rho_figure(result)]),
        Section(
            "After each possible first fault",
            "; ".join(double_lines(result)),
            told(_losses(result, [result.whole, *result.single])),
        ),
        Section("After two", "", told(_losses(result, result.double))),
    ]
    return page(f"fdi_ros: mounting of {title}", summary, sections)


def _axes_figure(result: Mounting) -> dict[str, object]:
    def arrow(end: Array, text: str, line: dict[str, str], **named: str) -> dict[str, object]:
        x, y, z = ([0, round(float(v), 4)] for v in end)
        return {"type": "scatter3d", **named, "x": x, "y": y, "z": z, "text": ["", text], "line": line}

    g = result.geometry
    body = [arrow(1.2 * end, f"body {axis}", {"dash": "dash"}) for end, axis in zip(np.eye(3), "xyz", strict=True)]
    axes = [
        arrow(g.axes[i], name, {"color": PALETTE[(i // 3) % len(PALETTE)]}, name=name)
        for i, name in enumerate(g.channel_names)
    ]
    return {"data": body + axes, "layout": {"height": 560}}


def _rho_figure(result: Mounting) -> dict[str, object]:
    names = list(result.geometry.channel_names)
    z = np.round(np.abs(result.geometry.rho), 4).tolist()
    heat = {"type": "heatmap", "z": z, "x": names, "y": names, "zmin": 0, "zmax": 1}
    return {"data": [heat], "layout": {"title": RHO_TITLE}}
