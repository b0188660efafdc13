# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Findings: all that inspection and set-up found, as rows of one table.

The verdict, the lines for people and the figures in JSON are made from these rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import Enum
from typing import NamedTuple

from fdi_ros.report.layout import Severity, Verdict
from fdi_ros.system.text import LINE, shown


class Role(str, Enum):
    """Kind of a finding; the value names its list in JSON."""

    #: basis of the settings
    FOUND = "found"
    #: not shown by the recording, with the assumption made and the remedy
    UNKNOWN = "not_found"
    #: to be checked before the settings are trusted
    WARNING = "warnings"
    #: usefulness, the verdict if nothing is wrong
    WORTH = "worth"


class Finding(NamedTuple):
    """One thing that was found."""

    role: Role
    #: the quantity or the trouble, in a word or two
    what: str
    #: complete sentence
    words: str
    #: channels, units or topics concerned, empty for all
    who: Sequence[str] = ()
    #: value of the quantity in SI units, the worst of several channels
    value: float | None = None
    #: standard error of the value
    error: float | None = None
    #: that the value keeps or breaks
    bound: float | None = None
    #: first words of a verdict that this finding decides, one of `HEADLINES`, or empty
    headline: str = ""


HEADLINES = {  # of verdicts, the first that is there decides
    "NEEDS": Severity.BAD,
    "NEEDS A LOOK": Severity.BAD,
    "DO NOT USE": Severity.BAD,
    "NO BETTER THAN BEFORE": Severity.UNKNOWN,
    "USABLE, NOT CALIBRATED": Severity.UNKNOWN,
    "USABLE FOR LARGE FAULTS ONLY": Severity.UNKNOWN,
    "USABLE, BUT LOOK": Severity.UNKNOWN,
    "READY, BUT LOOK": Severity.UNKNOWN,
    "USABLE": Severity.GOOD,
    "READY": Severity.GOOD,
}


def lines_of(findings: Iterable[Finding], role: Role) -> list[str]:
    """Return the lines of one kind."""
    return [shown(one.words, LINE) for one in findings if one.role is role]


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict: the first of `HEADLINES` in use, with all its findings."""
    words: dict[str, list[str]] = {}
    for one in findings:
        words.setdefault(one.headline, []).append(one.words)
    headline = next(headline for headline in HEADLINES if headline in words)
    between = " " if headline == "NEEDS" else ": "
    return Verdict(
        HEADLINES[headline], f"{headline}{between}{'; '.join(words[headline])}"
    )


def findings_figures(findings: Sequence[Finding]) -> dict[str, object]:
    """Return verdict, lines and table, for programs."""
    first = verdict_of(findings)
    return {
        "verdict": {"severity": first.severity.value, "words": first.words},
        **{
            role.value: lines_of(findings, role)
            for role in Role
            if role is not Role.WORTH
        },
        "findings": [one._asdict() for one in findings],
    }
