"""What is done of a study: kept beside the result so that it can go on, and shown while it runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from fdi_ros.errors import StudyError
from fdi_ros.experiments.experiment import Block
from fdi_ros.experiments.tally import Tally


class Done:
    """Blocks done, kept in ``<result>.partial`` line by line; without a path, in memory alone.

    Parameters
    ----------
    path
        Of the result.
    identity
        All that the result depends on but the number of trials; blocks of another study are not taken over.
    """

    def __init__(self, path: Path | None, identity: str) -> None:
        self.blocks: dict[Block, Tally] = {}
        self._path = None if path is None else path.with_name(path.name + ".partial")
        self._file: IO[str] | None = None
        if self._path is None:
            return
        try:
            kept = self._read(identity)
            # Written anew, whole lines only: a study that was killed may have left half a one.
            self._file = self._path.open("w", encoding="utf-8")
            self._write({"study": identity})
            for block, tally in kept:
                self.add(block, tally)
        except OSError as error:
            raise StudyError(f"cannot keep the blocks done in {self._path}: {error.strerror}") from error

    def __len__(self) -> int:
        return len(self.blocks)

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

    def _write(self, entry: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(entry) + "\n")
            self._file.flush()

    def _read(self, identity: str) -> list[tuple[Block, Tally]]:
        assert self._path is not None
        if not self._path.exists():
            return []
        # The last line, if it was not finished, has no end.
        whole = self._path.read_text(encoding="utf-8").rpartition("\n")[0]
        try:
            entries = [json.loads(line) for line in whole.splitlines()]
        except ValueError:
            return []
        if not entries or entries[0] != {"study": identity}:
            return []
        return [(Block(*entry["block"]), entry["tally"]) for entry in entries[1:]]


class Bar:
    """Progress on a terminal; silent elsewhere."""

    def __init__(self, total: int, done: int, words: str, quiet: bool = False) -> None:
        # None: tqdm asks whether standard error is a terminal. Without smoothing: blocks take unequal times, and what
        # is left takes as long as all that is done, not as the last few.
        self._bar = tqdm(
            total=total,
            initial=done,
            desc=words,
            smoothing=0,
            disable=True if quiet else None,
            bar_format="{desc} |{bar:30}| {n_fmt}/{total_fmt} blocks, {elapsed}, {remaining} left",
        )

    def step(self) -> None:
        """One more block is done."""
        self._bar.update()

    def close(self) -> None:
        """Leave the terminal on a line of its own."""
        self._bar.close()
