# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Since when an IMU agrees.

docs/failover.md, "Words": an IMU *agrees* with another IMU if the difference of the raw rates is
below the limit of *off* on every axis. After a fault or a doubt, both must also agree in a turn.

"When an IMU goes back": rule 3 has these turns (`failover.turns`), rule 4 the smaller limit of an
IMU that was bad, rule 5 what is asked of an IMU that the monitor doubts: the difference must
scatter by less than 0.1 rad/s. "IMUs that fail alike" has agreement that proves nothing.
"""

from __future__ import annotations

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.alike import hides
from fdi_ros.mavlink.failover.apart import BREAK_NS
from fdi_ros.mavlink.failover.records import Present, Track
from fdi_ros.mavlink.failover.turns import note_shown
from fdi_ros.mavlink.failover.wrong import WITHOUT_SCALE


def note_agreement(present: Present, unit: int) -> int | None:
    """Note whether an IMU agrees, and return since when that counts, ns, or None."""
    track = present.tracks[unit]
    is_out = unit in present.out
    agreeing = agreeing_partners(present, unit)
    differing = contradicted(present, unit) if is_out else set()
    if agreeing:
        track.agreed_at = present.now
    if present.now - track.agreed_at > BREAK_NS:
        track.agreed_since = track.turned_since = None
        track.shown.clear()
    elif differing:
        # This IMU, or the other one, is wrong: a turn about these axes is needed once the
        # two agree.
        track.wrong = dict.fromkeys(differing, WITHOUT_SCALE) | track.wrong
        track.shown -= differing
        _hold_back(track, present.elapsed)
    elif is_out and hides(present, unit):
        _hold_back(track, present.elapsed)
    elif agreeing:
        track.agreed_since = track.agreed_since or present.now
        # A mean that is no steady error yet may be the begin or end of a turn.
        calm = [k for k in agreeing if agrees(present, unit, k, doubted=True)]
        if any(note_shown(present, unit, k) for k in calm):
            track.turned_since = track.turned_since or present.now
    return _counts_since(present, unit)


def _hold_back(track: Track, elapsed: int) -> None:
    """Let the time since the last look, ns, not count as agreement in turns."""
    if track.turned_since is not None:
        track.turned_since += elapsed


def _counts_since(present: Present, unit: int) -> int | None:
    """Return since when the agreement of an IMU counts, ns, or None.

    That of an IMU that is doubted or out counts from a turn on. In a flight in which the
    IMU was out, every axis that was bad must have agreed in a turn.
    """
    track = present.tracks[unit]
    if unit in present.taken and track.waits:
        return None
    needs_turn = track.doubts or unit in present.out
    return track.turned_since if needs_turn else track.agreed_since


def agreeing_partners(present: Present, unit: int) -> list[int]:
    """Return the IMUs that count with which an IMU agrees.

    The 5 % of the rate are not added for an IMU that was bad: in a fast turn they would
    hide its error.
    """
    track = present.tracks[unit]
    was_bad = unit in present.out or bool(track.wrong)
    fit = [
        k
        for k in track.partners.common
        if not was_bad or max(present.pairs[unit, k].full) < present.min_size
    ]
    doubted = bool(track.doubts)
    return [k for k in fit if agrees(present, unit, k, doubted)]


def agrees(present: Present, unit: int, other: int, doubted: bool) -> bool:
    """Return whether an IMU agrees with another one that is sound.

    doubted: by the monitor. Then the difference must be calm.
    """
    if present.raw.is_stuck(unit) or present.raw.is_stuck(other):
        return False
    track = present.tracks[other]
    is_sound = track.is_ok or max(track.nearest) < present.min_size
    pair = present.pairs[unit, other]
    sizes = pair.bound if doubted else pair.apart
    return is_sound and max(sizes) < present.min_size


def contradicted(present: Present, unit: int) -> set[int]:
    """Return the axes on which an IMU differs from one that counts and is not FAULTY.

    Two IMUs that fail alike agree with each other, but not with the third.
    """
    return {
        axis
        for k in present.tracks[unit].partners.common
        if ChannelState.FAULTY not in present.tracks[k].states
        for axis, size in enumerate(present.pairs[unit, k].apart)
        if size >= present.min_size
    }
