# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The example notebook, run as a reader runs it."""

from __future__ import annotations

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")


@pytest.mark.usefixtures("compiled")
def test_the_notebook_runs_and_shows_what_it_says(root: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(root / "examples" / "recording.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "kept without outputs: they would grow stale"
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(root / "examples")}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    said = "".join(output.get("text", "") for output in outputs)
    shown = [output["data"] for output in outputs if "data" in output]
    assert "isolated: True" in said
    assert "declared without a fault: 0" in said
    assert "noise.noise_std" in shown[0]["text/html"]
    assert any("FAULTY" in data.get("text/html", "") for data in shown)
    assert any("'imu_2.y', 'FAULTY'" in data["text/plain"] for data in shown)
    assert any("image/png" in data for data in shown)
