# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What several monitors say of the same episodes of one recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fdi_ros.episodes.story import Episode, Story


@dataclass
class Shared:
    """One thing that happened, as each monitor told of it."""

    told: dict[str, Episode] = field(default_factory=dict)
    """By monitor; who is not in it said nothing of it."""

    @property
    def start_s(self) -> float:
        """Of the first declaration by any of them, s from the first message."""
        return min(one.start_s for one in self.told.values())

    def is_about(self, one: Episode) -> bool:
        """Whether an episode of another monitor may be this: the same stretch, and a channel in common."""
        return any(one.stretch == known.stretch and not one.ever.isdisjoint(known.ever) for known in self.told.values())


def shared_episodes(stories: Mapping[str, Story]) -> list[Shared]:
    """Put together what several monitors declared, in the order of time.

    Each episode joins the first thing that happened before it, that is about a channel of its own and of which its
    monitor has not told yet.
    """
    found: list[Shared] = []
    episodes = [(one.start_s, one, name) for name, story in stories.items() for one in story.declared]
    for _, one, name in sorted(episodes, key=lambda entry: entry[0]):
        place = next((shared for shared in found if name not in shared.told and shared.is_about(one)), None)
        if place is None:
            place = Shared()
            found.append(place)
        place.told[name] = one
    return sorted(found, key=lambda shared: shared.start_s)


def brief(one: Episode | None) -> str:
    """Say in a few words what a monitor declared: who, how and when."""
    if one is None:
        return "-"
    who = one.who if one.state == "FAULTY" else one.who.removesuffix(",")
    return f"{who} {one.state} {one.since_s:.3f} s"
