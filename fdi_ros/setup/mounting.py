# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a mounting can do before it flies: accuracy, smallest errors found at once and by waiting, better turns.

In figures, and as sections that a terminal and a page show alike.
"""

from __future__ import annotations

import itertools
import math
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
    Figure,
    Rows,
    Section,
    Unit,
    colour_of,
    drawn,
    figures_of,
    number,
    page,
    section_lines,
    told,
)

ORTHOGONAL = 0.8
"""Determinant of the axes of a triad at least."""
SETTLED = 1e-6
"""Angle, rad, and |rho|, below which a better turn is none."""
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
    vector: Array
    """(3,) rotation vector of the second triad in the body frame, rad."""

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.linalg.norm(self.vector))

    @property
    def axis(self) -> Array:
        """(3,) axis of the rotation in the body frame; zero where there is none."""
        return self.vector / max(self.angle, 1e-12)


def best_turn(geometry: Geometry, freedom: float) -> Turn:
    """Turn the second of two triads within a cone so that the largest |rho| between the triads becomes smallest.

    Parameters
    ----------
    geometry
        Six channels, three of each triad.
    freedom
        Largest angle of the turn, rad.
    """
    # Three numbers, a kinked function, many equal optima: draws around the best so far need no solver.
    rng, best, spread = np.random.default_rng(0), np.zeros((20, 3)), 0.5 * freedom
    while spread > SETTLED:
        tried = (best[:, None] + spread * rng.standard_normal((len(best), 100, 3))).reshape(-1, 3)
        tried *= np.minimum(1.0, freedom / np.linalg.norm(tried, axis=1))[:, None]
        tried = np.vstack([best, tried])
        best = tried[np.argsort(_largest_turned(geometry.axes, tried))[:8]]
        spread *= 0.7
    now, found = _largest_turned(geometry.axes, np.vstack([np.zeros(3), best[0]]))
    return Turn(float(now), freedom, *((float(found), best[0]) if found < now - SETTLED else (float(now), np.zeros(3))))


def _largest_turned(axes: Array, vectors: Array) -> Array:
    """Largest |rho| (K,) between the triads with the second one turned by rotation vectors (K, 3), rad."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    u = vectors / np.maximum(angle[:, 0], 1e-12)
    # Rodrigues; rows e_i x u are the matrix of u x.
    rotation = np.cos(angle) * np.eye(3) + np.sin(angle) * np.cross(np.eye(3), u[:, None])
    rotation += (1.0 - np.cos(angle)) * u[:, :, None] * u[:, None]
    turned = np.concatenate([np.broadcast_to(axes[:3], rotation.shape), axes[3:] @ rotation.swapaxes(1, 2)], axis=1)
    S = np.eye(6) - turned @ np.linalg.pinv(turned)
    scale = np.sqrt(np.maximum(np.einsum("kii->ki", S), 1e-9))
    return np.asarray(np.abs(S / (scale[:, :, None] * scale[:, None]))[:, :3, 3:].max(axis=(1, 2)))


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


RHO_TITLE = "|rho| of the normalised residuals: 1 cannot be told apart"
WAITING_HINT = (
    "Smallest error, rad/s, found on average within a time. The bound of the best test, which knows channel and size"
    " (Lorden 1971, Moustakides 1986): about 2 ln(A) / s^2 samples for a shift of s standard deviations and A samples"
    " to a false alarm; noise taken as white. Of the channel that needs the largest; on the page a band for all."
)


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


def _size(value: float) -> str:
    return "never" if np.isinf(value) else number(value, ".5f")


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


def pair_lines(result: Mounting) -> list[str]:
    """Describe pairs of channels that look alike."""
    g = result.geometry
    lines = []
    for i, j in result.alike:
        a, b = g.channel_names[i], g.channel_names[j]
        cosine = float(g.axes[i] @ g.axes[j] / np.linalg.norm(g.axes[i]) / np.linalg.norm(g.axes[j]))
        why = (
            f"{a} and {b} measure the same axis"
            if abs(cosine) > SAME_DIRECTION
            else f"faults of {a} and {b} look the same"
        )
        lines.append(f"{why}: a fault in either is seen, which one is not")
    lines += [
        f"{g.channel_names[i]} and {g.channel_names[j]} are hard to tell apart (|rho| {abs(g.rho[i, j]):.3f})"
        for i, j in result.similar
    ]
    blind = np.flatnonzero(~g.detectable).tolist()
    lines += [f"a fault of {g.channel_names[i]} is never seen: no other channel checks it" for i in blind]
    return lines or ["every single fault is seen and can be told from all others"]


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


def turn_lines(turn: Turn) -> list[str]:
    """How far two triads are from the best turn, and a better one within reach."""
    within = f"within {np.degrees(turn.freedom):.0f} deg"
    better = f"{within} there is no better turn"
    if turn.better < turn.largest_rho - 1e-3:
        axis = ", ".join(f"{v:.3f}" for v in turn.axis)
        better = (
            f"{within}: turn the second triad by {np.degrees(turn.angle):.1f} deg about ({axis}) of the body: largest"
            f" |rho| {turn.better:.3f}"
        )
    return [
        f"largest |rho| between the two triads {turn.largest_rho:.3f}; the best turn of the second has {OPTIMUM:.3f}"
        " (the first one's axes seen as 2/3, 2/3, -1/3)",
        better,
    ]


def summary_lines(result: Mounting, unit: Unit = RADIANS) -> list[str]:
    """Say what a reader is to know first, with what no data can tell and every name rests on."""
    assumed = assumption_words(result.geometry)
    return [
        summary_line(result.geometry, result.noise, result.false_alarm_probability, unit.name, unit.factor),
        *([f"names rest on {assumed}"] if assumed else []),
        *pair_lines(result),
        *(turn_lines(result.turn) if result.turn else []),
    ]


def fault_sections(result: Mounting, unit: Unit = RADIANS) -> list[Section]:
    """Smallest faults: seen in one sample, and found by waiting."""
    hint = (
        f"Seen in one sample at rest with {DETECTION:.0%}, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample. Smaller faults need time: below."
    )
    conditions = [one.condition for one in result.waiting]
    worst = np.array([one.size.max(axis=1) for one in result.waiting])
    heads = [f"{wait:g} s" for wait in WAITS]
    waited = [Column("", conditions, ("condition",), str), Column("", worst, heads, _size, unit.factor)]
    return [
        Section("Smallest faults seen", hint, told(_channels(result, unit), unit)),
        Section("Found by waiting", unit.named(WAITING_HINT), told(waited), [_waiting_figure(result, unit)]),
    ]


def _waiting_figure(result: Mounting, unit: Unit) -> Figure:
    """Draw the smallest errors found over the time waited: a band for all channels, a line for the worst."""
    data: list[dict[str, object]] = []
    for k, one in enumerate(result.waiting):
        low, high = ([drawn(value * unit.factor) for value in values] for values in (one.size.min(1), one.size.max(1)))
        look = {"x": list(WAITS), "name": one.condition, "line": {"color": colour_of(k)}}
        data.append({"type": "band", **look, "low": low, "high": high, "showlegend": False})
        data.append({"type": "scatter", "mode": "lines+markers", **look, "y": high})
    axes = {"xaxis": "time waited, s", "yaxis": f"smallest error, {unit.name}"}
    return {
        "data": data,
        "layout": {"height": 320, **{name: {"type": "log", "title": {"text": words}} for name, words in axes.items()}},
    }


def mounting_sections(result: Mounting, unit: Unit = RADIANS) -> list[Section]:
    """Lay out everything."""
    g = result.geometry
    covariance = g.covariance(result.noise.noise_std**2) * unit.factor**2
    covariance[np.abs(covariance) < 1e-9 * covariance.max()] = 0.0
    rho: Rows = (
        ("", *g.channel_names),
        [(n, *(f"{abs(v):.3f}" for v in r)) for n, r in zip(g.channel_names, g.rho, strict=True)],
    )
    return [
        *fault_sections(result, unit),
        Section(
            "Covariance of the rate",
            f"({unit.name})^2, at rest.",
            (("", *"xyz"), [(axis, *(f"{v:.3e}" for v in row)) for axis, row in zip("xyz", covariance, strict=True)]),
        ),
        Section("Look-alikes", RHO_TITLE, rho, [_rho_figure(result)]),
        Section(
            "After each possible first fault",
            "; ".join(double_lines(result)),
            told(_losses(result, [result.whole, *result.single], unit), unit),
        ),
    ]


def mounting_text(result: Mounting, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    lines = [*summary_lines(result, unit)]
    for section in mounting_sections(result, unit):
        lines += ["", *section_lines(section)]
    return "\n".join(lines) + "\n"


def mounting_page(result: Mounting, title: str) -> str:
    """Return everything, and the axes in space, as a page."""
    turned = "In the body frame; drag, or press the arrow keys, to turn."
    sections = [
        Section("Axes", turned, "", [_axes_figure(result)]),
        *mounting_sections(result),
        Section("After two", "", told(_losses(result, result.double))),
    ]
    return page(f"fdi_ros: mounting of {title}", summary_lines(result), sections)


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
