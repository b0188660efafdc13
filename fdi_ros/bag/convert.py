# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Any recording as a rosbag2 folder with one MCAP file of its gyro topics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fdi_ros import __version__
from fdi_ros.bag.raw import OWN
from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import is_topic
from fdi_ros.errors import BagError
from fdi_ros.sources import SOURCES, source_of_type


def convert(recording: Recording, path: Path, progress: Callable[[float], None]) -> dict[str, int]:
    """Write the messages of a recording that may be of gyros, byte for byte, with their times of recording.

    Parameters
    ----------
    recording
        Open recording.
    path
        Folder to be made; it must not exist.
    progress
        Is told the share done, 0 to 1.

    Returns
    -------
    Messages written of each topic.

    Raises
    ------
    BagError
        If the recording has no such topic.
    """
    topics = [
        topic
        for topic in recording.topics
        if source_of_type(topic.type) is not None and topic.encoding == "cdr" and is_topic(topic.name)
    ]
    if not topics:
        types = " or ".join(kind.type for kind in SOURCES.values())
        raise BagError(f"{recording.path} has no topic of {types}")
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    # By this it may be replaced later: what anything else has recorded never is.
    writer.set_custom_data(OWN, __version__)
    with writer:
        connections = [writer.add_connection(topic.name, topic.type, typestore=store) for topic in topics]
        counts = [0] * len(topics)
        for batch in recording.batches([topic.name for topic in topics]):
            for k, (topic, log_time) in enumerate(zip(batch.topic.tolist(), batch.log_time.tolist(), strict=True)):
                writer.write(connections[topic], log_time, batch.message(k))
                counts[topic] += 1
            progress(batch.progress)
    return {topic.name: count for topic, count in zip(topics, counts, strict=True)}
