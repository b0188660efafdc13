# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Blocks of a study that are done, kept beside its result so that a stopped study can go on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from fdi_ros.errors import StudyError
from fdi_ros.experiments.protocol import Block
from fdi_ros.scoring.tally import Tally


class Checkpoint:
    """Blocks done, kept in ``<result>.partial`` line by line; without a path, in memory alone.

    Parameters
    ----------
    path
        Of the result.
    identity
        All that the result depends on but the number of trials; blocks of another study are not taken over.
    decode
        Makes the tally of a block from its JSON.
    """

    def __init__(self, path: Path | None, identity: str, decode: Callable[[Block, Any], Tally]) -> None:
        self.blocks: dict[Block, Tally] = {}
        self._path = None if path is None else path.with_name(path.name + ".partial")
        self._file: IO[str] | None = None
        if self._path is None:
            return
        try:
            kept = _read(self._path, identity, decode)
            # Written anew, whole lines only: a study that was killed may have left half a one.
            self._file = self._path.open("w", encoding="utf-8")
            self._write({"study": identity})
            for block, tally in kept:
                self.add(block, tally)
        except OSError as error:
            raise StudyError(f"cannot keep the blocks done in {self._path}: {error.strerror}") from error

    def add(self, block: Block, tally: Tally) -> None:
        """Keep one block."""
        self.blocks[block] = tally
        self._write({"block": list(block), "tally": tally})

    def close(self, finished: bool) -> None:
        """End; what is finished is no longer needed."""
        if self._file is not None and self._path is not None:
            self._file.close()
            if finished:
                self._path.unlink(missing_ok=True)

    def _write(self, entry: dict[str, object]) -> None:
        if self._file is not None:
            # A number that is not finite stays what it is: Python reads back what it writes.
            self._file.write(json.dumps(entry, default=asdict) + "\n")
            self._file.flush()


def _read(path: Path, identity: str, decode: Callable[[Block, Any], Tally]) -> list[tuple[Block, Tally]]:
    """Blocks of the same study in a file; none if there is no such file, or it is of another study."""
    if not path.exists():
        return []
    # The last line, if it was not finished, has no end.
    whole = path.read_text(encoding="utf-8").rpartition("\n")[0]
    try:
        entries = [json.loads(line) for line in whole.splitlines()]
    except ValueError:
        return []
    if not entries or entries[0] != {"study": identity}:
        return []
    blocks = [(Block(*entry["block"]), entry["tally"]) for entry in entries[1:]]
    return [(block, decode(block, tally)) for block, tally in blocks]
