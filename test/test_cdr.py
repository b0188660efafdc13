"""Bytes of messages: equal to what ROS reads and writes, and never believed beyond their end."""

from __future__ import annotations

import contextlib
import importlib.util
import struct
import timeit

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros import cdr
from fdi_ros.errors import FdiError

finite = st.floats(allow_nan=False)
vectors = st.tuples(finite, finite, finite)
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
frames = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=40)


def imu_bytes(stamp, rate, frame="imu", order="<", orientation=0.5) -> bytes:
    """An Imu written by hand, field by field, from the specification of CDR."""
    name = frame.encode() + b"\0"
    out = struct.pack(order + "iII", *divmod(stamp, 10**9), len(name)) + name
    out += bytes(-len(out) % 8)
    out += struct.pack(order + "13d", *[orientation] * 13)
    out += struct.pack(order + "3d", *rate) + struct.pack(order + "21d", *range(21))
    return bytes([0, order == "<", 0, 0]) + out


def array_bytes(values, labels=(), order="<") -> bytes:
    out = struct.pack(order + "I", len(labels))
    for label in labels:
        name = label.encode() + b"\0"
        out += bytes(-len(out) % 4) + struct.pack(order + "I", len(name)) + name
        out += bytes(-len(out) % 4) + struct.pack(order + "II", 7, 7)
    out += struct.pack(order + "II", 0, len(values))
    out += bytes(-len(out) % 8) + struct.pack(f"{order}{len(values)}d", *values)
    return bytes([0, order == "<", 0, 0]) + out


@given(stamps, vectors, frames, st.sampled_from("<>"))
def test_imu_is_read_from_either_byte_order_and_any_frame(stamp, rate, frame, order) -> None:
    assert cdr.read_imu(imu_bytes(stamp, rate, frame, order)) == (stamp, rate)


@given(st.lists(finite, min_size=1, max_size=12), st.lists(frames, max_size=3), st.sampled_from("<>"))
def test_channels_are_read_from_either_byte_order_and_any_layout(values, labels, order) -> None:
    assert cdr.read_channels(array_bytes(values, labels, order), len(values)) == tuple(values)


@given(stamps, vectors, vectors, frames, st.sampled_from("<>"))
def test_patched_imu_differs_in_the_rate_alone(stamp, rate, other, frame, order) -> None:
    assert cdr.patch_imu(imu_bytes(stamp, rate, frame, order), other) == imu_bytes(stamp, other, frame, order)


@given(st.lists(finite, min_size=1, max_size=12), st.lists(frames, max_size=3), st.sampled_from("<>"))
def test_patched_channels_differ_in_the_values_alone(values, labels, order) -> None:
    other = [v + 1.0 for v in values]
    assert cdr.patch_channels(array_bytes(values, labels, order), other) == array_bytes(other, labels, order)


@given(st.binary(max_size=400))
def test_any_bytes_are_read_or_refused_as_a_known_error(data) -> None:
    for read in (cdr.read_imu, lambda d: cdr.read_channels(d, 6)):
        with contextlib.suppress(FdiError):
            assert len(read(data)) > 1


@settings(max_examples=30)
@given(st.integers(0, 400), st.sampled_from("<>"))
def test_half_a_message_is_refused(cut, order) -> None:
    for whole, read in (
        (imu_bytes(1, (1.0, 2.0, 3.0), order=order), cdr.read_imu),
        (array_bytes([1.0] * 6, order=order), lambda d: cdr.read_channels(d, 6)),
    ):
        with pytest.raises(cdr.MessageError):
            read(whole[: min(cut, len(whole) - 1)])


def test_absurd_lengths_are_refused_without_being_followed() -> None:
    imu = bytearray(imu_bytes(1, (1.0, 2.0, 3.0)))
    struct.pack_into("<I", imu, 12, 2**32 - 1)
    with pytest.raises(cdr.MessageError, match="frame_id has 4294967295"):
        cdr.read_imu(bytes(imu))
    array = bytearray(array_bytes([1.0] * 6))
    struct.pack_into("<I", array, 4, 2**32 - 1)
    with pytest.raises(cdr.MessageError, match="4294967295 dimensions"):
        cdr.read_channels(bytes(array), 6)
    million = array_bytes(np.zeros(1_000_000))
    with pytest.raises(cdr.MessageError, match="1000000 values, expected 6"):
        cdr.read_channels(million, 6)


def test_a_frame_id_of_a_megabyte_costs_nothing() -> None:
    data = imu_bytes(5, (1.0, 2.0, 3.0), "x" * 1_000_000)
    assert cdr.read_imu(data) == (5, (1.0, 2.0, 3.0))
    assert timeit.timeit(lambda: cdr.read_imu(data), number=1000) < 0.02


def test_reading_an_imu_takes_about_a_microsecond() -> None:
    data = imu_bytes(5, (1.0, 2.0, 3.0))
    best = min(timeit.repeat(lambda: cdr.read_imu(data), number=2000, repeat=10)) / 2000
    assert best < 5e-6  # 0.8 us measured on an idle core


@given(stamps, vectors, st.lists(finite, min_size=9, max_size=9), frames)
def test_filled_imu_reads_back(stamp, rate, covariance, frame) -> None:
    data = cdr.ImuTemplate(frame).fill(stamp, rate, covariance)
    assert cdr.read_imu(data) == (stamp, rate)


def unpadded(data: bytes, start: int) -> bytes:
    """The bytes with those between start and the next multiple of 8 as zeros: ROS leaves in them what was there."""
    end = start + -(start - 4) % 8
    return data[:start] + bytes(end - start) + data[end:]


ros = pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="ROS 2 is not installed")


@ros
class TestAgainstRos:
    """The same bytes as rclpy's own serialiser."""

    @settings(max_examples=60, deadline=None)
    @given(stamps, vectors, st.lists(finite, min_size=9, max_size=9), frames)
    def test_filled_imu(self, stamp, rate, covariance, frame) -> None:
        from rclpy.serialization import deserialize_message, serialize_message
        from sensor_msgs.msg import Imu

        message = Imu()
        message.header.frame_id = frame
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        velocity = message.angular_velocity
        velocity.x, velocity.y, velocity.z = rate
        message.angular_velocity_covariance = covariance
        message.orientation_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
        data = cdr.ImuTemplate(frame).fill(stamp, rate, covariance)
        assert data == unpadded(serialize_message(message), 17 + len(frame.encode()))
        assert deserialize_message(data, Imu) == message

    @settings(max_examples=60, deadline=None)
    @given(st.lists(finite, min_size=1, max_size=14))
    def test_filled_channels(self, values) -> None:
        from rclpy.serialization import serialize_message
        from std_msgs.msg import Float64MultiArray

        data = serialize_message(Float64MultiArray(data=values))
        assert cdr.ChannelsTemplate(len(values)).fill(values) == unpadded(data, 16)
        assert cdr.read_channels(data, len(values)) == tuple(values)

    @settings(max_examples=60, deadline=None)
    @given(st.lists(finite, min_size=1, max_size=14), st.lists(frames, max_size=3))
    def test_channels_with_a_layout(self, values, labels) -> None:
        from rclpy.serialization import serialize_message
        from std_msgs.msg import Float64MultiArray, MultiArrayDimension

        message = Float64MultiArray(data=values)
        message.layout.dim = [MultiArrayDimension(label=label, size=7, stride=7) for label in labels]
        assert cdr.read_channels(serialize_message(message), len(values)) == tuple(values)

    @settings(max_examples=60, deadline=None)
    @given(stamps, vectors, frames)
    def test_imu_with_everything_set(self, stamp, rate, frame) -> None:
        from rclpy.serialization import deserialize_message, serialize_message
        from sensor_msgs.msg import Imu

        data = imu_bytes(stamp, rate, frame)
        message = deserialize_message(data, Imu)
        assert unpadded(serialize_message(message), 17 + len(frame.encode())) == data
        velocity = message.angular_velocity
        assert cdr.read_imu(data)[1] == (velocity.x, velocity.y, velocity.z)
