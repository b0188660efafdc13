# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics that a monitor could read: which are its own outputs, and which input a config lacks."""

from __future__ import annotations

from collections.abc import Iterable

from fdi_ros.core.sources import SOURCES, Source, input_of
from fdi_ros.monitor.diagnostics import DIAGNOSTICS
from fdi_ros.monitor.output import OUTPUTS
from fdi_ros.system.text import first_of, shown

#: topics that a hint lists at most
MOST_LISTED = 8
_OF_A_MONITOR = {
    topic.name.rpartition("/")[2]
    for topic in (*(output.topic for output in OUTPUTS), DIAGNOSTICS)
}


def is_of_a_monitor(topic: str) -> bool:
    """Whether a topic has the name of an output of a monitor: the fused rate is no witness."""
    return topic.rpartition("/")[2] in _OF_A_MONITOR


def other_input(type_name: str, topics: Iterable[tuple[str, str]]) -> str:
    """Return the input that a config needs to read gyros of another type than it asks for.

    Parameters
    ----------
    type_name
        Type of the messages that the config asks for.
    topics
        Name and type of each topic in the recording, or on the network.

    Returns
    -------
    str
        Words with the settings to change. Empty if no other input fits the topics.
    """
    there = [(name, kind) for name, kind in topics if not is_of_a_monitor(name)]
    is_there = any(kind == type_name for _, kind in there)
    for kind in SOURCES.values():
        names = [name for name, of in there if of == kind.type]
        # Any array may hold something else than gyros.
        fits = kind.stamped or not is_there
        enough = len(names) >= kind.topic_counts.start
        if kind.type != type_name and fits and enough:
            return _settings_for(kind, [shown(name) for name in names])
    return ""


def _settings_for(kind: type[Source], names: list[str]) -> str:
    """Return the topics of an input, and the settings with which a monitor reads them, in words."""
    least, most = kind.topic_counts.start, kind.topic_counts.stop - 1
    listed = first_of(names, MOST_LISTED)
    there = f"topics of type {kind.type}"
    first = f"`input: {input_of(kind)}`"
    if not kind.stamped:
        return f"{there}: if {listed} has the gyros, set {first} and `channels.topic`"
    if len(names) <= most:
        return f"{there}: to read them, set {first} and `imus.topics: [{listed}]`"
    return f"{there}: set {first}, and `imus.topics` to {least} to {most} of {listed}"
