# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording to a config: topics, mounts, delays, biases and noise.

Unknown quantities stay as in ``fdi inspect`` and are reported. The fullest settings
from which a monitor can be built are taken. A part of the recording is kept aside as a
proof: false declarations there, and isolated test biases. If the new settings are no
worse than those before, settings from the whole recording are written, otherwise the
old ones stay. `recalibrate` does the same for an existing config.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config, parameter_file
from fdi_ros.core.sources import source_of
from fdi_ros.core.states import Reason
from fdi_ros.errors import BagError, CalibrationError, DisagreementError, FdiError
from fdi_ros.inspection.fitness import (
    candidates,
    clocks_apart,
    copy_words,
    needs,
    no_common_time,
    refuse_unfit,
)
from fdi_ros.inspection.starting_config import starting_config
from fdi_ros.inspection.topics import INTERVALS, TopicReport, inspect
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import felt_units
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.outcomes import OutcomeKind
from fdi_ros.replay.sweep import (
    FORCES,
    GYROS,
    Baseline,
    Plan,
    Subject,
    parse_swept,
    sweep,
    watch_baseline,
)
from fdi_ros.setup.agreement import Mount, find_mounts
from fdi_ros.setup.blocks import prepare
from fdi_ros.setup.calibrate import (
    NEEDED_DATA,
    REPLACED,
    UNKNOWN_AXES,
    Calibration,
    calibrate,
    reference_channels,
)
from fdi_ros.setup.mounting import Mounting, assess
from fdi_ros.system.text import first_of, percent, shown

#: biases of gyros tried, rad/s, and of accelerometers, m/s^2
TEST_SIZES = (0.03, 0.1, 0.3)
FORCE_SIZES = (0.3, 1.0, 3.0)


class _Proof(NamedTuple):
    """How a set-up is proved on a part kept aside."""

    #: size from which on biases of accelerometers count in a comparison, m/s^2:
    #: healthy ones move by 0.6 m/s^2 as vibration begins or ends
    force_floor: float = 1.0
    #: time in which biases are to be isolated, s
    within: float = 4.0
    #: how often each bias is tried
    times: int = 2
    #: fewer biases isolated than before that are chance: one at the edge of
    #: `within`
    chance: int = 1
    #: part kept aside
    share: float = 0.25
    #: shortest part kept aside, s: all biases have room
    least: float = times * within
    #: longest part kept aside, s
    most: float = 120.0


PROOF = _Proof()

#: s that must be left to calibrate on
LEAST_LEFT = 2 * NEEDED_DATA.duration


@dataclass
class Tried:
    """One config on the recording of a proof."""

    #: result without test faults, None if nothing is judged
    baseline: Baseline | None
    #: what kept the proof from being complete, or empty
    note: str
    #: by size, rad/s: biases isolated and tried; empty if the recording is too short
    isolated: dict[float, tuple[int, int]]
    #: the same of accelerometers, m/s^2; empty also without any
    forces: dict[float, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.judged = (
            0.0 if self.baseline is None else self.baseline.judged
        )  # share of the samples
        self.declared: dict[
            str, float
        ] = {}  # channels declared, without a fault, and when first, s
        self.stuck: dict[str, float] = {}
        """Channels declared because they repeat one value in motion, and when first, s."""
        for event in self.baseline.declared if self.baseline is not None else ():
            self.declared.setdefault(event.channel, event.at_s)
            if event.reason == Reason.STUCK.value:
                self.stuck.setdefault(event.channel, event.at_s)
        self.isolated_of = _of_all_sizes(self.isolated)
        large = {
            size: n for size, n in self.forces.items() if size >= PROOF.force_floor
        }
        self.forces_of = _of_all_sizes(large)


def _of_all_sizes(isolated: Mapping[float, tuple[int, int]]) -> tuple[int, int]:
    """Return the number of biases isolated, and tried, of all sizes."""
    found = sum(count for count, _ in isolated.values())
    tried = sum(count for _, count in isolated.values())
    return found, tried


def times_words(declared: Mapping[str, float]) -> str:
    """List channels and when they were declared, s."""
    each = [f"{name} at {at:.1f} s" for name, at in declared.items()]
    return first_of(each, 3)


@dataclass(frozen=True)
class Proof:
    """Performance of the settings on a recording or on a part of one."""

    #: which, in words
    source: str
    #: whether the settings are from other samples
    apart: bool
    #: length of the recording or of the part, s
    seconds: float
    #: with the settings from before
    before: Tried
    #: with the new settings
    after: Tried

    @property
    def worse(self) -> str:
        """Words for worse performance than before, or empty."""
        before = self.before
        after = self.after
        (was, tried_before), (now, tried) = before.isolated_of, after.isolated_of
        new = {
            name: at
            for name, at in after.declared.items()
            if name not in before.declared
        }
        if before.baseline is None:
            return ""
        if after.baseline is None:
            return f"the new settings judge nothing: {after.note}"
        if new:
            return f"the new settings declare {times_words(new)}"
        # Smaller losses occur at the edge of a gap.
        if before.judged - after.judged > 0.02:
            words = f"the new settings judge {percent(after.judged)} of the samples"
            return f"{words} instead of {percent(before.judged)}"
        if tried_before == tried and was - now > PROOF.chance:
            return f"the new settings isolate {now} of {tried} biases instead of {was}"
        return ""

    @property
    def worse_forces(self) -> str:
        """Words for fewer biases of accelerometers isolated than before, or empty."""
        was, tried_before = self.before.forces_of
        now, tried = self.after.forces_of
        if tried_before != tried or was - now <= PROOF.chance:
            return ""
        words = f"the new settings isolate {now} of {tried} biases of accelerometers of"
        return f"{words} {PROOF.force_floor:g} m/s^2 or more instead of {was}"


def _tried(block: Block, config: Config, start: float) -> Tried:
    """Replay a recording without and with test biases.

    ``start``: time of the block, s from the first message.
    """
    faults = [f"kind=bias size={size:g}" for size in TEST_SIZES]
    faults += [f"channel={FORCES} kind=bias size={size:g}" for size in FORCE_SIZES]
    plan = Plan(
        tuple(one for text in faults for one in parse_swept(text)),
        PROOF.times,
        PROOF.within,
    )
    one = Subject("settings", config, block, start=start)
    try:
        sweep([one], plan)
    except FdiError as error:
        if (baseline := one.baseline) is None:
            raise FdiError(one.refused) from error
        return Tried(
            baseline if baseline.judged else None, baseline.note or str(error), {}
        )
    halves: dict[str, dict[float, tuple[int, int]]] = {GYROS: {}, FORCES: {}}
    for swept in plan.faults:
        outcomes = [
            trial.scored.outcome for trial in one.trials if trial.swept == swept
        ]
        # Where a channel stands declared without a fault, nothing is tried, and nothing would be found.
        tried = len(outcomes) + len(one.skipped) * len(one.struck(swept))
        if tried:
            found = outcomes.count(OutcomeKind.ISOLATED)
            halves[swept.channels][swept.size or 0.0] = found, tried
    return Tried(one.baseline, one.refused, halves[GYROS], halves[FORCES])


Parameters = dict[str, object]


@dataclass(frozen=True, kw_only=True)
class LearnedSettings:
    """A config with the calibration behind it, if any."""

    #: ``{"section.field": value}`` of the config
    parameters: Parameters
    #: with these parameters
    config: Config
    #: behind the config. None: there is none
    calibration: Calibration | None = None
    #: error that prevented a calibration
    why: FdiError | None = None
    #: mount of each unit, empty for arrays or configured mounts
    mounts: tuple[Mount, ...] = ()

    @property
    def refused(self) -> str:
        """Reason without a calibration, or empty."""
        return str(self.why or "")

    @property
    def disagree(self) -> bool:
        """Whether channels contradict each other."""
        return isinstance(self.why, DisagreementError)


@dataclass(frozen=True, kw_only=True)
class SetupResult(LearnedSettings):
    """The config from a recording, with its evidence."""

    #: reason to keep the settings before, or empty
    kept: str
    #: what geometry and noise of the config allow
    mounting: Mounting
    #: performance of the settings
    proof: Proof
    #: replay of the whole recording with the config, None if not judged
    replayed: Baseline | None = None
    #: of all topics
    reports: Sequence[TopicReport] = ()
    #: unreadable parts of the recording, a sentence each
    damage: tuple[str, ...] = ()
    #: what makes the recording incomplete, as it continues ``the recording``, may be empty
    incomplete: str = ""
    #: gyros that cannot be read as such, and why
    unread: tuple[tuple[str, str], ...] = ()
    #: the topics of the gyros
    chosen: Sequence[TopicReport] = ()

    @property
    def remarks(self) -> dict[str, str]:
        """How the parameters were found, by parameter: for the parameter file."""
        calibrated = self.calibration is not None and not self.kept
        rested = (
            self.calibration is not None and self.calibration.estimate.rest_seconds > 0
        )
        noise = "at rest" if rested else "in the quietest motion"
        guess = "measured" if calibrated else "a guess"
        remarks = {
            "sample_rate": "as recorded",
            "imus.mounts": "the page states how well each is known",
            "imus.delays": "measured, relative to the first unit",
            "geometry.axes": "measured; mounts included",
            "noise.noise_std": f"measured {noise}"
            if calibrated
            else "measured, roughly",
            "noise.scale_std": guess,
            "noise.timing_std": guess,
            "noise.bias_walk": "measured",
            "bias.fixed": "in this recording",
            "bias.turn_on_std": "not shown by one recording",
            "accelerometers.noise_std": "measured, but at least the default",
            "accelerometers.scale_std": "measured, but at least 0.2 %",
            "accelerometers.bias": "in this recording, against each other",
            "accelerometers.axes": "measured against each other",
            "accelerometers.positions": "measured, relative to the first unit",
            "health.max_rate": "NOT KNOWN: put in the range of the data sheet",
        }
        if not source_of(self.config).units and not calibrated:
            remarks["geometry.preset"] = "NOT KNOWN: an assumption, put in the axes"
        return remarks

    @property
    def text(self) -> str:
        """The parameter file without its origin."""
        return parameter_file(self.parameters, "", self.remarks)


def set_up(
    bag: Path,
    start: float = 0.0,
    end: float = math.inf,
    reference: str = "",
    proof: Path | None = None,
) -> SetupResult:
    """Make the fullest config that a recording supports.

    ``start``, ``end``: part for mounts and calibration, s from the first message.
    ``reference`` as in `fdi_ros.setup.calibrate.calibrate`. ``proof``: recording for
    the proof, by default a part of this one. `FdiError` if the recording is unreadable
    or has no gyros, or no monitor can be built.
    """
    reports, damage, unread, incomplete = inspect(bag)
    chosen = candidates(reports)
    lacking = needs(reports)
    if not chosen:
        kinds = [shown(one.topic.type or "unknown") for one in reports]
        topics = [
            f"{shown(one.topic.name)} ({kind}, {one.received} messages)"
            for one, kind in zip(reports, kinds, strict=True)
        ]
        words = first_of(topics, 12, "; ") or "none"
        raise BagError(
            f"{bag} has no gyros for a monitor: needs {lacking}; there are: {words}"
        )
    if lacking:
        raise BagError(f"{bag} needs {lacking}; mend the driver")
    parameters: Parameters = {**starting_config(chosen, bag).parameters}
    begun = LearnedSettings(
        parameters=parameters, config=Config.from_parameters(parameters)
    )
    units = source_of(begun.config).units
    reference_channels(begun.config, build_geometry(begun.config), reference)
    block = read_block(bag, begun.config, start, end)
    if (
        units
        and not np.isfinite(block.z).all(axis=1).any()
        and (apart := clocks_apart(chosen, 0.0) or no_common_time(chosen))
    ):
        raise BagError(f"{bag}: {apart}")

    def learn(part: Block) -> tuple[LearnedSettings, LearnedSettings]:
        before = _mounted(part, begun) if units else begun
        return before, _with_mounts(part, before, reference)

    found = _proved(block, bag, start, end, proof, learn)
    return replace(
        found,
        reports=reports,
        damage=damage,
        unread=unread,
        incomplete=incomplete,
        chosen=chosen,
        replayed=_replayed(bag, found.config, start, end),
    )


def _replayed(bag: Path, config: Config, start: float, end: float) -> Baseline | None:
    """Replay the recording with the config that is written, as `fdi replay` will."""
    try:
        block = read_block(bag, config, start, end)
        pipeline = Pipeline.from_config(config)
        if config.has_units and config.accelerometers.enabled == "auto":
            pipeline.sense(felt_units(block))
        return watch_baseline(pipeline, pipeline.arranged(block), start)
    except FdiError:
        # The proof has the reason.
        return None


def recalibrate(
    bag: Path,
    config: Config,
    start: float = 0.0,
    end: float = math.inf,
    reference: str = "",
    proof: Path | None = None,
) -> SetupResult:
    """Calibrate an existing config on a recording (parameters as in `set_up`).

    `FdiError` if the recording is unreadable or lacks a topic, or channels contradict
    each other.
    """
    if copies := copy_words(refuse_unfit(bag, config)):
        raise CalibrationError(
            f"{bag}: {copies}; look at topics and remappings, or leave one out of the config"
        )
    block = read_block(bag, config, start, end)
    names = build_geometry(config).channel_names
    if silent := [
        name
        for name, values in zip(names, block.z.T, strict=True)
        if not np.isfinite(values).any()
    ]:
        words = "none at an instant of the others'; fdi inspect says whether its topic is silent or of another clock"
        raise CalibrationError(
            f"the recording has no value of {', '.join(silent)}: {words}"
        )
    given = LearnedSettings(parameters=dict(config.parameters()), config=config)
    return _proved(
        block,
        bag,
        start,
        end,
        proof,
        lambda part: (given, _calibrated(part, given, reference)),
        True,
    )


#: settings before, and those of a recording
Learn = Callable[[Block], tuple[LearnedSettings, LearnedSettings]]


def _kept_from(block: Block) -> tuple[float, float] | None:
    """Return start and length of the part kept aside, s, or None for a short recording."""
    if len(block) < 2:
        return None
    steps = np.diff(block.stamp) * 1e-9
    longest = INTERVALS.gap * np.median(steps)
    lasts = np.cumsum(np.minimum(steps, longest))
    kept = float(np.clip(PROOF.share * lasts[-1], PROOF.least, PROOF.most))
    if lasts[-1] - kept < LEAST_LEFT:
        return None
    first = np.searchsorted(lasts, lasts[-1] - kept)
    return float(np.cumsum(steps)[first]), kept


def _proved(
    block: Block,
    bag: Path,
    start: float,
    end: float,
    proof: Path | None,
    learn: Learn,
    needed: bool = False,
) -> SetupResult:
    """Prove settings on another recording, or on the last part of this one.

    Then take the settings of the whole recording, or those before. ``needed`` makes a
    missing calibration of the first part an error.
    """
    learned = block
    apart = proof is not None
    source = "the same recording (too short to hold a part back)"
    if proof is not None:
        bag = proof
        start = 0.0
        end = math.inf
        source = shown(proof.name)
    elif (kept := _kept_from(block)) is not None:
        since, seconds = kept
        kept_from = block.stamp[0] + round(since * 1e9)
        learned = block[: int(np.searchsorted(block.stamp, kept_from))]
        start = start + since
        apart = True
        source = f"the last {seconds:.0f} s"
    before, found = learn(learned)
    if needed and found.why is not None:
        raise found.why
    # Reading takes the delays off.
    tried = [
        _tried(read_block(bag, one.config, start, end), one.config, start)
        for one in (before, found)
    ]
    lasts = max(
        (one.baseline.duration for one in tried if one.baseline is not None),
        default=0.0,
    )
    proved = Proof(source, apart, lasts, *tried)
    worse = proved.worse if found.calibration is not None else ""
    if learned is not block:
        whole_before, whole = learn(block)
        if whole.calibration is not None or found.calibration is None:
            before = whole_before
            found = whole
    if worse:
        found = replace(found, parameters=before.parameters, config=before.config)
    return SetupResult(
        **vars(found), kept=worse, mounting=assess(found.config), proof=proved
    )


def _mounted(block: Block, start: LearnedSettings) -> LearnedSettings:
    """Find how units are mounted against each other."""
    mounts = find_mounts(prepare(block, np.array(start.config.health.max_rate)))
    rotations = [
        np.eye(3) if mount.rotation is None else mount.rotation for mount in mounts
    ]
    known = {**start.parameters, "imus.mounts": np.ravel(rotations).tolist()}
    return replace(_if_built(known, start), mounts=mounts)


def _if_built(known: Parameters, before: LearnedSettings) -> LearnedSettings:
    """Return the new settings if a monitor can be built from them, else those before."""
    try:
        new = Config.from_parameters(known)
        Pipeline.from_config(new)
    except FdiError:
        return before
    return replace(before, parameters=known, config=new)


def _with_mounts(
    block: Block, before: LearnedSettings, reference: str
) -> LearnedSettings:
    """Calibrate with the mounts found. Mirrored units are refused."""
    names = before.config.imu_names
    mounts = before.mounts
    if odd := [
        name for name, mount in zip(names, mounts, strict=False) if mount.mirrored
    ]:
        # If most are mirrored against the first unit, the first is mirrored.
        if len(odd) > len(mounts) - 1 - len(odd):
            odd = [names[0]] if len(mounts) > 2 else [f"{names[0]} or {odd[0]}"]
        words = f"{' and '.join(odd)} is mirrored: one axis is reversed (a left turn reads as a right one), or two are"
        words += (
            " swapped; no mount does that: correct its driver, or leave its topic out"
        )
        return replace(before, why=DisagreementError(words))
    lost = [
        k
        for k, mount in enumerate(mounts)
        if mount.rotation is None and not mount.contradicts
    ]
    channels = [3 * k + axis for k in lost for axis in range(3)]
    found = _calibrated(block, before, reference, channels)
    if not lost or found.calibration is not None:
        return found
    # Nothing may be declared because of mounts that nobody knows.
    careful = _if_built(
        {**before.parameters, "noise.scale_std": [UNKNOWN_AXES.mount]}, before
    )
    verb = "is" if len(lost) == 1 else "are"
    who = f"{' and '.join(names[k] for k in lost)} {verb}"
    why = CalibrationError(
        f"the recording does not show how {who} mounted relative to {names[0]}"
    )
    return replace(careful, why=why)


def _calibrated(
    block: Block, before: LearnedSettings, reference: str, unknown: Sequence[int] = ()
) -> LearnedSettings:
    try:
        calibration = calibrate(block, before.config, reference, unknown)
    except FdiError as error:
        return replace(before, why=error)
    # The axes hold the mounts: beside them these would be read, and not be used.
    known = {
        name: value for name, value in before.parameters.items() if name not in REPLACED
    }
    full = _if_built({**known, **calibration.settings}, before)
    if full is before:
        return replace(
            before, why=CalibrationError("no monitor can be built from what it gives")
        )
    return replace(full, calibration=calibration)
