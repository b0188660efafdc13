# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults into live topics, for simulators and hardware in the loop: off until asked, loud when on.

Each input topic is republished under its name and a suffix, byte for byte while the injector is off. Settings come
from the parameter file of the monitor, so that both have the same channels.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fdi_ros.ros.process import run

if TYPE_CHECKING:
    from fdi_ros.ros.injection import InjectorNode


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; exit code 0, or 2 with one line if it cannot start."""
    return run("injector_node", _node, argv)


def _node() -> InjectorNode:
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from fdi_ros.ros.injection import InjectorNode

    return InjectorNode()


if __name__ == "__main__":
    sys.exit(main())
