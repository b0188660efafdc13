# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of setup and calibration as text, JSON and page."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fdi_ros.core.sources import source_of
from fdi_ros.inspection.findings import (
    LOOK,
    Finding,
    Role,
    findings_figures,
    lines_of,
    verdict_of,
)
from fdi_ros.inspection.fitness import (
    bad_values,
    copy_words,
    frozen_words,
    incomplete_findings,
    message_findings,
    topic_findings,
    unused_topics,
)
from fdi_ros.inspection.topics import topic_columns
from fdi_ros.model.noise import much_noisier, noisier_words, summary_line
from fdi_ros.model.samples import Array, flag_runs
from fdi_ros.monitor.soundness import REPORTED, WHOLE, Trouble
from fdi_ros.replay.sweep_report import declared_figures
from fdi_ros.report.layout import (
    FORCES,
    RADIANS,
    Column,
    Section,
    Severity,
    Unit,
    Verdict,
    colour_of,
    drawn,
    escape,
    figures_of,
    page,
    text_of,
    time_layout,
    told,
)
from fdi_ros.setup.accelerometers import AccelerometerFit
from fdi_ros.setup.agreement import MOUNT_ERRORS
from fdi_ros.setup.calibrate import Calibration, Span, StampDelay
from fdi_ros.setup.channels import UNMEASURED, ChannelFit
from fdi_ros.setup.estimate import SHOWN_DELAY
from fdi_ros.setup.mounting import fault_sections, pair_lines
from fdi_ros.setup.positions import POSITION_LIMITS
from fdi_ros.setup.run import (
    FORCE_SIZES,
    PROOF,
    TEST_SIZES,
    SetupResult,
    Tried,
    times_words,
)
from fdi_ros.system.text import (
    LINE,
    figures,
    first_of,
    listed,
    percent,
    plus_minus,
    shown,
    span,
)

#: uncertainty of the axes along a direction of the body from which they are not well
#: shown
SHOWN_AXES = UNMEASURED / 2


class _Attention(NamedTuple):
    """From where a result of the set-up is worth a look."""

    #: part of a recording that supports its noise
    support: float = 0.2
    #: angle of axes against nominal, rad
    angle: float = float(np.radians(5.0))
    #: scale error against nominal, a share
    scale: float = 0.05
    #: move of a bias within a recording, rad/s
    swing: float = float(np.radians(0.03))
    #: bias, rad/s
    bias: float = 0.2
    #: bias of an accelerometer against the others, m/s^2
    force: float = 1.0


ATTENTION = _Attention()


class _TestFaults(NamedTuple):
    """Faults with which a set-up is tried."""

    #: size of test faults, rad/s
    size: float = 0.1
    #: share of them to be found
    named: float = 0.9


TEST_FAULTS = _TestFaults()

CONFIG_HINT = "As written; loaded back, and a monitor was built from it."
NOISE_HINT = (
    "Standard deviation of one sample, averaged over 5 s, vibration included."
    " noise_std (marked at the left) is the"
    " level of the quietest windows; the monitor measures in flight what vibration adds."
)
FORCE_HINT = (
    "Relative to the mean of all accelerometers, because errors that all share do not show. With standard errors (+-)."
    " Nominal axes: those of the gyros, at right angles within a unit."
)
WARNINGS_HINT = "They do not decide the verdict; look at them when you can."
BIAS_HINT = "Estimate over the recording, minus the mean of each channel. The common part is observable only at rest."


def calibration_findings(
    result: Calibration, body_frame: str, unit: Unit = RADIANS
) -> Iterator[Finding]:
    """Yield results, unknown quantities and warnings."""
    yield from _found(result, unit)
    yield from _accelerometers(result)
    yield from _positions(result)
    yield from _unknown(result, body_frame, unit)
    yield from _warnings(result, unit)


def _found(result: Calibration, unit: Unit) -> Iterator[Finding]:
    """Yield noise, remaining errors in motion, walk of the biases, and delays."""
    found = result.estimate
    name = unit.name
    factor = unit.factor
    rest = found.rest_seconds
    walk = found.bias_walk
    floor = found.floor
    usual = np.median(found.moment, axis=0)
    words = f"axes, biases and noise, from {rest:.1f} s at rest and {result.duration - rest:.1f} s in motion"
    yield Finding(Role.FOUND, "time at rest", words, value=rest)
    lowest, median = (
        span(std.min() * factor, std.max() * factor, ".2g")
        for std in (floor.std, usual)
    )
    words = f"noise_std {lowest} {name}, {_quietest(floor.share)};"
    words += f" median with vibration {median}"
    largest = int(floor.std.argmax())
    yield Finding(
        Role.FOUND,
        "noise",
        words,
        (),
        float(floor.std[largest]),
        float(floor.error[largest]),
    )
    words = f"scale_std {plus_minus(*result.scale)}, timing_std {figures(1e3 * result.timing, 2)} ms; "
    words += "bias walk" if walk.value else "bias walk too small to measure, below"
    size = figures((walk.value or walk.possible) * factor, 2)
    words += f" {size} {name} per sqrt(s)"
    yield Finding(Role.FOUND, "scale error", words, (), *result.scale)
    bent = found.nonlinearity
    if bent.is_measured:
        size = _percent(bent.value, bent.error)
        if abs(bent.value) < bent.error:
            size = f"too small to measure, below {_percent(bent.error)}"
        words = f"nonlinearity {size} of the largest rate"
        yield Finding(Role.FOUND, "nonlinearity", words, (), bent.value, bent.error)
    for delay in result.delays:
        names = [result.names[i] for i in delay.channels]
        words = f"{', '.join(names)}: {_delay_words(delay, 'imus.delays' in result.settings)}"
        yield Finding(
            Role.FOUND,
            "delay",
            words,
            names,
            delay.value,
            delay.error,
            MOUNT_ERRORS.sigmas * delay.error,
        )


def _percent(value: float, error: float = 0.0) -> str:
    """Return a relative error in percent, with its standard error if there is one: ``0.42 +- 0.03 %``."""
    in_percent = 100.0 * value
    words = plus_minus(in_percent, 100.0 * error) if error else figures(in_percent, 2)
    return f"{words} %"


def _quietest(share: float) -> str:
    """Return in which part of the recording the noise is the quietest."""
    if share > 0.995:
        return "over the whole recording"
    return f"in the quietest {percent(share)} of the recording"


def _position(axis: str, value: float, error: float) -> str:
    """Return a measured position in words, m: a value below its error is no number."""
    if abs(value) < error:
        return f"{axis} below {error:.1g}"
    # As many digits as the first one of the error.
    digits = max(3, math.ceil(-math.log10(error)))
    return f"{axis} {value:.{digits}f} +- {error:.1g}"


def _positions(result: Calibration) -> Iterator[Finding]:
    """Yield the positions of accelerometers, measured or not."""
    for one in result.positions:
        name = one.name
        known = one.measured
        values = [
            _position(axis, value, error) if shows else f"{axis} not measured"
            for axis, value, error, shows in zip(
                "xyz", one.value, one.error, known, strict=True
            )
        ]
        words = f"accelerometers of {name}, position from the first unit, m: "
        words += ", ".join(values)
        error = float(one.error.max())
        if known.all():
            yield Finding(
                Role.FOUND,
                "position",
                words,
                [name],
                error=error,
                bound=POSITION_LIMITS.shown,
            )
            continue
        words += "; the configured position is kept there. Turn the vehicle back and"
        words += " forth about all axes"
        yield Finding(
            Role.UNKNOWN,
            "position",
            words,
            [name],
            error=error,
            bound=POSITION_LIMITS.shown,
        )


def _delay_words(delay: StampDelay, corrected: bool) -> str:
    """Describe the delay of stamps, and whether the config corrects for this delay."""
    if abs(delay.value) < delay.error:
        return f"delay relative to the first unit: zero within +-{1e3 * delay.error:.2g} ms"
    side = "late (measured before the stamp)"
    if delay.value < 0:
        side = "early (measured after the stamp)"
    what = "corrected" if delay.shown else "not corrected: the delay may be zero"
    if not corrected:
        what = "not corrected: all come in one message"
    size = f"{1e3 * abs(delay.value):.2f} +- {1e3 * delay.error:.2f} ms"
    return f"stamps {size} {side} relative to the first unit, {what}"


def _unknown(result: Calibration, body_frame: str, unit: Unit) -> Iterator[Finding]:
    """Yield unobserved quantities with the assumption made and the remedy."""
    found = result.estimate
    share = result.estimate.floor.share
    if not found.rest_seconds:
        common = float(np.sqrt(np.mean(result.bias_std**2)))
        words = f"never at rest: a bias common to all gyros looks like a rotation (+-{common * unit.factor:.2g}"
        words += f" {unit.name}), and noise_std is from the quietest motion. Let the vehicle stand still for 10 s,"
        words += " motors off"
        yield Finding(Role.UNKNOWN, "rest", words, error=common)
    elif share <= ATTENTION.support:
        words = f"noise_std is from the quietest {percent(share)} of the recording: a longer"
        words += " rest gives a better value"
        yield Finding(Role.UNKNOWN, "rest", words, value=share, bound=ATTENTION.support)
    error = result.axis_errors
    rms = np.std(found.rate, axis=0) * unit.factor
    if unmeasured := ["xyz"[a] for a in range(3) if error[a] > UNMEASURED]:
        which = " and ".join(unmeasured)
        along, about = (
            ("", "") if len(unmeasured) == 3 else (f" along {which}", f" about {which}")
        )
        words = f"scale factors{along}: not measured (no turns{about} larger than the vibration); the configured values"
        words += " and their uncertainty are kept. Turn the vehicle back and forth at about 1 rad/s"
        yield Finding(
            Role.UNKNOWN,
            "scale factors",
            words,
            unmeasured,
            None,
            float(error.max()),
            UNMEASURED,
        )
    if poor := [a for a in range(3) if SHOWN_AXES < error[a] <= UNMEASURED]:
        turns = ", ".join(
            f"{'xyz'[a]} ({rms[a]:.2g} {unit.name} rms, axes +-{_percent(error[a])})"
            for a in poor
        )
        words = f"axes: too little rotation about {turns} of {body_frame}; the result stays near the configured axes."
        words += f" Turn the vehicle back and forth about {listed(['xyz'[a] for a in poor])} at about 1 rad/s"
        yield Finding(
            Role.UNKNOWN,
            "axes",
            words,
            ["xyz"[a] for a in poor],
            None,
            float(error[poor].max()),
            SHOWN_AXES,
        )
    if not found.nonlinearity.is_measured:
        words = "nonlinearity: not measured; turn faster, both ways about every axis"
        yield Finding(Role.UNKNOWN, "nonlinearity", words)
    if late := [d for d in result.delays if d.error > SHOWN_DELAY]:
        first_ones = [result.names[d.channels[0]] for d in late]
        units = [name.rpartition(".")[0] for name in first_ones]
        names = list(dict.fromkeys(units))
        worst = max(d.error for d in late)
        words = f"delays of {', '.join(names)} are known only to {1e3 * worst:.1f} ms: turn back and forth faster"
        yield Finding(Role.UNKNOWN, "delay", words, names, None, worst, SHOWN_DELAY)


def _accelerometers(result: Calibration) -> Iterator[Finding]:
    """Yield findings on the accelerometers, and what is missing."""
    if result.accelerometers is not None:
        yield from _found_forces(result.accelerometers)
        yield from _unknown_forces(result.accelerometers)
        yield from _force_warnings(result.accelerometers)
    elif result.refused:
        words = f"accelerometers: not calibrated: {result.refused}"
        yield Finding(Role.UNKNOWN, "accelerometers", words)


def _found_forces(fit: AccelerometerFit) -> Iterator[Finding]:
    """Yield noise, biases and scale error of the accelerometers."""
    found = fit.estimate
    name = FORCES.name
    usual = np.median(found.moment, axis=0)
    lowest, median = (
        span(std.min(), std.max(), ".2g") for std in (found.floor.std, usual)
    )
    words = f"accelerometers: noise {lowest} {name}, {_quietest(found.floor.share)};"
    words += f" median with vibration {median}"
    largest = int(found.floor.std.argmax())
    noise = found.floor.std[largest]
    error = found.floor.error[largest]
    yield Finding(
        Role.FOUND, "accelerometer noise", words, (), float(noise), float(error)
    )
    shown = np.abs(found.bias) > fit.bias_std
    words = f"accelerometers: biases against each other: {shown.sum()} of {len(shown)}"
    words += " are larger than their errors"
    if shown.any():
        largest = int(np.where(shown, np.abs(found.bias), 0.0).argmax())
        value = float(found.bias[largest])
        error = float(fit.bias_std[largest])
        size = f"{'+' if value > 0.0 else ''}{plus_minus(value, error)}"
        words += f", the largest {fit.names[largest]} {size} {name}"
    yield Finding(Role.FOUND, "accelerometer bias", words)
    words = "accelerometers: after correction their scales still differ by"
    words += f" {_percent(*fit.scale)}"
    yield Finding(Role.FOUND, "accelerometer scale error", words, (), *fit.scale)


def _unknown_forces(fit: AccelerometerFit) -> Iterator[Finding]:
    """Yield what the recording does not show of the accelerometers."""
    error = fit.axis_errors
    if unmeasured := ["xyz"[a] for a in range(3) if error[a] > UNMEASURED]:
        words = f"accelerometers: scale factors and misalignments along {listed(unmeasured)}: not"
        words += " measured (gravity keeps its direction, or vibration hides it); a bias there may be a scale"
        words += " error. Lay the vehicle on each of its six sides for some seconds"
        yield Finding(
            Role.UNKNOWN,
            "accelerometer scale factors",
            words,
            unmeasured,
            None,
            float(error.max()),
            UNMEASURED,
        )
    words = "accelerometers: a bias, scale error or misalignment that all have in common is not seen, because"
    words += " they agree"
    yield Finding(Role.UNKNOWN, "common accelerometer error", words)


def _force_warnings(fit: AccelerometerFit) -> Iterator[Finding]:
    """Yield declarations, unequal noise and large biases of the accelerometers."""
    found = fit.estimate
    name = FORCES.name
    if fit.faults:
        yield _declared(fit.faults, fit.names)
    if noisy := much_noisier(found.floor.std, fit.units):
        words = noisier_words(fit.names, found.floor.std, fit.units, name, 1.0)
        who = [fit.names[i] for i, _ in noisy]
        yield Finding(
            Role.WARNING, "accelerometer noise", f"{words} when quietest", who
        )
    if len(large := np.flatnonzero(np.abs(found.bias) > ATTENTION.force)):
        each = ", ".join(
            f"{fit.names[i]} by {found.bias[i]:+.2f} {name}" for i in large
        )
        yield Finding(
            Role.WARNING,
            "large accelerometer biases",
            f"accelerometers off against the others: {each}",
            [fit.names[i] for i in large],
            float(np.abs(found.bias).max()),
            None,
            ATTENTION.force,
        )


def _declared(faults: Sequence[Span], names: Sequence[str]) -> Finding:
    """Return the finding for what the monitor declares in the part used for fitting."""
    spans = [_span_words(span, names) for span in faults]
    words = (
        f"the monitor declares a fault in this recording: {first_of(spans, 3, '; ')}"
    )
    struck = sorted({i for span in faults for i in span.channels})
    return Finding(
        Role.WARNING,
        "declared",
        words,
        [names[i] for i in struck],
        headline="USABLE, BUT LOOK",
        advice="replay the recording: its verdict says what to check",
    )


def _span_words(span: Span, names: Sequence[str]) -> str:
    """Return which channels are declared, and when."""
    who = " or ".join(names[i] for i in span.channels)
    if len(span.channels) == len(names):
        who = f"any of the {len(names)} channels"
    if f"{span.start:.1f}" == f"{span.end:.1f}":
        return f"{who} at {span.start:.1f} s"
    return f"{who} from {span.start:.1f} s to {span.end:.1f} s"


class _Bound(NamedTuple):
    """Values of channels, and the bound beyond which they are worth a look."""

    #: finding in words
    what: str
    #: (n,) of the channels
    values: Array
    #: largest usual absolute value
    bound: float
    form: str  #: of one value, after multiplication by `factor`
    #: from the unit of the values to the unit of the form
    factor: float


def _warnings(result: Calibration, unit: Unit) -> Iterator[Finding]:
    """Yield warnings: faults, lost values, and channels beyond a bound."""
    found = result.estimate
    names = result.names
    if result.faults:
        yield _declared(result.faults, names)
    if lost := _lost_words(result):
        words = f"values not used: {'; '.join(lost)}"
        yield Finding(Role.WARNING, "values not used", words)
    noise = found.floor.std
    if noisy := much_noisier(noise, result.units):
        words = noisier_words(names, noise, result.units, unit.name, unit.factor)
        words += " at rest: loosely mounted, poorly damped, of another type, or faulty"
        worst, beside = max(noisy, key=lambda one: noise[one[0]])
        who = [names[i] for i, _ in noisy]
        yield Finding(
            Role.WARNING, "noise", words, who, float(noise[worst]), None, beside
        )
    swing = np.ptp(found.curve, axis=0)
    if far := [names[i] for i in np.flatnonzero(swing >= REPORTED.drift_rad_s)]:
        most = f"{swing.max() * unit.factor:.2g} {unit.name}"
        words = f"the bias of {listed(far)} moved by up to {most} within the recording"
        advice = Trouble.DRIFT.advice(far)
        yield Finding(Role.WARNING, "drift", words, far, headline=LOOK, advice=advice)
    for one in _bounds(result, unit):
        beyond = np.flatnonzero(np.abs(one.values) > one.bound)
        if not len(beyond):
            continue
        each = [
            f"{names[i]} by {one.form.format(one.values[i] * one.factor)}"
            for i in beyond
        ]
        yield Finding(
            Role.WARNING,
            one.what,
            f"{one.what}: {', '.join(each)}",
            [names[i] for i in beyond],
            float(one.values[np.abs(one.values).argmax()]),
            None,
            one.bound,
        )


def _lost_words(result: Calibration) -> list[str]:
    """Words for values that were not used, by the reason."""
    found = result.estimate
    words = []
    for why, count in result.unusable.items():
        usual = why in ("missing", "spikes")
        # 1 % of the samples is worth a look.
        if count.max() <= (0.01 * found.blocks.count.sum() if usual else 0):
            continue
        # At the end of its range a gyro repeats one value, too.
        called = why.replace("_", " ")
        if why == "repeated":
            called = "that repeat one value"
        which = ", ".join(result.names[i] for i in np.flatnonzero(count))
        who = "every channel" if count.all() else which
        words.append(f"{int(count.sum())} {called} ({who})")
    return words


def _bounds(result: Calibration, unit: Unit) -> list[_Bound]:
    """Return the figures of gyros that are worth a look beyond a bound."""
    found = result.estimate
    rate = f"{{:.3g}} {unit.name}"
    swing = np.ptp(found.curve, axis=0)
    degrees = float(np.degrees(1.0))
    return [
        _Bound(
            "axes rotated from nominal",
            result.angle,
            ATTENTION.angle,
            "{:.1f} deg",
            degrees,
        ),
        _Bound(
            "scale factors differ from nominal",
            result.factor - 1.0,
            ATTENTION.scale,
            "{:+.1f} %",
            100.0,
        ),
        _Bound(
            "biases moved within the recording",
            swing,
            ATTENTION.swing,
            rate,
            unit.factor,
        ),
        _Bound("large biases", found.bias, ATTENTION.bias, rate, unit.factor),
    ]


def setup_findings(found: SetupResult, unit: Unit = RADIANS) -> Iterator[Finding]:
    """Yield all findings: basis and worth of the settings, unknowns, warnings."""
    result = found.calibration
    mounting = found.mounting
    units = source_of(found.config).units
    g = mounting.geometry
    rate = found.config.sample_rate
    yield from _worth(found, unit)
    where = f"{len(units)} units" if units else "one array"
    yield Finding(
        Role.FOUND,
        "channels",
        f"{g.n} channels in {where} at {figures(rate, 4)} Hz",
        value=rate,
    )
    if known := sum(mount.shown for mount in found.mounts[1:]):
        words = f"mounts: {known} of {len(found.mounts) - 1} measured relative to {found.config.imu_names[0]}"
        yield Finding(Role.FOUND, "mounts", words, value=known)
    if result is not None:
        for finding in calibration_findings(result, found.config.body_frame, unit):
            # What other settings declare is no warning about those that are written.
            if not found.kept or finding.what != "declared":
                yield finding
    noise = (mounting.noise, mounting.false_alarm_probability, unit.name, unit.factor)
    yield Finding(
        Role.FOUND, "mounting", summary_line(g, *noise, agree=not found.disagree)
    )
    yield from _not_shown(found, unit)
    if words := copy_words(found.reports):
        yield Finding(Role.WARNING, "copy", words, headline="USABLE, BUT LOOK")
    for topic, words in unused_topics(found.reports, found.unread):
        yield Finding(
            Role.WARNING,
            "left out",
            words,
            (topic,),
            headline="USABLE, BUT LOOK",
            advice=Trouble.LEFT_OUT.advice([topic]),
        )
    of_messages = [
        *incomplete_findings(found.reports, found.incomplete, LOOK),
        *message_findings(found.chosen, LOOK),
        *bad_values(found.chosen, LOOK),
        *topic_findings(found.chosen, unit),
    ]
    yield from of_messages
    yield from _looks_of_proof(found, {one.advice for one in of_messages})
    limits = [
        line
        for line in pair_lines(mounting)
        if "not" in line.split(":")[-1] or "never" in line
    ]
    if limits:
        yield Finding(Role.WARNING, "mounting", "; ".join(limits))


def _looks_of_proof(found: SetupResult, said: Collection[str]) -> Iterator[Finding]:
    """Yield the reasons to look that the proof and the next replay give.

    What the whole recording shows by its topics, with advice that was ``said``, is not
    repeated for a part of it.
    """
    tried = found.proof.before if found.kept else found.proof.after
    if not found.kept and (words := found.proof.worse_forces):
        words = f"in {found.proof.source}, {words}"
        yield Finding(Role.WARNING, "accelerometers", words, headline=LOOK)
    if tried.baseline is None:
        return
    source = source_of(found.config)
    topic_of = dict(zip(source.names, source.topics, strict=True))
    known = set(said)
    for part, baseline in (
        (found.proof.source, tried.baseline),
        ("a replay of the whole recording", found.replayed),
    ):
        for one in baseline.judgement.concerns if baseline is not None else ():
            topics = [topic_of.get(name.partition(".")[0], name) for name in one.who]
            if not known.isdisjoint((one.trouble.advice(topics), one.advice)):
                continue
            known.add(one.advice)
            yield Finding(
                Role.WARNING,
                "health",
                f"in {part}, {one}",
                one.who,
                headline=LOOK,
                advice=one.advice,
            )


def _worth(found: SetupResult, unit: Unit) -> Iterator[Finding]:
    """Yield the verdict on the settings: the worst trouble, or their isolation."""
    proof = found.proof
    units = source_of(found.config).units
    tried = proof.before if found.kept else proof.after
    warning = Role.WARNING
    if found.disagree:
        yield Finding(warning, "agreement", found.refused, headline="DO NOT USE")
    elif found.calibration is None and not units:
        words = (
            f"the axes of the array are unknown (a cone is assumed): {found.refused}"
        )
        yield Finding(warning, "axes", words, headline="DO NOT USE")
    elif words := frozen_words(found.chosen):
        yield Finding(
            warning,
            "frozen",
            words,
            headline="DO NOT USE",
            advice="check driver and bus, and record again",
        )
    elif tried.judged < WHOLE.judged:
        share = f"only {percent(tried.judged)}" if tried.judged else "none"
        why = found.refused or tried.note or "channels are missing"
        words = f"the monitor judges {share} of the samples in the proof: {why}"
        yield Finding(
            warning, "judged", words, (), tried.judged, None, WHOLE.judged, "DO NOT USE"
        )
    elif tried.declared:
        words = f"the monitor declares {times_words(tried.declared)} in {proof.source}: a sensor is faulty"
        words += " there, or the settings are wrong"
        yield Finding(
            warning, "declared", words, list(tried.declared), headline="DO NOT USE"
        )
    elif found.kept and (stuck := proof.after.stuck):
        # The settings before need not see it: what moves is their noise.
        verb = "repeats" if len(stuck) == 1 else "repeat"
        words = f"{listed(list(stuck))} {verb} one value while the others move, in {proof.source}"
        yield Finding(
            warning,
            "stuck",
            words,
            list(stuck),
            headline="DO NOT USE",
            advice="check driver and bus, and record again",
        )
    elif found.kept:
        written = "The file has the settings that were given"
        if found.chosen:
            written = "The file has the measured mounts, and otherwise the settings of `fdi inspect`"
        words = f"in {proof.source}, {found.kept}. {written}; the other figures below are not used."
        words += _isolation_words(tried, unit)
        yield Finding(warning, "proof", words, headline="NO BETTER THAN BEFORE")
    else:
        yield _usable(found, tried, unit)
    if found.calibration is None and not found.disagree and units:
        words = f"{found.refused}: axes, delays and noise in motion are not known"
        yield Finding(
            Role.UNKNOWN, "calibration", words, headline="USABLE, NOT CALIBRATED"
        )


def _usable(found: SetupResult, tried: Tried, unit: Unit) -> Finding:
    """Return the finding for settings without a false alarm."""
    unused = " (not used for fitting)" if found.proof.apart else ""
    words = f"no false alarm in {found.proof.source}{unused}."
    isolated, biases = tried.isolated_of
    if not found.mounting.losses[0].isolable:
        words += " A fault is detected, but its channel cannot be identified."
        return Finding(Role.WORTH, "proof", words, headline="USABLE")
    if not biases:
        return Finding(Role.WORTH, "proof", words, headline="USABLE")
    words += _isolation_words(tried, unit)
    named, of = tried.isolated[TEST_FAULTS.size]
    if named < TEST_FAULTS.named * of:
        return Finding(
            Role.WARNING,
            "proof",
            words,
            (),
            named,
            None,
            TEST_FAULTS.named * of,
            "USABLE FOR LARGE FAULTS ONLY",
            "reduce vibration, or record again with rest and turns about every axis",
        )
    return Finding(Role.WORTH, "proof", words, (), isolated, None, biases, "USABLE")


def _isolation_words(tried: Tried, unit: Unit) -> str:
    """Return how many test faults were isolated, and what to expect if few of `TEST_FAULTS.size` were."""
    isolated, biases = tried.isolated_of
    if not biases:
        return ""
    sizes = (TEST_SIZES[0], TEST_FAULTS.size, TEST_SIZES[-1])
    low, floor, high = (f"{size * unit.factor:.3g}" for size in sizes)
    words = f" Of {biases} test faults added there ({low} to {high} {unit.name}),"
    if not isolated:
        return f"{words} none was isolated: a faulty gyro may be detected without being identified."
    words += f" {isolated} were isolated."
    named, of = tried.isolated[TEST_FAULTS.size]
    if named >= TEST_FAULTS.named * of:
        return words
    words += f" Of {of} with {floor} {unit.name}, {named} were isolated"
    largest, among = tried.isolated[TEST_SIZES[-1]]
    if largest >= TEST_FAULTS.named * among:
        return f"{words}: expect to identify the faulty gyro only of larger faults."
    words += (
        f", and of {among} with {high} {unit.name}, {largest}: a faulty gyro may be"
    )
    return f"{words} detected without being identified."


def _not_shown(found: SetupResult, unit: Unit) -> Iterator[Finding]:
    """Yield the quantities that the recording does not show, with assumption and remedy."""
    yield from (Finding(Role.UNKNOWN, "damage", line) for line in found.damage)
    named = zip(found.config.imu_names, found.mounts, strict=False)
    if unshown := {name: mount.words for name, mount in named if not mount.shown}:
        words = "; ".join(f"{name} ({why})" for name, why in unshown.items())
        yield Finding(
            Role.UNKNOWN,
            "mounts",
            f"mount unknown, identity assumed: {words}",
            list(unshown),
        )
    if not found.chosen:
        return
    if source_of(found.config).units:
        first = found.config.imu_names[0]
        words = f"the orientation of the body: {first} is assumed to be mounted along the body axes. If it is not,"
        words += " rotate all axes in the config together"
    elif found.calibration is None:
        words = "the axes of the array: the config assumes a cone. The monitor's results are meaningless until you put"
        words += " in the true axes (geometry.axes, or a preset)"
    else:
        words = "the body frame: a recording shows only the axes of an array relative to each other; those of the first"
        words += " three channels are assumed (a cone)"
    yield Finding(Role.UNKNOWN, "body frame", words)
    turn_on_std = found.config.bias.turn_on_std
    words = "the range of the gyros (health.max_rate: see the data sheet), and how much a bias changes from one start"
    words += f" to the next (bias.turn_on_std: {turn_on_std * unit.factor:.3g} {unit.name} is assumed)"
    yield Finding(Role.UNKNOWN, "range, turn-on bias", words, value=turn_on_std)
    possible = [
        report
        for report in found.reports
        if report.could_be_gyros and report.kind is not None
    ]
    if others := [
        report.topic.name for report in possible if report not in found.chosen
    ]:
        words = f"topics that may be gyros, but were not used: {', '.join(others)}"
        yield Finding(Role.UNKNOWN, "topics", words, others)


def calibration_figures(result: Calibration) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    names = result.names
    found = result.estimate
    rest = result.estimate.rest_seconds
    return {
        "seconds": {
            "all": result.duration,
            "rest": rest,
            "motion": result.duration - rest,
        },
        "channels": figures_of(channel_columns(result)),
        "noise": {
            "share_of_recording": found.floor.share,
            "scale_std": result.scale[0],
            "scale_std_error": result.scale[1],
            "nonlinearity": found.nonlinearity.value,
            "nonlinearity_error": found.nonlinearity.error,
            "timing_std_s": result.timing,
            "bias_walk": found.bias_walk.value or None,
            "bias_walk_possible": found.bias_walk.possible,
        },
        "delays": [
            {
                "channels": [names[i] for i in d.channels],
                "late_s": d.value,
                "std_s": d.error,
                "shown": d.shown,
            }
            for d in result.delays
        ],
        "positions": [
            {
                "unit": one.name,
                "position_m": one.value,
                "std_m": one.error,
                "measured": one.measured,
            }
            for one in result.positions
        ],
        "faults": [
            {
                "channels": [names[i] for i in span.channels],
                "start_s": span.start,
                "end_s": span.end,
            }
            for span in result.faults
        ],
        **_accelerometer_figures(result),
        "settings": result.settings,
    }


def _accelerometer_figures(result: Calibration) -> dict[str, object]:
    """Return the figures of the accelerometers, in m/s^2; empty without any."""
    fit = result.accelerometers
    if fit is None:
        return {}
    return {
        "accelerometers": {
            "channels": figures_of(channel_columns(fit, FORCES)),
            "share_of_recording": fit.estimate.floor.share,
            "scale_std": fit.scale[0],
            "scale_std_error": fit.scale[1],
            "bias_walk": fit.estimate.bias_walk.value or None,
        }
    }


def _beyond_error(values: Array, errors: Array, factor: float, form: str) -> list[str]:
    """Format values (n,); one below its standard error is not measured."""
    return [
        f"{value * factor:{form}}" if abs(value) > error else "not measured"
        for value, error in zip(values, errors, strict=True)
    ]


def _error_of(values: Array, errors: Array, factor: float, form: str) -> list[str]:
    """Format the standard errors (n,) of values that are beyond theirs."""
    return [
        f"{error * factor:{form}}" if abs(value) > error else "-"
        for value, error in zip(values, errors, strict=True)
    ]


def channel_columns(result: ChannelFit, unit: Unit = RADIANS) -> list[Column]:
    """Figures of every channel, one row each."""
    found = result.estimate
    rate = unit.factor
    degrees = float(np.degrees(1.0))

    def measured(values: Array, form: str) -> list[str]:
        return [
            f"{v:{form}}" if known else "not measured"
            for v, known in zip(values, result.measured, strict=True)
        ]

    lost = [
        {why: count[i] for why, count in result.unusable.items()}
        for i in range(len(result.names))
    ]
    return [
        Column("name", result.names, ("channel",)),
        Column("axis", result.axes, ("axis x", "y", "z"), ".5f"),
        Column("axis_std", result.axes_std),
        Column("scale", result.factor),
        Column("scale_std", result.factor_error),
        Column("scale_measured", result.measured),
        Column("", measured(result.factor, ".5f"), ("scale",)),
        Column("", measured(100 * result.factor_error, ".3f"), ("+-%",)),
        Column("off_nominal_rad", result.angle),
        Column(
            "",
            _beyond_error(result.angle, result.angle_error, degrees, ".3f"),
            ("from nominal deg",),
        ),
        Column("angle_std_rad", result.angle_error),
        Column(
            "",
            _error_of(result.angle, result.angle_error, degrees, ".3f"),
            ("+-deg",),
        ),
        Column("bias", found.bias),
        Column(
            "", _beyond_error(found.bias, result.bias_std, rate, ".6f"), ("bias rad/s",)
        ),
        Column("bias_std", result.bias_std),
        Column("", _error_of(found.bias, result.bias_std, rate, ".6f"), ("+-",)),
        Column("noise_std", found.floor.std, ("noise rad/s",), ".5f", rate),
        Column("noise_std_error", found.floor.error, ("+-",), ".5f", rate),
        Column(
            "noise_median",
            np.median(found.moment, axis=0),
            ("median rad/s",),
            ".5f",
            rate,
        ),
        Column("noise_largest", found.moment.max(axis=0)),
        Column("not_used", lost, ("lost",), lambda counts: str(sum(counts.values()))),
    ]


def _mounts(found: SetupResult) -> list[Column]:
    """Figures of the mount of every unit."""
    mounts = found.mounts
    known = [mount.shown for mount in mounts]
    shared = [
        percent(max(mount.shared, 0.0)) if k else "-" for k, mount in enumerate(mounts)
    ]
    return [
        Column("unit", found.config.imu_names[: len(mounts)], ("unit",)),
        Column("known", known),
        Column(
            "rotation",
            [
                np.eye(3) if mount.rotation is None else mount.rotation
                for mount in mounts
            ],
        ),
        Column(
            "error_rad",
            [
                mount.error if shows else None
                for mount, shows in zip(mounts, known, strict=True)
            ],
        ),
        Column("off_rad", [mount.off for mount in mounts]),
        Column("", [mount.words for mount in mounts], ("mount",)),
        Column("", shared, ("rotation shared with the first",)),
    ]


def _tried(found: SetupResult, unit: Unit = RADIANS) -> list[Column]:
    """Figures of the settings before and after on the recording of the proof."""
    both = [found.proof.before, found.proof.after]
    declared = [
        "-" if one.baseline is None else times_words(one.declared) or "nothing"
        for one in both
    ]
    shares = [[one.isolated.get(size, (0, 0)) for size in TEST_SIZES] for one in both]
    isolated = [
        [{"size": s, "isolated": n, "tried": m} for s, (n, m) in one.isolated.items()]
        for one in both
    ]
    heads = [f"{size * unit.factor:.3g} {unit.name} isolated" for size in TEST_SIZES]

    def share_words(share: tuple[int, int]) -> str:
        return f"{share[0]} of {share[1]}" if share[1] else "-"

    forces = []
    if any(one.forces for one in both):
        shares_of_forces = [
            [one.forces.get(size, (0, 0)) for size in FORCE_SIZES] for one in both
        ]
        heads_of_forces = [f"{size:.3g} {FORCES.name} isolated" for size in FORCE_SIZES]
        figures = [
            [{"size": s, "isolated": n, "tried": m} for s, (n, m) in one.forces.items()]
            for one in both
        ]
        forces = [
            Column("accelerometers_isolated", figures),
            Column("", shares_of_forces, heads_of_forces, share_words),
        ]
    return [
        Column("", ("before", "new"), ("settings",)),
        Column("", declared, ("declared",)),
        Column("judged", [one.judged for one in both], ("judged",), percent),
        Column("declared", [declared_figures(one.baseline) for one in both]),
        Column("isolated", isolated),
        Column(
            "",
            shares,
            heads,
            share_words,
        ),
        *forces,
    ]


def setup_figures(found: SetupResult, bag: str) -> dict[str, object]:
    """Return everything, for programs, in SI units."""
    result = found.calibration
    proof = found.proof
    tried = dict(zip(("before", "after"), figures_of(_tried(found)), strict=True))
    return {
        "bag": bag,
        **findings_figures(list(setup_findings(found))),
        "topics": [report.topic.name for report in found.chosen],
        "mounts": figures_of(_mounts(found)),
        "calibrated": result is not None,
        "no_better": found.kept,
        **({} if result is None else calibration_figures(result)),
        "parameters": found.parameters,
        "proof": {
            "source": proof.source,
            "kept_aside": proof.apart,
            "seconds": proof.seconds,
            **tried,
        },
    }


def _proof_section(found: SetupResult, hint: str, unit: Unit) -> Section:
    """Lay out the proof; a recording whose channels contradict each other proves nothing."""
    if found.disagree:
        return Section("Proof", "", ["not done: the channels contradict each other"])
    return Section("Proof", hint, told(_tried(found, unit)))


def _sections(
    found: SetupResult, findings: Sequence[Finding], bag: str, config: str, unit: Unit
) -> tuple[list[str], list[Section]]:
    """Return the verdict with its basis, and the other sections."""
    proof = found.proof
    result = found.calibration
    first = verdict_of(findings)
    hint = f"Replays of {proof.source}: one has no fault. In each of the others a bias begins on one channel,"
    hint += f" at one of {PROOF.times} moments. Isolated: that channel alone is declared within {PROOF.within:g} s."
    bag = shlex.quote(bag)
    config = shlex.quote(config)
    is_bad = first.severity is Severity.BAD
    first_step = "the verdict on this recording"
    if is_bad:
        first_step = "shows the trouble; do not fly with this config"
    steps = [
        f"fdi replay {bag} --config {config} --report verdict.html   # {first_step}",
        f"fdi sweep {bag} --config {config} --report sweep.html     # which faults the monitor would find in it",
        f"fdi calibrate ANOTHER_BAG --config {config} --output better.yaml   # with rest, and turns about every axis",
        f"fdi_node --ros-args --params-file {config}   # on the vehicle; in a workspace: ros2 run fdi_ros fdi_node ...",
    ]
    steps = [shown(line, LINE) for line in (steps[:1] if is_bad else steps)]
    # The first line has the others.
    beside = [one for one in findings if one.words.removesuffix(".") not in first.words]
    warnings = lines_of(beside, Role.WARNING)
    sections = [
        Section("Warnings", WARNINGS_HINT if warnings else "", warnings),
        Section(
            "Not shown by this recording, or assumed",
            "",
            lines_of(findings, Role.UNKNOWN),
        ),
        _proof_section(found, hint, unit),
        Section("What to do next", "", steps),
    ]
    if result is not None:
        channels = told(channel_columns(result, unit), unit)
        sections.insert(
            0, Section("Axes, biases and noise", "With standard errors (+-).", channels)
        )
        if (fit := result.accelerometers) is not None:
            rows = told(channel_columns(fit, FORCES), FORCES)
            sections.insert(1, Section("Accelerometers", FORCE_HINT, rows))
    return [shown(first.words, LINE), *lines_of(findings, Role.FOUND)], sections


def setup_text(found: SetupResult, bag: str, config: str, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    (first, *lines), sections = _sections(
        found, list(setup_findings(found, unit)), bag, config, unit
    )
    return (
        text_of(
            [first, "", f"{shown(bag, LINE)}: found", *(f"  {line}" for line in lines)],
            sections,
        )
        + "\n\n"
    )


def setup_page(found: SetupResult, bag: str, config: str, unit: Unit = RADIANS) -> str:
    """Return the page with all findings and their course over time."""
    findings = list(setup_findings(found, unit))
    topics = [report for report in found.reports if report.could_be_gyros]
    (first, *lines), sections = _sections(found, findings, bag, config, unit)
    used = Column(
        "", ["yes" if report in found.chosen else "no" for report in topics], ("used",)
    )
    sections += _courses(found.refused, found.calibration, unit)
    if found.mounts:
        sections.append(Section("Mounts", "", told(_mounts(found))))
    if topics:
        sections.append(
            Section(
                "Topics",
                "The whole recording.",
                told([*topic_columns(topics, unit), used]),
            )
        )
    sections += fault_sections(found.mounting, unit)
    sections.append(
        Section(
            "The config",
            CONFIG_HINT,
            f'<div class="scroll"><pre>{escape(found.text)}</pre></div>',
        )
    )
    verdict = Verdict(verdict_of(findings).severity, first)
    found_lines = (f"Found: {line}." for line in lines)
    return page(f"fdi_ros: settings from {bag}", [verdict, *found_lines], sections)


def _courses(refused: str, result: Calibration | None, unit: Unit) -> list[Section]:
    """Plot changes over the recording, and the spectrum of differences."""
    if result is None:
        return [Section("Axes, delays and biases", f"Not known: {refused}.")]
    found = result.estimate
    names = result.names
    times = found.blocks.time
    half = 0.0
    if len(times) > 1:
        half = 0.5 * float(np.median(np.diff(times)))
    rests = [
        {
            "type": "rect",
            "kind": "rest",
            "x0": float(times[a]) - half,
            "x1": float(times[b - 1]) + half,
        }
        for a, b in flag_runs(found.rest)
    ]

    def course(
        title: str, hint: str, what: str, curves: list[dict[str, object]], **axis: str
    ) -> Section:
        layout = time_layout(
            280, yaxis={"title": {"text": f"{what}, {unit.name}"}, **axis}, shapes=rests
        )
        return Section(title, hint, "", [{"data": curves, "layout": layout}])

    def curves(
        names: Sequence[str], x: Array, y: Array, **more: object
    ) -> list[dict[str, object]]:
        step = max(len(x) // 2000, 1)
        at = np.round(x[::step], 3).tolist()
        look = {"type": "scatter", "mode": "lines", **more}
        lines = [
            {"name": name, "line": {"color": colour_of(i), "width": 1.2}, **look}
            for i, name in enumerate(names)
        ]
        columns = (y[::step] * unit.factor).T
        values = [list(map(drawn, column)) for column in columns]
        return [
            {**line, "x": at, "y": column}
            for line, column in zip(lines, values, strict=True)
        ]

    noise = curves(names, times, found.moment)
    noise += curves(
        names, times[:1], found.floor.std[None], mode="markers", showlegend=False
    )
    shaded = (
        f"Shaded: at rest, {found.rest_seconds:.1f} s." if rests else "Nowhere at rest."
    )
    walks = curves(names, found.times, found.curve - found.bias)
    spectrum = result.spectrum.section(unit)
    return [
        course(
            "Motion", shaded, "rate", curves("xyz", found.blocks.seconds, found.rate)
        ),
        course("Noise over time", NOISE_HINT, "noise", noise, type="log"),
        course("Biases over time", BIAS_HINT, "bias minus its mean", walks),
        *([] if spectrum is None else [spectrum]),
    ]
