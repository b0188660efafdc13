# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The first line of a result: what came out, and how bad that is, as a word, a colour and an exit code."""

from __future__ import annotations

import os
from enum import Enum
from typing import NamedTuple, TextIO


class Severity(Enum):
    """How bad a verdict is; the value is its class on a page."""

    GOOD = "good"  # nothing to do
    UNKNOWN = "unknown"  # the data do not tell, or not enough
    BAD = "bad"  # somebody must act

    @property
    def exit_code(self) -> int:
        """Of a verb that ends with such a verdict; 1 is an unmet ``--check``, 2 a request that is wrong."""
        return {Severity.GOOD: 0, Severity.UNKNOWN: 4, Severity.BAD: 3}[self]

    @property
    def ansi(self) -> str:
        """Colour on a terminal."""
        return {Severity.GOOD: "32", Severity.UNKNOWN: "33", Severity.BAD: "31"}[self]


class Verdict(NamedTuple):
    """One line, and how bad it is."""

    severity: Severity
    words: str  # begins with the word of the verdict in capitals: ``HEALTHY: ...``


def with_first_line_coloured(text: str, severity: Severity, stream: TextIO) -> str:
    """Return a text whose first line has the colour of its severity, where the stream is a terminal that wants it."""
    if not stream.isatty() or os.environ.get("NO_COLOR"):
        return text
    first, end, rest = text.partition("\n")
    return f"\x1b[1;{severity.ansi}m{first}\x1b[0m{end}{rest}"
