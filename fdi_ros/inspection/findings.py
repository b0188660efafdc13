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

    #: what the finding is for in a report
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
    #: what to do about it, without a full stop, or empty
    advice: str = ""

    @property
    def line(self) -> str:
        """The words, and what to do."""
        if not self.advice:
            return self.words
        return f"{self.words.removesuffix('.')}. What to do: {self.advice}"


LOOK = "USABLE, BUT LOOK"
BESIDE_LOOKS = (
    "NO BETTER THAN BEFORE",
    "USABLE, NOT CALIBRATED",
    "USABLE FOR LARGE FAULTS ONLY",
)
"""Headlines that a channel or unit worth a look may explain."""
HEADLINES = {  # of verdicts, the first that is there decides
    "NEEDS": Severity.BAD,
    "NEEDS A LOOK": Severity.BAD,
    "DO NOT USE": Severity.BAD,
    "NO BETTER THAN BEFORE": Severity.UNKNOWN,
    "USABLE, NOT CALIBRATED": Severity.UNKNOWN,
    "USABLE FOR LARGE FAULTS ONLY": Severity.UNKNOWN,
    LOOK: Severity.UNKNOWN,
    "READY, BUT LOOK": Severity.UNKNOWN,
    "USABLE": Severity.GOOD,
    "READY": Severity.GOOD,
}


def lines_of(findings: Iterable[Finding], role: Role) -> list[str]:
    """Return the lines of one kind."""
    return [shown(one.line, LINE) for one in findings if one.role is role]


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict: the first of `HEADLINES` in use, with all its findings."""
    by_headline: dict[str, list[Finding]] = {}
    for one in findings:
        by_headline.setdefault(one.headline, []).append(one)
    headline = next(headline for headline in HEADLINES if headline in by_headline)
    deciding = by_headline[headline]
    between = " " if headline == "NEEDS" else ": "
    words = f"{headline}{between}{'; '.join(one.words for one in deciding)}"
    if headline in BESIDE_LOOKS and LOOK in by_headline:
        looks = by_headline[LOOK]
        words = (
            f"{words.removesuffix('.')}. Also: {'; '.join(one.words for one in looks)}"
        )
        # They may be the cause, so they come first.
        deciding = looks
    if advice := dict.fromkeys(one.advice for one in deciding if one.advice):
        words = f"{words.removesuffix('.')}. What to do: {'; '.join(advice)}"
    return Verdict(HEADLINES[headline], words)


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
