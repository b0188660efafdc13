# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a verb says and writes: progress, words, files that replace nothing but a former result of their kind."""

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
from fdi_ros.system.text import LINE, shown, visible

# Progress -------------------------------------------------------------------------------------------------------------

_FORMAT = "{percentage:3.0f} %|{bar:40}| {elapsed}, {remaining} left"
_TIMED_FORMAT = "{desc}, {elapsed}"
SAID_EVERY = 10.0  # how often the share done is said where there is no terminal, s
_TICK = 1.0  # how often the time is drawn anew, s


@contextmanager
def progress(
    stream: TextIO, quiet: bool, what: str = "", timed: bool = False
) -> Iterator[Callable[[float], None]]:
    """Show how much is done: a bar on the last line of a terminal, wiped at the end; elsewhere a line now and then.

    Gives what is to be called with the share done, 0 to 1. The line begins with ``what``. ``timed``: no share is known,
    so it says what is done, and for how long already. ``quiet``: nothing is shown.
    """
    if quiet:
        yield lambda share: None
        return
    from tqdm import tqdm

    shown, begun, compiled, ended = (
        _TIMED_FORMAT if timed else _FORMAT,
        clock(),
        compiling_seconds(),
        threading.Event(),
    )
    # None: tqdm asks the stream whether it is a terminal.
    bar = tqdm(
        total=1.0, desc=what, file=stream, disable=None, bar_format=shown, leave=False
    )
    done = 0.0

    def tick() -> None:
        """Draw the time anew, or say now and then how much is done, whatever keeps the rest waiting."""
        while not ended.wait(SAID_EVERY if bar.disable else _TICK):
            if is_compiling():
                continue  # That has lines of its own.
            if not bar.disable:
                bar.refresh()
                continue
            spent, share = clock() - begun, done
            words = f"{spent:.0f} s so far"
            if share > 0:
                left = spent * (1 / share - 1)
                words = f"{share:.0%} done after {spent:.0f} s, about {left:.0f} s left"
            with suppress(OSError, ValueError):
                stream.write(f"fdi: {what}{', ' if what else ''}{words}\n")
                stream.flush()

    def show(share: float) -> None:
        nonlocal compiled, done
        before, compiled = compiled, compiling_seconds()
        if not bar.disable:
            # Time spent compiling is none of the work.
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


# Files and words ------------------------------------------------------------------------------------------------------

_HEAD = (
    1 << 16
)  # bytes at the begin of a file in which the mark of a result is looked for


class Kind(Enum):
    """What is written, and the pattern by which a former result of the kind is recognised; nothing else matches it."""

    JSON = rb'\s*\{\s*"generator":\s*"fdi_ros"'
    CSV = rb"stamp,rate_x,rate_y,rate_z,std_x,|monitor,channel,kind,size,fault,at_s,"
    PAGE = rb'\s*(?i:<!doctype html>)[^\0]*?<meta name="generator" content="fdi_ros">'
    PARAMETERS = rb"(?:(?:[ \t]*#[^\n]*|---[^\n]*|[ \t]*)\n)*?[ \t]*#[^\n]*\bmade by fdi (?:inspect|setup|calibrate)\b"
    FOLDER = rb""  # an output bag: recognised by its metadata


_KINDS = {
    "json": Kind.JSON,
    "csv": Kind.CSV,
    "report": Kind.PAGE,
}  # what is written where options of these names say


class Outputs:
    """What a verb was asked for: files, refused before any work is done and confirmed when it is, and words.

    ``names``: of the options that say where to write, in the order in which that is confirmed; ``targets``: what they
    say. ``sources``: what is read, never overwritten wherever its files lie; None: not given. ``output``: what is
    written where ``--output`` says; None: whoever writes it looks at what is there. `BagError` if one may not be
    written, or two are one.
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
        self._kinds = {**_KINDS, "output": output}
        wanted = [
            (path, kind)
            for name, path in self.targets.items()
            if (kind := self._kinds[name]) is not None
        ]
        folders = [path for path, kind in wanted if kind is Kind.FOLDER]
        taken: set[Path] = set()
        for target, kind in wanted:
            # A device keeps none of what goes there apart; a file and standard output do.
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
        """Print for people, unless they asked for quiet: to standard output, unless data goes there.

        ``severity``: of the first line, where that is a verdict; a terminal shows it by its colour.
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
        """Write page, figures and other files where they were asked for, all or none; say the text, and all targets.

        `severity` is that of the first line of the text, where that is a verdict; `others` write the files of other
        options, by name. Returns the exit code.
        """
        if html is not None:
            others["report"] = lambda path: path.write_text(
                html(), encoding="utf-8", errors="replace"
            )
        with ExitStack() as stack:
            # They take their places at the end: where one cannot be written, there is none.
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
        return 0 if severity is None else severity.exit_code


def config_words(arguments: argparse.Namespace) -> str:
    """Name the parameter files that were read."""
    return ", ".join(map(str, arguments.config))


def versions() -> str:
    """Name the versions that figures may depend on."""
    return f"fdi_ros {__version__}, NumPy {np.__version__}, Python {platform.python_version()}"


def about(
    arguments: argparse.Namespace, config: str, more: Mapping[str, str]
) -> dict[str, str]:
    """Say for a page what was run: of which part of which recording, with which config, and more."""
    end = "the end" if math.isinf(arguments.end) else f"{arguments.end:g} s"
    first = {
        "recording": str(arguments.bag),
        "part": f"{arguments.start:g} s to {end}",
        "config": config,
    }
    return {**first, **more, "versions": versions()}


def check_part(arguments: argparse.Namespace) -> None:
    """Refuse a part of a recording that is none: `ConfigError` if the end is not after the start."""
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(
            f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end"
        )


def check_target(
    path: Path, kind: Kind, force: bool, sources: Sequence[Path] = ()
) -> None:
    """Refuse to write where something is that should stay (`BagError`), before any work is done.

    A former result of this kind may be overwritten with ``force``; what is read (``sources``) never is.
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
    """Where all that belongs to a source lies: metadata.yaml and links may lead out of the folder of a recording."""
    found = [real_path(source)]
    if source.is_dir():
        found.append(real_path(source / "metadata.yaml"))
        # What is no recording is refused when it is read.
        with suppress(BagError):
            found += map(real_path, find_files(source, Damage()))
    return found


def _what_stays(path: Path, kind: Kind) -> str:
    """Say what lies at a path that is no former result of a kind; empty: there is one, or nothing."""
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
        begin = file.read(_HEAD)
    return (
        "no result of fdi of this kind"
        if begin and not re.match(kind.value, begin)
        else ""
    )
