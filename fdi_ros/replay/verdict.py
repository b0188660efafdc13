# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a replay: one word, and a sentence for the person who flies.

`verdict_of` decides. `fdi replay`, its page, `fdi fleet` and Python repeat its result.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from fdi_ros.core.states import Reason
from fdi_ros.monitor.soundness import (
    REPORTED,
    WHOLE,
    Concern,
    Trouble,
    Word,
    advice_on,
    why_unchecked,
    word_of,
)
from fdi_ros.replay.episodes import (
    EPISODE_TIMES,
    HALVES,
    ROOM,
    Episode,
    Size,
    course_word,
    is_factor,
    is_too_small,
    shows_nothing,
    true_quantity,
    unit_for,
    warming_words,
)
from fdi_ros.replay.summary import Judgement, ReplayVerdict
from fdi_ros.report.layout import RADIANS, Unit
from fdi_ros.system.text import figures, first_of, listed, percent

_OF_TIME = (Trouble.CLOCK, Trouble.STAMPS)
"""Kinds of concerns about times. Wrong times make other figures wrong."""
SILENT_TO_END = 1.0
#: noise, in ``noise.noise_std``, that the settings do not foresee: channels that are within
#: their settings differ by less
UNFORESEEN = 3.0
"""Time to the end for which a channel must be silent or unchecked to be reported, s. A channel with a later
value delivers to the end."""


def verdict_of(judgement: Judgement, unit: Unit = RADIANS) -> ReplayVerdict:
    """Return the verdict on a judged stream, with rates in the given unit."""
    if judgement.scores.faults:
        return _verdict_on_faults(judgement)
    faulty = faulty_episodes(judgement)
    explained = noise_throughout(judgement)
    if faulty and not explained:
        names = dict.fromkeys(name for one in faulty for name in one.channels)
        return ReplayVerdict(
            Word.FAULTY.value,
            f"FAULTY: {_faulty_sentences(judgement, faulty, unit)}",
            tuple(names),
        )
    if why := unjudged_words(judgement):
        clocks = "".join(f" {one.sentence}" for one in set_clocks(judgement))
        sentence = f"CANNOT TELL: {why}.{clocks} What to do: {_to_judge(judgement)}."
        return ReplayVerdict(Word.CANNOT_TELL.value, sentence, ())
    concerns = judgement.concerns
    word = word_of(concerns)
    deciding = [one for one in concerns if one.word is word or one.trouble in _OF_TIME]
    names = dict.fromkeys(name for one in deciding for name in one.who)
    if word is Word.HEALTHY:
        sentence = _healthy_words(judgement)
    else:
        listed_ones = first_of(list(map(str, deciding)), REPORTED.concerns, "; ")
        found = "lasted" if explained else "was found"
        time = _recorded_words(judgement)
        sentence = f"no fault {found} in {time}, but {listed_ones}."
        if explained:
            sentence += f" {_doubted_words(faulty)}"
        sentence += f" What to do: {advice_on(deciding)}"
    return ReplayVerdict(word.value, f"{word.value}: {sentence}.", tuple(names))


def faulty_episodes(judgement: Judgement) -> list[Episode]:
    """Return the episodes that make a recording FAULTY, those that last to its end first.

    These are the declarations, isolated channels before sets, and units that are silent
    to the end.
    """
    declared = sorted(
        judgement.story.declared,
        key=lambda one: (not one.stands, one.state != "FAULTY", one.start_s),
    )
    silent = [
        one
        for one in judgement.story.episodes
        if one.stands
        and one.duration_s >= SILENT_TO_END
        and one.evidence.reason == Reason.NO_DATA.value
        and not one.declares
    ]
    return [*declared, *silent]


def silent_units(judgement: Judgement) -> dict[str, float]:
    """Return the units that the verdict calls silent to the end, and since when, s."""
    since = {
        name: one.start_s
        for one in faulty_episodes(judgement)
        if not one.declares
        for name in one.channels
    }
    return {
        one.unit: since[one.name]
        for one in judgement.monitor.channels
        if one.unit and one.name in since
    }


def unjudged_words(judgement: Judgement) -> str:
    """Return why the recording as a whole was not judged. Empty: it was judged."""
    scores = judgement.scores
    bias = judgement.monitor.bias
    if scores.samples_judged == 0:
        words = f"none of {scores.samples} samples was judged"
        if bias.state == "learning" and not _badly_stamped(judgement):
            return f"{words}, because the biases were still being learned"
        if _badly_stamped(judgement):
            return words
        return f"{words} (start-up bias: {bias.state})"
    share = scores.samples_judged / scores.samples
    if share < WHOLE.judged:
        return f"only {percent(share)} of {scores.samples} samples were judged"
    if bias.far:
        # The largest one stands for all: they may be many.
        worst = max(bias.far_biases, key=lambda one: one.size / one.limit)
        began = f"{listed(bias.far)} began with"
        if len(bias.far) > 1:
            began += f" biases of up to {figures(worst.size, 2)} {worst.unit}"
        else:
            began += f" a bias of {figures(worst.size, 2)} {worst.unit}"
        return (
            f"{began}, and {figures(worst.limit, 2)} {worst.unit} is the most for a healthy sensor:"
            " perhaps a fault from before the recording"
        )
    return ""


def _to_judge(judgement: Judgement) -> str:
    """Return what to do about a recording that was not judged as a whole."""
    bias = judgement.monitor.bias
    if stamped := _badly_stamped(judgement):
        return Trouble.STAMPS.advice(sorted(stamped))
    if bias.far:
        return f"check {listed(bias.far)}, or raise turn_on_std in a config if such a bias is usual"
    if bias.state == "learning":
        return "record for longer, with some seconds of rest at the start"
    frozen = [
        one.name
        for one in judgement.monitor.channels
        if one.reason == Reason.FROZEN.value
    ]
    if frozen:
        return Trouble.REPEATS.advice(frozen)
    trouble, cause = why_unchecked(judgement.monitor.channels)
    return trouble.advice(cause)


def wrongly_named(judgement: Judgement) -> list[str]:
    """Return the channels that were declared alone without an injected fault."""
    faulty = dict.fromkeys(
        one.channel for one in judgement.scores.declared if one.state == "FAULTY"
    )
    return [name for name in faulty if name not in judgement.scores.struck]


def _verdict_on_faults(judgement: Judgement) -> ReplayVerdict:
    """Return the verdict on injected faults."""
    faults = judgement.scores.faults
    isolated = judgement.scores.isolated
    detected = sum(fault.detected_at_s is not None for fault in faults)
    plural = "fault" if len(faults) == 1 else "faults"
    unexplained = [one for one in judgement.story.declared if not one.injected]
    if wrongly_named(judgement) or unexplained:
        word = "FALSE ALARM"
    else:
        word = "FOUND" if isolated == len(faults) else "NOT ALL FOUND"
    names = dict.fromkeys(name for fault in faults for name in fault.declared_channels)
    score = (
        f"{detected} of {len(faults)} injected {plural} detected, {isolated} isolated."
    )
    if unexplained:
        first = unexplained[0]
        score = f"DECLARED BUT NOT INJECTED: {_who(first)} {_when(first)}. {score}"
    return ReplayVerdict(word, score, tuple(names))


def _recorded_words(judgement: Judgement) -> str:
    """Return how long the recording is without its long gaps, such as 40.0 s."""
    gaps = judgement.story.gaps
    between = sum(end - begin for begin, end in gaps)
    words = f"{judgement.scores.duration_s - between:.1f} s"
    if gaps:
        words += f" (in {len(gaps) + 1} parts, with {between:.1f} s between them)"
    return words


def _healthy_words(judgement: Judgement) -> str:
    channels = judgement.monitor.channels
    checked = min((one.checked for one in channels), default=1.0)
    share = (
        "all checked"
        if checked > 0.995
        else f"each checked in {percent(checked)} of the samples or more"
    )
    end = [
        one.name
        for one in judgement.unchecked_channels
        if one.since_s is not None
        and judgement.scores.end_s - one.since_s >= SILENT_TO_END
    ]
    more = f"; not checked at the end: {listed(end)}" if end else ""
    until = ", where the recording is cut off" if judgement.is_cut_off else ""
    return (
        f"no fault was found in {_recorded_words(judgement)}{until};"
        f" {len(channels)} channels, {share}{more}"
    )


# A fault in one sentence for the person who flies


def _faulty_sentences(
    judgement: Judgement, faulty: Sequence[Episode], unit: Unit
) -> str:
    """Return sentences on the first episode, and the names in the others."""
    first = faulty[0]
    if frozen := _frozen_sensors(judgement, first):
        sentences = [
            f"{frozen}, {_when(first)}.",
            f"Reason: {Reason.FROZEN.value}.",
        ]
    else:
        sentences = [
            f"{_who(first)} {_when(first)}.",
            *_size_sentences(first, unit),
            *_reason_sentences(first, _badly_stamped(judgement)),
        ]
    if first.since_s - first.start_s >= EPISODE_TIMES.least_before:
        sentences.append(f"First seen at {first.start_s:.1f} s.")
    lasting = _without_brief_sets(faulty)
    heat = [words for one in lasting if (words := warming_words(one, unit))]
    sentences += heat[: REPORTED.concerns]
    others = dict.fromkeys(one.who for one in lasting[1:])
    others.pop(first.who, None)
    if others:
        sentences.append(f"Also {_other_names(list(others))}.")
    sentences += [one.sentence for one in set_clocks(judgement)]
    noise = [f"{one}." for one in noise_behind(judgement)[: REPORTED.concerns]]
    if not noise and first.noisy_from_s is not None:
        begins = f"From {first.noisy_from_s:.1f} s on"
        noise = [f"{begins} the whole unit is noisy, as a loose one is."]
    sentences += noise
    if frozen and judgement.monitor.note:
        sentences.append(f"At the end, {judgement.monitor.note}.")
    return " ".join([*sentences, _advice(judgement, lasting)])


def _other_names(others: Sequence[str]) -> str:
    """Join names of channels and sets. Names of sets have commas of their own."""
    if len(others) == 2:
        return listed(others)
    has_commas = any("," in one for one in others)
    return first_of(others, ROOM.episodes, "; " if has_commas else ", ")


def _without_brief_sets(faulty: Sequence[Episode]) -> Sequence[Episode]:
    """Return the episodes without sets that ended within `EPISODE_TIMES.brief`, unless they are all like that.

    A brief set confirms no channel. Beside a declaration that lasts, it asks for nothing.
    """
    lasting = [
        one
        for one in faulty
        if one.state != "AMBIGUOUS"
        or one.stands
        or one.end_s - one.since_s >= EPISODE_TIMES.brief
    ]
    return lasting or faulty


def _advice(judgement: Judgement, faulty: Sequence[Episode]) -> str:
    """Return what to do before the next flight about all faults."""
    unit_of = {one.name: one.unit or one.name for one in judgement.monitor.channels}
    noisy = {
        unit_of[name]
        for one in noise_behind(judgement)
        for name in one.who
        if name in unit_of
    }
    named: dict[str, None] = {}
    doubted: list[list[str]] = []
    for one in faulty:
        owners = [unit_of.get(name, name) for name in one.channels]
        units = list(dict.fromkeys(owners))
        if one.state == "AMBIGUOUS" and len(units) > 1:
            # Noise or wrong stamps of a unit in the set explain it.
            explained = _badly_stamped(judgement) | noisy
            named |= {name: None for name in units if name in explained}
            doubted.append(units)
        else:
            named |= dict.fromkeys(units)
    # A set with a unit that is checked in any case asks for nothing more.
    others = [units for units in doubted if named.keys().isdisjoint(units)]
    if named:
        are = "is" if len(named) == 1 else "are"
        is_loose = _shakes(judgement, named) or any(
            one.noisy_from_s is not None for one in faulty
        )
        stamped = named.keys() & _badly_stamped(judgement)
        work = "checked for a loose mounting" if is_loose else "checked"
        work = "checked, first the stamps of its driver," if stamped else work
        units = [name for name in dict.fromkeys(unit_of.values()) if name in named]
        steps = [f"{listed(units)} {are} {work} or replaced"]
    else:
        steps = []
    if others:
        all_of_them = dict.fromkeys(name for units in others for name in units)
        steps.append(
            f"{listed(list(all_of_them))} are compared at rest and in turns: at least one is faulty"
        )
    return f"Do not fly before {', and '.join(steps)}."


def _shakes(judgement: Judgement, units: Collection[str]) -> bool:
    """Whether noise explains all declarations, and is of one of some units."""
    noisy = {
        name
        for one in noise_behind(judgement)
        if one.trouble is Trouble.NOISE
        for name in one.who
    }
    return any(
        one.name in noisy and (one.unit or one.name) in units
        for one in judgement.monitor.channels
    )


def set_clocks(judgement: Judgement) -> list[Concern]:
    """Return the concerns about clocks and stamps. Every verdict lists them."""
    return [one for one in judgement.concerns if one.trouble in _OF_TIME]


def _badly_stamped(judgement: Judgement) -> set[str]:
    """Return the units whose stamps are wrong."""
    return {
        name
        for one in judgement.concerns
        if one.trouble is Trouble.STAMPS
        for name in one.who
    }


def noise_behind(judgement: Judgement) -> list[Concern]:
    """Return the noise that explains declarations, if these are brief sets alone."""
    faulty = faulty_episodes(judgement)
    if not faulty or not judgement.has_only_brief_sets:
        return []
    if not all(one.declares for one in faulty):
        return []
    kinds = (Trouble.NOISE, Trouble.DELAY)
    return [one for one in judgement.concerns if one.trouble in kinds]


def noise_throughout(judgement: Judgement) -> list[Concern]:
    """Return the noise of units from the start on that explains all declarations.

    Noise of one unit that is larger than that of the others all the time, as of another
    model, brings brief sets about that unit and channels beside it. Noise that began
    during the recording is a change, and the sets are its first sign. Noise that the settings
    foresee explains no set, and neither does noise explain sets that come again, or one that
    ends without a channel of that unit.
    """
    noise = noise_behind(judgement)
    changed = {
        one.name
        for one in judgement.monitor.channels
        if one.noisy_s >= REPORTED.noisy_s
    }
    lasting = [one for one in noise if changed.isdisjoint(one.who)]
    who = {name for one in lasting for name in one.who}
    names = {
        one.name
        for one in judgement.monitor.channels
        if {one.name, one.unit} & who and (one.noise or 0.0) >= UNFORESEEN
    }
    are_explained = all(
        one.sets == 1 and not one.stands and not names.isdisjoint(one.channels)
        for one in faulty_episodes(judgement)
    )
    return lasting if are_explained else []


def _doubted_words(sets: Sequence[Episode]) -> str:
    """Return a sentence on brief sets that noise explains."""
    first = sets[0]
    rest = len(sets) - 1
    more = f" ({rest} more like this)" if rest else ""
    return (
        f"A fault of {first.who.removesuffix(',')} was suspected {_when(first)}{more}:"
        " such noise causes that."
    )


def _frozen_sensors(judgement: Judgement, one: Episode) -> str:
    """Return the unit of a set, and which of its sensors are frozen at the end if the set is of these.

    Empty: they are not all frozen.
    """
    units = {
        channel.unit
        for channel in judgement.monitor.channels
        if channel.name in one.channels
    }
    if one.state != "AMBIGUOUS" or len(units) != 1 or "" in units:
        return ""
    (unit,) = units
    by_half: dict[str, list[bool]] = {}
    for channel in judgement.monitor.channels:
        if channel.unit == unit:
            is_frozen = channel.reason == Reason.FROZEN.value
            by_half.setdefault(channel.measured_in, []).append(is_frozen)
    shown = {half.measured_in for half in one.halves or (one,)}
    if not all(all(by_half[half]) for half in shown):
        return ""
    if all(map(all, by_half.values())):
        return f"{unit}, all axes"
    return f"{unit}, {' and '.join(f'all {HALVES[half]}' for half in HALVES if half in shown)}"


_WITHOUT_SIZE = tuple(
    reason.value
    for reason in (
        Reason.NON_FINITE,
        Reason.STUCK,
        Reason.FROZEN,
        Reason.INTERMITTENT,
    )
)
"""Reasons that say all: the size of the error changes with the motion, or there is none."""


def _who(one: Episode) -> str:
    """Return the channels as spoken: ``imu_0, x and y,``."""
    if one.halves:
        return one.who
    if one.evidence.reason == Reason.OLD.value and len(one.channels) > 1:
        return f"{one.channels[0].rpartition('.')[0]}, all axes,"
    parts = [name.rpartition(".") for name in one.channels]
    units = {unit for unit, _, _ in parts}
    is_loose = one.sets > 1 or one.noisy_from_s is not None
    if is_loose and len(units) == 1 and "" not in units:
        return parts[0][0]
    if one.state == "AMBIGUOUS":
        return _one_of(one) if len(parts) > 1 else f"{one.who} (not confirmed)"
    is_alone = len(parts) == 1
    in_one_unit = len(units) == 1 and "" not in units
    if one.state != "FAULTY" or is_alone or not in_one_unit:
        return one.who.removesuffix(",")
    unit = parts[0][0]
    if one.who == unit:
        return f"{unit}, all axes,"
    return f"{unit}, {listed([axis for _, _, axis in parts])},"


def _one_of(one: Episode) -> str:
    """Return the set as candidates: ``one axis of imu_0 (x, y or z: undecided)``."""
    parts = [name.rpartition(".") for name in one.channels]
    units = {unit for unit, _, _ in parts}
    if len(units) == 1 and "" not in units:
        axes = listed([axis for _, _, axis in parts], "or")
        return f"one axis of {parts[0][0]} ({axes}: undecided)"
    return f"{one.who.removesuffix(',')} (undecided)"


def _when(one: Episode) -> str:
    since = f"from {one.since_s:.1f} s"
    lasted = one.end_s - one.since_s
    if not one.stands:
        brief = f", for {1000 * lasted:.0f} ms" if lasted < EPISODE_TIMES.brief else ""
        end = one.end_s if one.wrong_to_s is None else one.wrong_to_s
        since += brief or f" to {end:.1f} s"
    if one.state == "STALE":
        return f"gives no data {since}"
    return since


def _size_sentences(one: Episode, unit: Unit) -> list[str]:
    """Return a sentence on the size of the error."""
    unit = unit_for(one, unit)
    if one.apart is not None:
        return [f"They are {_size(one.apart.size, unit)} {unit.name} apart."]
    if one.state != "FAULTY" or one.evidence.reason.startswith(_WITHOUT_SIZE):
        return []
    sizes = {
        each.channel.rpartition(".")[2] if len(one.channels) > 1 else "": each.size
        for each in one.candidates
        if each.size is not None
    }
    if not sizes:
        return []
    courses = {size.course for size in sizes.values()}
    if courses == {"growing"} or courses == {"shrinking"}:
        verb = "grows" if courses == {"growing"} else "shrinks"
        begins = {_size(size, unit) for size in sizes.values()}
        if len(begins) == 1 and all(map(_is_plain, sizes.values())):
            ends = listed(
                [
                    f"{_rate(size.last_rad_s, size.std_rad_s, unit)}{f' ({axis})' if axis else ''}"
                    for axis, size in sizes.items()
                ]
            )
            return [f"Its error {verb} from {begins.pop()} to {ends} {unit.name}."]
    by_axis = {axis: _size_words(size, unit) for axis, size in sizes.items()}
    (common, *others) = dict.fromkeys(by_axis.values())
    if common and not others and len(by_axis) > 1:
        return [f"Each axis {common}."]
    measured = {axis: words for axis, words in by_axis.items() if words}
    words = [f"{axis} {how}".strip() for axis, how in measured.items()]
    if not words:
        return ["Its error is too small to measure."]
    if len(words) == 1:
        return [f"It {words[0]}."]
    return [f"Its error: {'; '.join(words)}."]


def _size_words(size: Size, unit: Unit) -> str:
    """Describe an error, as it continues ``It``. Empty: too small to measure."""
    value = _size(size, unit)
    if size.course == "proportional":
        return _proportional_words(size, unit)
    if size.course == "noisy":
        return f"has noise of {value} {unit.name}"
    if size.course == "varying":
        return f"is off by a varying {value} {unit.name} rms"
    if is_too_small(size):
        return ""
    if size.course == "gone":
        return f"was off by {value} {unit.name} until {size.gone_s:.1f} s"
    if size.course in ("growing", "shrinking") and not _is_plain(size):
        first = _signed(size.rad_s, size.std_rad_s, unit)
        last = _signed(size.last_rad_s, size.std_rad_s, unit)
        return f"is off by {first}, changing to {last} {unit.name}"
    if size.course in ("growing", "shrinking"):
        last = _rate(size.last_rad_s, size.std_rad_s, unit)
        return f"is off by {value}, {size.course} to {last} {unit.name}"
    return f"is off by {value} {unit.name}"


def _proportional_words(size: Size, unit: Unit) -> str:
    """Describe an error that is a share of the rate, as it continues ``It``."""
    share = size.share_of_rate or 0.0
    of = true_quantity(unit)
    if size.gone_s is None and shows_nothing(share):
        return f"does not follow the true {of}"
    if size.gone_s is None:
        return f"reads {_share_words(share, unit)}"
    if shows_nothing(share):
        return f"did not follow the true {of} until {size.gone_s:.1f} s"
    return f"read {_share_words(share, unit)} until {size.gone_s:.1f} s"


def _share_words(share: float, unit: Unit) -> str:
    """Describe a scale error: ``5 % too much``, or ``8.0 times the true rate``."""
    if is_factor(share):
        return f"{figures(1.0 + share, 2)} times the true {true_quantity(unit)}"
    return f"{figures(100.0 * abs(share), 2)} % too {'little' if share < 0 else 'much'}"


def _reason_sentences(one: Episode, badly_stamped: Collection[str]) -> list[str]:
    """Return a sentence on the reason, unless the reason is a mere disagreement.

    ``badly_stamped``: units whose stamps are wrong.
    """
    if recurring := [half for half in one.halves or (one,) if half.sets > 1]:
        sets = max(half.sets for half in recurring)
        units = {name.rpartition(".")[0] for name in one.channels}
        if not units.isdisjoint(badly_stamped):
            return [f"It came and went {sets} times, as errors by wrong stamps do."]
        return [f"It came and went {sets} times, as the error of a loose unit does."]
    reason = one.evidence.reason
    common = (Reason.DISAGREES.value, Reason.DRIFTED.value, Reason.NO_DATA.value)
    if reason == Reason.OLD.value:
        return [f"Reason: {reason}."]
    if one.state != "FAULTY" or not reason or reason.startswith(common):
        return []
    return [f"Reason: {reason}."]


def _size(size: Size, unit: Unit) -> str:
    return _rate(size.rad_s, size.std_rad_s, unit)


def _is_plain(size: Size) -> bool:
    """Whether an error keeps its sign, and its size grows if its course does."""
    return course_word(size) == size.course


def _signed(value: float, std: float, unit: Unit) -> str:
    return f"{'-' if value < 0.0 else '+'}{_rate(value, std, unit)}"


def _rate(value: float, std: float, unit: Unit) -> str:
    """Format a rate with the digits that its standard error allows, at most three."""
    size = abs(value) * unit.factor
    error = std * unit.factor
    figures = 2 - math.floor(math.log10(size)) if size > 0.0 else 0
    if error > 0.0 and math.isfinite(error):
        figures = min(figures, -math.floor(math.log10(error)))
    return f"{size:.{min(max(figures, 0), 6)}f}"
