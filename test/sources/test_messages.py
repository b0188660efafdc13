# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bytes of messages: equal to what ROS and rosbags read and write, and never believed beyond their end."""

from __future__ import annotations

import contextlib
import struct
from functools import partial

import numpy as np
import pytest
from bag.recordings import ARRAY, IMU, STORE
from bag.recordings import array as array_bytes
from bag.recordings import imu as imu_bytes
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.core.messages import (
    ChannelsTemplate,
    ImuTemplate,
    MessageError,
    as_batch,
)
from fdi_ros.core.sources import ChannelsSource, ImuSource

finite = st.floats(allow_nan=False)
vectors = st.tuples(finite, finite, finite)
stamps = st.integers(0, 2**31 * 10**9 - 1)
frames = st.text(
    st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=40
)
orders = st.sampled_from("<>")
gaps = st.binary(max_size=9)
numbers = st.floats(width=64)
imus = st.lists(
    st.tuples(stamps, st.tuples(numbers, numbers, numbers), frames, orders, gaps),
    min_size=1,
    max_size=12,
)
labelled = st.lists(st.text("abcdef", max_size=9), max_size=4)
arrays = st.lists(
    st.tuples(st.lists(numbers, max_size=8), labelled, orders, gaps),
    min_size=1,
    max_size=12,
)
triangles = st.lists(finite, min_size=6, max_size=6)

parse_imu, decode_imu = (
    partial(ImuSource.parse, count=3),
    partial(ImuSource.decode, count=3),
)
patch_imu, patch_channels = ImuSource.patch, ChannelsSource.patch
decode_array, array_count = ChannelsSource.decode, ChannelsSource.announced


def parse_channels(data, count) -> tuple[float, ...]:
    return ChannelsSource.parse(data, count)[1]


def packed(messages, gaps=None):
    """Lay messages into one buffer with gaps before and between them, so that they begin at any offset."""
    data, offset = b"", []
    for message, gap in zip(messages, gaps or [b""] * len(messages), strict=True):
        data += gap
        offset.append(len(data))
        data += message
    length = np.array([len(message) for message in messages])
    return np.frombuffer(data, dtype=np.uint8), np.array(offset), length


def same(values, expected) -> bool:
    """Equal bit for bit, NaN and the sign of zero included."""
    return (
        np.asarray(values, dtype="<f8").tobytes()
        == np.asarray(expected, dtype="<f8").tobytes()
    )


def full(triangle) -> list[float]:
    """The nine elements of a symmetric matrix, by rows."""
    xx, xy, xz, yy, yz, zz = triangle
    return [xx, xy, xz, xy, yy, yz, xz, yz, zz]


def overwritten(data, at, form, *values) -> bytes:
    data = bytearray(data)
    struct.pack_into(form, data, at, *values)
    return bytes(data)


def refusal(read, data) -> str:
    with pytest.raises(MessageError) as raised:
        read(data)
    assert "\n" not in str(raised.value)
    return str(raised.value)


class TestOneMessage:
    """Read, patched and refused from Python."""

    @given(
        stamps,
        vectors,
        st.lists(finite, min_size=3, max_size=12),
        st.lists(frames, min_size=1, max_size=3),
        orders,
    )
    def test_patched_messages_differ_in_the_values_alone(
        self, stamp, rate, values, names, order
    ) -> None:
        imus = [imu_bytes(stamp, one, names[0], order) for one in (rate, values[:3])]
        arrays = [array_bytes(one, names, order) for one in (values, values[::-1])]
        assert patch_imu(imus[0], values[:3]) == imus[1]
        assert patch_channels(arrays[0], values[::-1]) == arrays[1]

    @given(st.binary(max_size=400))
    def test_any_bytes_are_patched_in_place_or_refused(self, data) -> None:
        for patch, values in (
            (patch_imu, (1.0, 2.0, 3.0)),
            (patch_channels, [1.0] * 6),
        ):
            with contextlib.suppress(MessageError):
                assert len(patch(data, values)) == len(data)

    def test_what_is_wrong_is_told_in_one_line_with_its_figures_and_never_followed(
        self,
    ) -> None:
        imu, array = imu_bytes(1, (1.0, 2.0, 3.0)), array_bytes([1.0] * 6)
        read_5, read_6 = (
            partial(parse_channels, count=5),
            partial(parse_channels, count=6),
        )
        patch_1 = partial(patch_channels, values=[1.0])
        for read, data, words in (
            (parse_imu, b"", "0 bytes with encapsulation none are no plain CDR"),
            (
                parse_imu,
                b"\0\2\0\0" + imu[4:],
                f"{len(imu)} bytes with encapsulation 0002 are no plain CDR",
            ),
            (parse_imu, imu[:9], "9 bytes are too few for an Imu"),
            (
                parse_imu,
                imu[:99],
                "99 bytes are too few for an Imu whose frame_id has 4 bytes",
            ),
            (
                parse_imu,
                overwritten(imu, 12, "<I", 2**32 - 1),
                "an Imu whose frame_id has 4294967295 bytes",
            ),
            (read_6, array[:9], "9 bytes are too few for the array they announce"),
            (
                read_6,
                overwritten(array_bytes([1.0] * 6, ["a"]), 20, "<I", 8),
                "the strides of the array leave gaps between its values, expected none",
            ),
            (read_6, array[:60], "60 bytes are too few for 6 values (little endian)"),
            (read_6, overwritten(array, 4, "<I", 2**32 - 1), "4294967295 dimensions"),
            (
                read_6,
                array_bytes([0.0] * 1_000_000),
                "array has 1000000 values, expected 6",
            ),
            (read_5, array, "array has 6 values, expected 5"),
            (patch_1, array, "array has 6 values, expected 1"),
        ):
            assert words in refusal(read, data)

    @pytest.mark.parametrize("order", "<>")
    @pytest.mark.parametrize(
        ("sec", "nanosec"), [(-1, 0), (-(2**31), 5), (0, 10**9), (2**31 - 1, 2**32 - 1)]
    )
    def test_a_stamp_that_is_no_time_is_refused(self, sec, nanosec, order) -> None:
        data = overwritten(
            imu_bytes(0, (1.0, 2.0, 3.0), order=order), 4, order + "iI", sec, nanosec
        )
        assert f"{sec} s and {nanosec} ns" in refusal(parse_imu, data)


class TestManyMessages:
    """Read from one buffer, as they lie in a recording."""

    @settings(max_examples=60)
    @given(drawn=imus)
    def test_imus_equal_what_others_deserialise(self, drawn) -> None:
        messages = [
            imu_bytes(stamp, rate, frame, order)
            for stamp, rate, frame, order, _ in drawn
        ]
        decoded = decode_imu(*packed(messages, [gap for *_, gap in drawn]))
        assert decoded.good.all()
        for k, message in enumerate(messages):
            true = STORE.deserialize_cdr(message, IMU)
            assert (
                decoded.stamp[k]
                == true.header.stamp.sec * 10**9 + true.header.stamp.nanosec
            )
            rate = true.angular_velocity
            assert same(decoded.values[k], [rate.x, rate.y, rate.z])

    @settings(max_examples=60)
    @given(drawn=arrays)
    def test_arrays_equal_what_others_deserialise(self, drawn) -> None:
        messages = [
            array_bytes(values, labels, order) for values, labels, order, _ in drawn
        ]
        buffer, offset, length = packed(messages, [gap for *_, gap in drawn])
        assert array_count(buffer, offset, length) == len(drawn[0][0])
        for channels in {len(values) for values, *_ in drawn} - {0}:
            decoded = decode_array(buffer, offset, length, channels)
            for k, message in enumerate(messages):
                true = STORE.deserialize_cdr(message, ARRAY).data
                assert decoded.good[k] == (len(true) == channels)
                assert not decoded.good[k] or same(decoded.values[k], true)

    @settings(max_examples=60)
    @given(
        st.lists(
            st.tuples(st.binary(max_size=400) | st.none(), st.integers(0, 400)),
            min_size=1,
            max_size=8,
        )
    )
    def test_what_is_malformed_leaves_zeros_and_the_others_as_they_are(
        self, drawn
    ) -> None:
        imu, array = (
            imu_bytes(5, (1.0, 2.0, 3.0), "frame"),
            array_bytes([1.0, 2.0, 3.0], ["a", "bc"]),
        )
        for sound, bulk, single in (
            (imu, decode_imu, parse_imu),
            (
                array,
                lambda b, o, k: decode_array(b, o, k, 3),
                lambda m: (0, parse_channels(m, 3)),
            ),
        ):
            messages = [sound[:cut] if data is None else data for data, cut in drawn]
            decoded = bulk(*packed(messages))
            for k, message in enumerate(messages):
                good, stamp, values = True, 0, (0.0, 0.0, 0.0)
                try:
                    stamp, values = single(message)
                except MessageError:
                    good = False
                # Half a message is refused, too.
                assert good <= (drawn[k][0] is not None or len(message) == len(sound))
                assert (decoded.good[k], decoded.stamp[k]) == (good, stamp)
                assert same(decoded.values[k], values)

    @settings(max_examples=80)
    @given(st.integers(0, 400), st.integers(0, 7), orders)
    def test_a_flipped_bit_never_reads_outside_the_message(
        self, byte, bit, order
    ) -> None:
        data = bytearray(imu_bytes(5, (1.0, 2.0, 3.0), "frame", order))
        data[byte % len(data)] ^= 1 << bit
        # What lies around the message are numbers of which none may be read.
        around = struct.pack("<8d", *[7.77] * 8)
        decoded = decode_imu(*packed([b"", bytes(data), b""], [around, around, around]))
        assert 7.77 not in decoded.values
        if not decoded.good[1]:
            assert same(decoded.values[1], [0, 0, 0])

    @given(st.integers(0, 6), st.sampled_from("<>"))
    def test_values_begin_at_the_offset_that_the_layout_gives(
        self, padding, order
    ) -> None:
        values = [9.0] * padding + [1.0, 2.0, 3.0, 4.0]
        array = overwritten(array_bytes(values, (), order), 8, f"{order}I", padding)
        assert array_count(*as_batch(array)) == 4
        assert parse_channels(array, 4) == (1.0, 2.0, 3.0, 4.0)

    @given(orders)
    def test_an_imu_that_measures_no_rate_says_so_and_is_not_read(self, order) -> None:
        imu = imu_bytes(5, (1.0, 2.0, 3.0), "frame", order)
        at = len(imu) - 8 * (9 + 3 + 9)
        for first, measures in ((-1.0, False), (0.0, True), (1e-6, True)):
            one = overwritten(imu, at, f"{order}d", first)
            decoded = decode_imu(*as_batch(one))
            assert decoded.good[0] == measures
            assert same(decoded.values[0], [1.0, 2.0, 3.0] if measures else [0] * 3)
        with pytest.raises(
            MessageError, match=r"measures no angular rate \(REP-145\)$"
        ):
            parse_imu(overwritten(imu, at, f"{order}d", -1.0))

    def test_the_first_readable_array_says_how_many_values(self) -> None:
        assert (
            array_count(
                *packed(
                    [b"", array_bytes([1.0] * 7, ["a"], ">")[:-30], array_bytes([1.0])]
                )
            )
            == 7
        )
        assert array_count(*packed([b"", b"\0\1"])) == 0


@given(
    st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1),
    vectors,
    triangles,
    frames,
    st.lists(finite, min_size=1),
)
def test_what_is_written_equals_what_others_deserialise(
    stamp, rate, triangle, frame, values
) -> None:
    """From templates, filled in compiled code; stamps before 1970 as ROS has them."""
    true = STORE.deserialize_cdr(
        ImuTemplate(frame).fill(stamp, rate, full(triangle)), IMU
    )
    assert (true.header.stamp.sec, true.header.stamp.nanosec) == divmod(stamp, 10**9)
    assert true.header.frame_id == frame
    assert same(
        [true.angular_velocity.x, true.angular_velocity.y, true.angular_velocity.z],
        rate,
    )
    assert same(true.angular_velocity_covariance, full(triangle))
    # No orientation, no acceleration.
    assert (
        true.orientation_covariance[0] == true.linear_acceleration_covariance[0] == -1.0
    )
    assert same(
        STORE.deserialize_cdr(ChannelsTemplate(len(values)).fill(values), ARRAY).data,
        values,
    )
