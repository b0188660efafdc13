# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""State of the input topics for the diagnostics of an output bag: once per second of the recording."""

from __future__ import annotations

from fdi_ros.bag.samples import Newest, Samples
from fdi_ros.config.config import Config
from fdi_ros.monitor.diagnostics import InputStatus
from fdi_ros.sources import source_of


class InputWatch:
    """Describes the inputs of a recording by the clock of the recorder.

    Parameters
    ----------
    config
        Settings.
    """

    def __init__(self, config: Config) -> None:
        self._source = source_of(config)
        self._before: list[tuple[Newest, dict[str, int]]] = [(Newest(), {}) for _ in config.topics]

    def statuses(self, samples: Samples) -> list[InputStatus]:
        """Describe each topic after the messages read so far."""
        now = max(topic.log_time for topic in samples.newest)
        return [self._status(k, samples, now) for k in range(len(samples.topics))]

    def _status(self, k: int, samples: Samples, now: int) -> InputStatus:
        source, newest, topic = self._source, samples.newest[k], samples.topics[k]
        counts = {"malformed": samples.malformed[topic]}
        if source.stamped:
            counts |= samples.alignment.counters[k]
            del counts["received"]
        before, counted = self._before[k]
        self._before[k] = newest, counts
        silent = (now - newest.log_time) * 1e-9 if newest.received else None
        spent = (newest.log_time - before.log_time) * 1e-9
        return InputStatus(
            name=source.names[k],
            topic=topic,
            received=newest.received,
            rate=(newest.received - before.received) / spent if before.received and spent > 0 else 0.0,
            silent=silent,
            live=silent is not None
            and silent <= source.timeout
            and (not source.stamped or samples.alignment.is_live(k)),
            lag=samples.alignment.lag[k] * 1e-9 if source.stamped else 0.0,
            max_lag=source.max_lag,
            offset=(newest.log_time - newest.stamp) * 1e-9 if source.stamped and newest.received else None,
            counts=counts,
            recent={kind: count - counted.get(kind, 0) for kind, count in counts.items()},
        )
