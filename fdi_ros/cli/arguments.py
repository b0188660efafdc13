# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a verb is, and the arguments that several verbs take.

This module, and each verb's own until the verb runs, import no NumPy and no Numba: usage errors come at once, and help
without the compiler.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros.detectors import DETECTORS
from fdi_ros.system.installation import resolve, shipped_files

Options = Mapping[str, Any]  # what argparse is told of an argument


class Verb(NamedTuple):
    """One verb."""

    meaning: str
    examples: Sequence[str]  # the first is the one to begin with
    arguments: Mapping[str, Options]  # by name, several names with spaces between; what is not said is as in `SHARED`
    run: Callable[[Namespace], int]  # returns the exit code; what needs NumPy is imported in it
    libraries: Sequence[str] = ()  # that the verb needs and a live node does not

    def add_to(self, parser: ArgumentParser) -> None:
        """Have a parser take the arguments."""
        for names, own in self.arguments.items():
            added = parser.add_argument(*names.split(), **{**SHARED.get(names, {}), **own})
            if names == "--fault":
                # Looked up when the help is printed: it needs NumPy.
                added.help = f"{added.help}; kinds: %(kinds)s"
                vars(added)["kinds"] = _FaultKinds()


class _FaultKinds:
    def __str__(self) -> str:
        from fdi_ros.faults.kinds import FAULT_KINDS

        return ", ".join(FAULT_KINDS)


_CONFIG = "ROS 2 parameter file{}, a shipped one by its name alone; may be repeated, later ones win"
DETECTOR_NAMES = ", ".join(reversed(DETECTORS))  # for a help, the one that flies first
FLAG = {"action": "store_true"}
FILE = {"type": Path, "metavar": "FILE"}
SHARED: Mapping[str, Options] = {
    "bag": {
        **FILE,
        "metavar": "BAG",
        "help": "rosbag2 folder, or one .mcap, .db3, .bag, .csv, .bin, .ulg or .tlog file",
    },
    "--config": {"type": resolve, "action": "append", "metavar": "FILE", "required": True, "help": _CONFIG.format("")},
    "--start": {"type": float, "default": 0.0, "metavar": "S", "help": "from here, seconds from the start"},
    "--end": {"type": float, "default": math.inf, "metavar": "S", "help": "up to here"},
    "--fault": {"action": "append", "default": [], "metavar": "'KEY=VALUE ...'"},
    "--detector": {"metavar": "NAME", "help": f"use this detector instead of the configured one: {DETECTOR_NAMES}"},
    "--csv": FILE,
    "--report": {**FILE, "metavar": "FILE.html", "help": "write a page with tables and plots"},
    "--json": {
        **FILE,
        "help": "write all figures as JSON, in SI units; - is standard output, tables then go to standard error",
    },
    "--force": {**FLAG, "help": "overwrite files that exist"},
    "--quiet": {**FLAG, "help": "print nothing but errors; no progress"},
    "--degrees": {**FLAG, "help": "print angular rates in deg/s; what is read and written stays in rad/s"},
    "--workers": {"type": int, "metavar": "N", "help": "processes; default: as many as there are cores"},
    "--scheduler": {
        "metavar": "ADDRESS",
        "help": "Dask scheduler to work instead: tls://host:port (certificates: Dask's configuration), or where nobody"
        " else reaches it tcp://host:port",
    },
}
"""Arguments of several verbs."""


def shared(*names: str) -> dict[str, Options]:
    """Take arguments of `SHARED` as they are."""
    return {name: {} for name in names}


PART = shared("--start", "--end")
RESULTS = shared("--json", "--force", "--quiet")  # what every verb takes that has results
WORKERS = shared("--workers", "--scheduler")


def config_files(purpose: str, **options: Any) -> dict[str, Options]:
    """Take parameter files for a purpose."""
    return {"--config": {"help": _CONFIG.format(purpose), **options}}


def shipped(kind: str) -> str:
    """List the shipped files of a kind, for a help."""
    return ", ".join(path.name for path in shipped_files() if path.parent.name == kind)
