# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which messages of a flight log are read, and if none is: what the log has, and the setting that helps."""

from __future__ import annotations

from pathlib import Path

from fdi_ros.bag.log_parts import LogFormat, Source
from fdi_ros.bag.log_survey import FEWEST, Survey, Track, copies_of
from fdi_ros.bag.raw import Damage
from fdi_ros.errors import BagError
from fdi_ros.text import shown

SETTINGS = 'docs/flight_logs.md, "Settings of the logger"'
MESSAGES = 'docs/flight_logs.md, "messages read"'
_MOST_NAMES = 6
"""Messages that are named of a log without IMUs."""


def choose(path: Path, form: LogFormat, survey: Survey, damage: Damage) -> list[Source]:
    """Return the sources to read: of the kind of message with the most usable ones, else the most samples.

    A sensor may be logged in several kinds of messages, and must not be its own witness.

    Parameters
    ----------
    path
        Of the log, for messages.
    form
        Its format.
    survey
        What a first walk found in it.
    damage
        Takes what is left out.

    Raises
    ------
    BagError
        If there is no IMU that is logged fast enough.
    """
    tracks = _sensors(path.name, form, survey, damage)

    def merit(kind: str) -> tuple[int, int]:
        usable = [track for source, track in tracks.items() if source.kind == kind and track.usable]
        return len(usable), sum(track.count for track in usable)

    kind = max(form.kinds, key=merit)
    if not merit(kind)[0]:
        raise BagError(f"{path} {_refusal(form, survey, tracks)}")
    for source, track in tracks.items():
        if source.kind == kind and not track.usable:
            few = f"has too few samples to judge its rate ({track.count})"
            slow = f"is logged {track.figures}, expected at least {form.slowest:g} Hz"
            damage.add(
                f"{path.name}: {kind} {source.instance} {few if track.count < FEWEST else slow}, and was left out"
            )
    return sorted(source for source, track in tracks.items() if source.kind == kind and track.usable)


def _sensors(name: str, form: LogFormat, survey: Survey, damage: Damage) -> dict[Source, Track]:
    """Return the sources that are sensors of their own."""
    tracks = {source: track for source, track in survey.tracks.items() if source.kind in form.kinds and track.count}
    there = {source.instance for source in tracks if source.kind == form.counted_by}
    sensors = {source: track for source, track in tracks.items() if not there or source.instance in there}
    for copy, source in ({} if there else copies_of(sensors, survey.shared)).items():
        del sensors[copy]
        damage.add(
            f"{name}: {copy.kind} {copy.instance} has the times of {source.kind} {source.instance}: taken for the same"
            f" sensor behind its filters, and left out (without {form.counted_by} the log does not say how many sensors"
            " there are)"
        )
    return sensors


def _refusal(form: LogFormat, survey: Survey, tracks: dict[Source, Track]) -> str:
    """Say what a log has in place of IMUs that can be read, and which line of the documentation applies."""
    kinds = {kind: [track for source, track in tracks.items() if source.kind == kind] for kind in form.kinds}
    there = [_logged(kind, own) for kind, own in kinds.items() if own]
    unread = [f"{name}, which is not read ({why})" for name, why in sorted(survey.unread.items())]
    alone = [track for source, track in survey.tracks.items() if source.kind == form.selected and track.count]
    if alone:
        there.append(f"{form.selected} of the one selected IMU {alone[0].figures}")
    if unread and not there:
        return f"has of IMUs only {', '.join(unread)}: {MESSAGES}"
    setting = f"{form.settings(survey.vehicle)} ({SETTINGS})"
    if not there:
        most = ", ".join(f"{count} {shown(name, 32)}" for name, count in survey.counts.most_common(_MOST_NAMES))
        return f"has no {' or '.join(form.kinds)}, it has {most or 'no records'}: {setting}"
    has = f"has {', '.join((*there, *unread))}"
    if any(track.fast_enough for track in tracks.values()):
        return f"{has}; needed: {FEWEST} samples of an IMU or more ({SETTINGS})"
    return f"{has}; needed: each IMU by itself at {form.slowest:g} Hz or more: {setting}"


def _logged(kind: str, tracks: list[Track]) -> str:
    """Say how a kind of message is logged."""
    fastest = max(tracks, key=lambda track: (track.count >= FEWEST, track.rate))
    few = f", {fastest.count} samples" if 1 < fastest.count < FEWEST else ""
    return f"{kind} of {len(tracks)} IMU{'s' * (len(tracks) > 1)} {fastest.figures}{few}"
