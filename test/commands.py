# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the fixtures `fdi` and `refused` are (conftest.py, which no test imports: it would take a second domain)."""

from collections.abc import Callable
from typing import NamedTuple


class Said(NamedTuple):
    """How a command ended and what it said."""

    code: int
    out: str
    err: str


Run = Callable[..., Said]
Refused = Callable[..., str]
