"""Batches of serialised messages: equal to what the real deserialisers say, message by message."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from bag.recordings import ARRAY, IMU, STORE, array, imu
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.bag.decode import decode_array, decode_imu
from fdi_ros.cdr import MessageError, read_channels, read_imu

numbers = st.floats(width=64)
vectors = st.tuples(numbers, numbers, numbers)
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
frames = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=40)
orders = st.sampled_from("<>")
gaps = st.binary(max_size=9)
imus = st.lists(st.tuples(stamps, vectors, frames, orders, gaps), min_size=1, max_size=12)
labels = st.lists(st.text("abcdef", max_size=9), max_size=4)
arrays = st.lists(st.tuples(st.lists(numbers, max_size=8), labels, orders, gaps), min_size=1, max_size=12)


def packed(messages, gaps):
    """Lay messages into one buffer with gaps before and between them, so that they begin at any offset."""
    data, offset = b"", []
    for message, gap in zip(messages, gaps, strict=True):
        data += gap
        offset.append(len(data))
        data += message
    length = np.array([len(message) for message in messages])
    return np.frombuffer(data, dtype=np.uint8), np.array(offset), length


def same(values, expected):
    """Equal bit for bit, NaN and the sign of zero included."""
    return np.asarray(values, dtype="<f8").tobytes() == np.asarray(expected, dtype="<f8").tobytes()


def judged(read, message):
    """Stamp and values of a message as the live node reads them; None of one it refuses."""
    try:
        return read(message)
    except MessageError:
        return None, None


@settings(max_examples=300)
@given(imus)
def test_imus_equal_what_rosbags_deserialises(drawn):
    messages = [imu(stamp, rate, frame, order) for stamp, rate, frame, order, _ in drawn]
    decoded = decode_imu(*packed(messages, [gap for *_, gap in drawn]))
    assert decoded.good.all()
    for k, message in enumerate(messages):
        true = STORE.deserialize_cdr(message, IMU)
        assert decoded.stamp[k] == true.header.stamp.sec * 10**9 + true.header.stamp.nanosec
        rate = true.angular_velocity
        assert same(decoded.values[k], [rate.x, rate.y, rate.z])


@settings(max_examples=300)
@given(arrays)
def test_arrays_equal_what_rosbags_deserialises(drawn):
    messages = [array(values, labels, order) for values, labels, order, _ in drawn]
    buffer, offset, length = packed(messages, [gap for *_, gap in drawn])
    for channels in {len(values) for values, *_ in drawn} - {0}:
        decoded = decode_array(buffer, offset, length, channels)
        for k, message in enumerate(messages):
            true = STORE.deserialize_cdr(message, ARRAY).data
            assert decoded.good[k] == (len(true) == channels)
            assert not decoded.good[k] or same(decoded.values[k], true)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed (extra: ros)")
@settings(max_examples=60)
@given(imus, arrays)
def test_both_equal_what_rclpy_deserialises(drawn_imus, drawn_arrays):
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Float64MultiArray

    messages = [imu(stamp, rate, frame, order) for stamp, rate, frame, order, _ in drawn_imus]
    decoded = decode_imu(*packed(messages, [gap for *_, gap in drawn_imus]))
    for k, message in enumerate(messages):
        true = deserialize_message(message, Imu)
        assert decoded.stamp[k] == true.header.stamp.sec * 10**9 + true.header.stamp.nanosec
        rate = true.angular_velocity
        assert same(decoded.values[k], [rate.x, rate.y, rate.z])
    messages = [array(values, labels, order) for values, labels, order, _ in drawn_arrays]
    layout = packed(messages, [gap for *_, gap in drawn_arrays])
    for k, message in enumerate(messages):
        true = deserialize_message(message, Float64MultiArray).data
        decoded = decode_array(*layout, max(1, len(true)))
        assert not len(true) or (decoded.good[k] and same(decoded.values[k], true))


@settings(max_examples=300)
@given(
    st.lists(st.tuples(st.one_of(st.binary(max_size=400), st.just(None)), st.integers(0, 400)), min_size=1, max_size=8)
)
def test_any_bytes_are_judged_as_the_live_node_judges_them(drawn):
    whole = (imu(5, (1.0, 2.0, 3.0), "frame"), array([1.0, 2.0, 3.0], ["a", "bc"]))
    for sound, bulk, single in (
        (whole[0], decode_imu, read_imu),
        (whole[1], lambda b, o, k: decode_array(b, o, k, 3), lambda m: (0, read_channels(m, 3))),
    ):
        messages = [sound[:cut] if data is None else data for data, cut in drawn]
        decoded = bulk(*packed(messages, [b""] * len(messages)))
        for k, message in enumerate(messages):
            stamp, values = judged(single, message)
            assert decoded.good[k] == (values is not None)
            assert values is None or (decoded.stamp[k] == stamp and same(decoded.values[k], values))


@settings(max_examples=200)
@given(st.integers(0, 400), st.integers(0, 7), st.booleans())
def test_a_flipped_bit_never_reads_outside_the_message(byte, bit, big):
    sound = imu(5, (1.0, 2.0, 3.0), "frame", "><"[big])
    data = bytearray(sound)
    data[byte % len(data)] ^= 1 << bit
    decoded = decode_imu(*packed([bytes(data)], [b""]))
    if not decoded.good[0]:
        assert same(decoded.values[0], [0, 0, 0])
