# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Runs of `fdi fleet` in this process, and the tables that they leave."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet

from fdi_ros.cli.command_line import main


def run(out: Path, *given: object, code: int = 0) -> Path:
    """Judge what is given; return the folder of the dataset."""
    assert main(["fleet", *map(str, given), "--output", str(out), "--workers", "1"]) == code
    return out


def table(out: Path, name: str = "flights") -> list[dict[str, Any]]:
    with (out / f"{name}.parquet").open("rb") as file:
        rows: list[dict[str, Any]] = parquet.read_table(file).to_pylist()
    return rows
