# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The output bag, read back by mcap, by rosbags and by rclpy: what the pipeline said, bit for bit."""

from collections import defaultdict
from dataclasses import astuple

import numpy as np
import pytest
from bag.recordings import ARRAY, IMU, STORE
from mcap.reader import make_reader
from replay.summaries import Keep
from rosbags.highlevel import AnyReader

from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import parse_fault
from fdi_ros.monitor.output import ChannelState
from fdi_ros.replay.outputs import OutputBag
from fdi_ros.replay.run import replay

NAMES = {
    "/fused": IMU,
    "/fdi_node/integrity": ARRAY,
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


@pytest.fixture(scope="module")
def written(tmp_path_factory, root, flight):
    """The bundled flight with a fault, and what the pipeline said of it."""
    path = tmp_path_factory.mktemp("written") / "out"
    config = Config.from_file(root / "config" / "two_imus.yaml")
    request = (
        flight,
        config,
        (parse_fault("channel=imu_1.y kind=bias size=0.2 start=20"),),
    )
    keep = Keep()
    with OutputBag(path, config) as bag:
        summary = replay(*request, sinks=[bag, keep])
    output = keep.output
    integrity = np.column_stack(
        [
            *(output.statistic, output.threshold, output.state, output.level),
            *np.divmod(output.stamp, 10**9),
        ]
    )
    return path, output, integrity, summary, request


def read_by(path, rosbags):
    """Topic to (log time, bytes), and topic to its schema, read by the mcap library or by rosbags."""
    messages, schemas = defaultdict(list), {}
    if rosbags:
        with AnyReader([path]) as reader:
            for connection, log_time, data in reader.messages():
                messages[connection.topic].append((log_time, bytes(data)))
                schemas[connection.topic] = connection.digest
        return messages, schemas
    with next(path.glob("*.mcap")).open("rb") as file:
        for schema, channel, message in make_reader(
            file, validate_crcs=True
        ).iter_messages():
            messages[channel.topic].append((message.log_time, message.data))
            schemas[channel.topic] = (
                schema.name,
                schema.encoding,
                schema.data.decode(),
                channel.message_encoding,
            )
    return messages, schemas


def test_mcap_and_rosbags_read_back_what_the_pipeline_said(written):
    """So does rclpy: these are the bytes of its own serialiser, test/sources/test_messages.py."""
    path, output, integrity, _, (bag, config, _) = written
    messages = read_by(path, False)[0]
    assert read_by(path, True)[0] == messages
    rows = np.flatnonzero(output.valid)
    for k, (_, data) in zip(rows, messages["/fused"], strict=True):
        message = STORE.deserialize_cdr(data, IMU)
        stamp, rate = message.header.stamp, message.angular_velocity
        assert stamp.sec * 10**9 + stamp.nanosec == output.stamp[k]
        assert (rate.x, rate.y, rate.z) == tuple(output.rate[k])
        np.testing.assert_array_equal(
            message.angular_velocity_covariance, output.covariance[k].ravel()
        )
        assert (
            message.orientation_covariance[0]
            == message.linear_acceleration_covariance[0]
            == -1
        )
        assert message.header.frame_id == "base_link"
    told = [
        STORE.deserialize_cdr(data, ARRAY)
        for _, data in messages["/fdi_node/integrity"]
    ]
    np.testing.assert_array_equal([message.data for message in told], integrity)
    (dimension,) = told[0].layout.dim
    labels = dimension.label.split(",")
    assert len(labels) == dimension.size == dimension.stride == integrity.shape[1]
    assert labels[:3] == ["statistic", "threshold", "state imu_1.x"]
    assert labels[-2:] == ["stamp [s]", "stamp [ns]"]
    with Recording(bag) as recording:
        originals = defaultdict(list)
        for batch in recording.batches(config.topics):
            for k in range(len(batch)):
                topic = f"/{config.topics[batch.topic[k]].lstrip('/')}"
                originals[topic].append((int(batch.log_time[k]), batch.message(k)))
    assert {topic: messages[topic] for topic in originals} == originals


def test_diagnostics_come_once_a_second_and_at_once_on_every_change(written):
    path, output, _, summary, _ = written
    messages = read_by(path, True)[0]["/diagnostics"]
    changes = {event.stamp for event in output.events}
    assert len(messages) == pytest.approx(60 + len(changes), abs=2)
    times = np.array([time for time, _ in messages])
    for change in changes:
        assert np.abs(times - change).min() < 5_000_000
    detected = summary.scores.faults[0].detected_at_s
    (at,) = [
        event.stamp for event in output.events if event.after == ChannelState.FAULTY
    ]
    first = next(
        data for time, data in messages if time >= at and time - at < 5_000_000
    )
    status = {
        s.name: s for s in STORE.deserialize_cdr(first, NAMES["/diagnostics"]).status
    }
    assert status["fdi_node: imu_1.y"].level == 2
    assert "isolated and left out" in status["fdi_node: imu_1.y"].message
    assert detected == pytest.approx(20.03, abs=0.02)
    last = {
        s.name: s
        for s in STORE.deserialize_cdr(messages[-1][1], NAMES["/diagnostics"]).status
    }
    inputs = [s for name, s in last.items() if name.startswith("fdi_node: input")]
    assert [{kv.key: kv.value for kv in s.values}["received"] for s in inputs] == [
        "6001",
        "6001",
    ]


def test_schemas_and_type_hashes_are_those_of_jazzy(written):
    schemas, digests = (read_by(written[0], rosbags)[1] for rosbags in (False, True))
    for topic, name in NAMES.items():
        definition, _ = STORE.generate_msgdef(name, ros_version=2)
        assert schemas[topic] == (name, "ros2msg", definition, "cdr")
        assert digests[topic] == STORE.hash_rihs01(name)
    # As `ros2 topic info --verbose` shows them on Jazzy.
    assert (
        digests["/fused"]
        == "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
    )


def test_the_output_is_a_recording_that_replays_to_the_same(written):
    path, _, _, summary, request = written
    again = replay(path, *request[1:])
    assert again.scores.events == summary.scores.events
    effects = (astuple(one.scores.fault_effect_rad_s) for one in (again, summary))
    assert next(effects) == pytest.approx(next(effects), rel=1e-9)
