"""Tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Lay out rows of words: the first column to the left, the others to the right."""
    lines = [head, *rows]
    width = [max(len(line[k]) for line in lines) for k in range(len(head))]
    return [
        "  ".join([line[0].ljust(width[0]), *(cell.rjust(w) for cell, w in zip(line[1:], width[1:], strict=True))])
        for line in lines
    ]
