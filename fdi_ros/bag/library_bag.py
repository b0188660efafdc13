# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags whose messages a library hands out one by one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np

from fdi_ros.bag.raw import BagFile, Batch, Topic
from fdi_ros.bag.recorder_clock import LEAST_SET_BACK, RecorderClock
from fdi_ros.system.files import RECORDING

#: messages handed on at once, at most
_BATCH_MESSAGES = 4096
#: number of its topic in the file, time of recording, ns, and content
Message = tuple[int, int, bytes]


class LibraryBag(BagFile):
    """An open bag that a library reads."""

    #: by their numbers in the file
    _numbered: dict[int, Topic]

    @abstractmethod
    def _messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of recording, up to the first error.

        If the clock of the recorder was set back, in the order of writing.
        """

    def batches(self, topics: Sequence[str], clock: RecorderClock) -> Iterator[Batch]:
        """Read the messages of the topics."""
        chosen = {
            number: topics.index(one.name)
            for number, one in self._numbered.items()
            if one.name in topics
        }
        whole = sum(self._numbered[number].count for number in chosen)
        read = 0
        found = self._messages(list(chosen)) if chosen else iter(())
        while messages := list(_together(found)):
            read += len(messages)
            numbers, times, data = zip(*messages, strict=True)
            length = np.array([len(one) for one in data])
            topic = np.array([chosen[number] for number in numbers])
            log_time = clock.follow(topic, np.array(times, dtype=np.int64))
            disorder = LEAST_SET_BACK if clock.set_back else 0
            yield Batch(
                buffer=np.frombuffer(b"".join(data), dtype=np.uint8),
                topic=topic,
                log_time=log_time,
                offset=np.cumsum(length) - length,
                length=length,
                horizon=int(log_time[-1]) - disorder,
                progress=min(1.0, read / max(1, whole)),
            )


def _together(messages: Iterator[Message]) -> Iterator[Message]:
    """Take as many messages as are handed on at once."""
    held = 0
    for k, message in enumerate(messages, 1):
        yield message
        held += len(message[2])
        if k == _BATCH_MESSAGES or held >= RECORDING.portion_bytes:
            return
