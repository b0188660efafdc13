# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Output of the verbs: progress, text, and files, which replace only an earlier result of their kind."""

from __future__ import annotations

import argparse
import math
import os
import platform
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from fdi_ros import __version__
from fdi_ros.bag.raw import Damage, find_files, is_made_by_fdi
from fdi_ros.cli import ExitCode
from fdi_ros.compiling.notice import clock, compiling_seconds, is_compiling
from fdi_ros.errors import BagError, ConfigError
from fdi_ros.report.layout import Severity
from fdi_ros.system.files import (
    STANDARD_OUTPUT,
    is_open_already,
    is_stream,
    open_regular,
    real_path,
    whole,
    write_json,
)
from fdi_ros.system.text import LINE, percent, shown, visible

# Progress

_FORMAT = "{percentage:3.0f} %|{bar:40}| {elapsed}, {remaining} left"
_TIMED_FORMAT = "{desc}, {elapsed}"
SAID_EVERY = 10.0
"""Period of the progress lines without a terminal, s."""
_BAR_PERIOD = 1.0
"""Period at which the bar in a terminal is refreshed, s."""


@contextmanager
def progress(
    stream: TextIO, quiet: bool, what: str = "", timed: bool = False
) -> Iterator[Callable[[float], None]]:
    """Show progress: a bar in a terminal, which is removed at the end. Otherwise a line every 10 s.

    Parameters
    ----------
    stream
        Stream for the bar or the lines.
    quiet
        Show nothing.
    what
        Begin of each line.
    timed
        The share done is unknown: show only the elapsed time.

    Yields
    ------
    A function to be called with the share done, 0 to 1.
    """
    if quiet:
        yield lambda share: None
        return
    from tqdm import tqdm

    shown = _TIMED_FORMAT if timed else _FORMAT
    begun = clock()
    compiled = compiling_seconds()
    ended = threading.Event()
    # disable=None: tqdm shows a bar only in a terminal.
    bar = tqdm(
        total=1.0, desc=what, file=stream, disable=None, bar_format=shown, leave=False
    )
    done = 0.0

    def tick() -> None:
        """Refresh the bar or print a line, even while the work itself reports nothing."""
        said = 0.0
        while not ended.wait(SAID_EVERY if bar.disable else _BAR_PERIOD):
            if is_compiling():
                continue  # The compiler has progress lines of its own.
            if not bar.disable:
                bar.refresh()
                continue
            share = done
            words = _progress_words(share, clock() - begun, share > said)
            said = share
            with suppress(OSError, ValueError):
                stream.write(f"fdi: {what}{', ' if what else ''}{words}\n")
                stream.flush()

    def show(share: float) -> None:
        nonlocal compiled, done
        before = compiled
        compiled = compiling_seconds()
        if not bar.disable:
            # The time left must not include the time of compiling.
            bar.start_t += compiled - before
        bar.update(share - bar.n)
        done = share

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield show
    finally:
        ended.set()
        thread.join()
        bar.close()


def _progress_words(share: float, spent: float, grew: bool) -> str:
    """Return the share done after ``spent`` s, and the time left if the share ``grew``."""
    if share <= 0:
        return f"{spent:.0f} s so far"
    words = f"{percent(share)} done after {spent:.0f} s"
    if grew and share < 1.0:
        # While one part takes long, nothing shows how long.
        words += f", about {spent * (1 / share - 1):.0f} s left"
    return words


# Files and words

_MARK_BYTES = 1 << 16
"""Size of the begin of a file that is searched for the mark of a result, bytes."""


class Kind(Enum):
    """Kind of a result, with the pattern that recognises an earlier result of that kind and nothing else."""

    JSON = rb'\s*\{\s*"generator":\s*"fdi_ros"'
    CSV = rb"stamp,rate_x,rate_y,rate_z,std_x,|monitor,channel,kind,size,fault,at_s,"
    PAGE = rb'\s*(?i:<!doctype html>)[^\0]*?<meta name="generator" content="fdi_ros">'
    PARAMETERS = rb"(?:(?:[ \t]*#[^\n]*|---[^\n]*|[ \t]*)\n)*?[ \t]*#[^\n]*\bmade by fdi (?:inspect|setup|calibrate)\b"
    FOLDER = rb""  # an output bag, recognised by its metadata


_RESULT_KINDS = {
    "json": Kind.JSON,
    "csv": Kind.CSV,
    "report": Kind.PAGE,
}
"""Kind of the result that an option writes."""


class Outputs:
    """Files and text that a verb writes. Targets are checked before any work is done.

    Parameters
    ----------
    arguments
        Arguments of the verb.
    names
        Options with paths to write, in the order of their confirmation.
    sources
        Paths that the verb reads. Their files are never overwritten. None: not given.
    output
        Kind of the result of ``--output``. None: the writer itself checks the target.

    Raises
    ------
    BagError
        If a target must not be written, or two options have the same target.
    """

    def __init__(
        self,
        arguments: argparse.Namespace,
        names: Sequence[str],
        sources: Iterable[Path | None] = (),
        output: Kind | None = Kind.PARAMETERS,
    ) -> None:
        self._arguments = arguments
        self.targets: dict[str, Path] = {
            name: path for name in names if (path := getattr(arguments, name))
        }
        self._kinds = {**_RESULT_KINDS, "output": output}
        wanted = [
            (path, kind)
            for name, path in self.targets.items()
            if (kind := self._kinds[name]) is not None
        ]
        folders = [path for path, kind in wanted if kind is Kind.FOLDER]
        taken: set[Path] = set()
        for target, kind in wanted:
            # Two outputs may share a device, but neither a file nor standard output.
            if real_path(target) in taken and (
                target == STANDARD_OUTPUT or not is_stream(target)
            ):
                raise BagError(f"cannot write {target}: two outputs have this name")
            taken.add(real_path(target))
            for folder in folders:
                if (
                    not is_stream(target)
                    and real_path(folder) in real_path(target).parents
                ):
                    raise BagError(
                        f"cannot write {target}: it lies in {folder}, which is written as a whole"
                    )
            check_target(
                target,
                kind,
                arguments.force,
                [source for source in sources if source is not None],
            )

    def say(self, text: str, severity: Severity | None = None) -> None:
        """Print text, unless ``--quiet`` is given.

        Text goes to standard output, or to standard error if data goes to standard output.
        ``severity`` colours the first line in a terminal.
        """
        if not self._arguments.quiet:
            stream = (
                sys.stderr
                if any(map(is_open_already, self.targets.values()))
                else sys.stdout
            )
            text = visible(text)
            if (
                severity is not None
                and stream.isatty()
                and not os.environ.get("NO_COLOR")
            ):
                colour = {Severity.GOOD: 32, Severity.UNKNOWN: 33, Severity.BAD: 31}[
                    severity
                ]
                first, end, rest = text.partition("\n")
                text = f"\x1b[1;{colour}m{first}\x1b[0m{end}{rest}"
            stream.write(text)

    def finish(
        self,
        text: str,
        figures: Mapping[str, Any] | None = None,
        html: Callable[[], str] | None = None,
        severity: Severity | None = None,
        **others: Callable[[Path], object],
    ) -> int:
        """Write all files or none, then print the text and the targets.

        Parameters
        ----------
        text
            Text for the terminal.
        figures
            Content of the JSON file. None: there is none.
        html
            Returns the page. None: there is none.
        severity
            Severity of the verdict in the first line of the text. None: no verdict.
        others
            Functions that write the files of other options, by the names of the options.

        Returns
        -------
        The exit code.
        """
        if html is not None:
            others["report"] = lambda path: path.write_text(
                html(), encoding="utf-8", errors="replace"
            )
        with ExitStack() as stack:
            # The files appear only at the end, so that a failure leaves no file.
            for name, write in others.items():
                if name in self.targets:
                    write(stack.enter_context(whole(self.targets[name])))
            if figures is not None:
                write_json(self.targets.get("json"), figures)
        self.say(text, severity)
        for name, target in self.targets.items():
            if target != STANDARD_OUTPUT:
                refused = (
                    severity is Severity.BAD and self._kinds[name] is Kind.PARAMETERS
                )
                warning = " (NOT FOR FLIGHT)" if refused else ""
                self.say(f"wrote {shown(target, LINE)}{warning}\n")
        return ExitCode.DONE if severity is None else severity.exit_code


def config_words(arguments: argparse.Namespace) -> str:
    """Return the paths of the parameter files."""
    return ", ".join(map(str, arguments.config))


def versions() -> str:
    """Return the versions on which figures may depend."""
    return f"fdi_ros {__version__}, NumPy {np.__version__}, Python {platform.python_version()}"


def about(
    arguments: argparse.Namespace, config: str, more: Mapping[str, str]
) -> dict[str, str]:
    """Return the head of a page: recording, part, config, versions, and more rows."""
    end = "the end" if math.isinf(arguments.end) else f"{arguments.end:g} s"
    first = {
        "recording": str(arguments.bag),
        "part": f"{arguments.start:g} s to {end}",
        "config": config,
    }
    return {**first, **more, "versions": versions()}


def check_part(arguments: argparse.Namespace) -> None:
    """Check the part of a recording: `ConfigError` unless 0 <= start < end."""
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(
            f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end"
        )


def check_target(
    path: Path, kind: Kind, force: bool, sources: Sequence[Path] = ()
) -> None:
    """Raise `BagError` if a target exists and must stay.

    With ``force`` an earlier result of this kind may be overwritten, but none of the ``sources``.
    """
    if is_stream(path):
        if kind is Kind.FOLDER:
            raise BagError(f"cannot write {path}: a recording is a folder")
        return
    if not path.absolute().parent.is_dir():
        raise BagError(
            f"cannot write {path}: there is no folder {path.absolute().parent}"
        )
    real = real_path(path)
    for source in sources:
        if any(
            part in (real, *real.parents) or real in part.parents
            for part in _parts(source)
        ):
            raise BagError(
                f"cannot write {path}: it belongs to {source}, which is read"
            )
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise BagError(f"{path} exists already; --force overwrites it")
    if kept := _what_stays(path, kind):
        raise BagError(f"{path} is {kept}; it is not overwritten even by --force")


def _parts(source: Path) -> list[Path]:
    """Return the real paths of all files of a source. Links and metadata.yaml may lead elsewhere."""
    found = [real_path(source)]
    if source.is_dir():
        found.append(real_path(source / "metadata.yaml"))
        # Reading the source will report if it is no recording.
        with suppress(BagError):
            found += map(real_path, find_files(source, Damage()))
    return found


def _what_stays(path: Path, kind: Kind) -> str:
    """Describe a path that is no earlier result of a kind. Empty: it may be overwritten."""
    if kind is Kind.FOLDER:
        if not path.is_dir():
            return "no folder"
        children = {child.name: child.is_file() for child in path.iterdir()}
        with suppress(BagError):
            complete = children.keys() == {
                "metadata.yaml",
                *(file.name for file in find_files(path, Damage())),
            }
            if complete and is_made_by_fdi(path) and all(children.values()):
                return ""
        return (
            "a folder that holds more than a recording made by fdi" if children else ""
        )
    if path.is_dir():
        return "a folder"
    if not path.is_file():
        return "no file" if path.exists() else ""
    with open_regular(path) as file:
        begin = file.read(_MARK_BYTES)
    return (
        "no result of fdi of this kind"
        if begin and not re.match(kind.value, begin)
        else ""
    )
