# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The key for signing: read when it is one and its owner's alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdi_ros.errors import FdiError
from fdi_ros.mavlink.signing import now_in_steps, read_key

KEY = bytes(range(32))


@pytest.mark.parametrize("data", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_is_bytes_or_digits(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    path.chmod(0o600)
    assert read_key(str(path)) == KEY


@pytest.mark.parametrize("data", [b"", b"secret", KEY[:31], KEY.hex().encode()[:-2], bytes(5000)])
def test_what_is_none_is_refused_and_not_shown(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    path.chmod(0o600)
    with pytest.raises(FdiError, match="is no key: expected 32 bytes, or 64 hexadecimal digits") as refused:
        read_key(str(path))
    assert not data or data.decode("latin1") not in str(refused.value)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
def test_a_key_that_others_can_reach_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(mode)
    with pytest.raises(FdiError, match="can be read by others: chmod 600"):
        read_key(str(path))


def test_the_time_of_signatures_counts_from_2015() -> None:
    assert now_in_steps(1_420_070_400) == 0
    assert now_in_steps(1_420_070_401.5) == 150_000
    assert now_in_steps(0) == 0
