# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What README, guides and notebook say is true: their commands run, the example gives a verdict, links lead on."""

import importlib
import pkgutil
import re
import shlex
import textwrap
from pathlib import Path

import numpy as np
import pytest

from fdi_ros.cli.command_line import VERBS, main
from fdi_ros.config.config import PARAMETERS
from fdi_ros.monitor.output import ChannelState

pytestmark = pytest.mark.usefixtures("compiled")

ROOT = Path(__file__).parents[1]
GUIDES = {
    name: (ROOT / name).read_text()
    for name in (
        "README.md",
        *(f"docs/{guide}.md" for guide in ("install", "live", "recordings", "fleet")),
    )
}
COMMANDS = re.findall(
    r"^    (?:\.venv/bin/)?(fdi .+)$", "\n".join(GUIDES.values()), flags=re.MULTILINE
)
ELSEWHERE = ("fdi montecarlo", "fdi compile", "fdi watch")
"""Takes minutes; is run by the fixture `compiled`; runs until it is interrupted (test_watch.py)."""
QUICK = [
    command for command in dict.fromkeys(COMMANDS) if not command.startswith(ELSEWHERE)
]

SHORTER = {
    "sweep": ("--times", "1"),
    "setup": ("--end", "40"),
    "calibrate": ("--end", "40"),
}
"""Words after which a verb takes the same steps on less."""


def python_of(page):
    """All Python of a page, one block after the other."""
    pattern = (
        r"^```python\n([\s\S]*?)^```$|^\.\. code-block:: python\n\n((?:    .*\n|\n)+)"
    )
    return "\n".join(
        fenced or textwrap.dedent(block)
        for fenced, block in re.findall(pattern, page.read_text(), flags=re.MULTILINE)
    )


def resolved(name):
    """Whether there is a module, or an attribute of one, of this name."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return name.endswith((".egg", ".msg"))
    return True


PAGES_WITH_PYTHON = [
    page
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.*"))
    if page.suffix in (".md", ".rst") and python_of(page)
]


@pytest.mark.parametrize("command", QUICK)
def test_every_offline_command_runs(command, root, tmp_path, monkeypatch, capfd):
    for folder in ("bags", "config"):
        (tmp_path / folder).symlink_to(root / folder)
    monkeypatch.chdir(tmp_path)
    # A faulty gyro in a recording is exit code 3, units that are turned against each other are 4.
    faulty = "copter_crash" in command and "replay" in command
    expected = 3 if faulty else 4 if command.startswith("fdi inspect") else 0
    assert (
        main([*shlex.split(command)[1:], *SHORTER.get(command.split()[1], ())])
        == expected
    )
    # On a busy machine a long one says how far it is.
    assert [
        line
        for line in capfd.readouterr().err.splitlines()
        if not re.search("% done|so far", line)
    ] == []
    if "--json" in command:
        assert (tmp_path / "out.json").stat().st_size > 0


def test_every_verb_is_shown_with_files_that_are_there(root):
    assert {command.split()[1] for command in COMMANDS} == set(VERBS)
    named = {
        word
        for command in COMMANDS
        for word in command.split()
        if word.startswith(("bags/", "config/"))
    }
    assert [word for word in named if not (root / word).exists()] == []


@pytest.mark.parametrize("page", PAGES_WITH_PYTHON, ids=lambda page: page.name)
def test_the_python_of_a_page_runs(page, root, monkeypatch):
    monkeypatch.chdir(root)
    rng = np.random.default_rng(3)
    names = {
        "stamp": 10**16 + 10**7 * np.arange(600),
        "z": rng.normal(0.0, 0.0025, (600, 6)),
    }
    exec(python_of(page), names)
    # What is shown of them: quiet gyros are healthy, injected faults are isolated.
    assert "verdict" not in names or not names["verdict"].alarm.any()
    assert "fault" not in names or names["fault"].isolated
    assert "table" not in names or str(names["table"].index.tz) == "UTC"


def test_every_name_of_the_package_in_a_page_is_there():
    for page in (ROOT / "docs").rglob("*.[mr][ds]*"):
        for name in re.findall(r"[`( ](fdi_ros(?:\.[a-zA-Z_]+)+)", page.read_text()):
            assert resolved(name), f"{page.name}: {name}"


def test_the_numbers_of_the_states_are_those_of_the_code():
    stated = {
        name: int(number)
        for number, name in re.findall(r"(\d) ([A-Z]+)\b", GUIDES["docs/live.md"])
    }
    assert stated == {state.name: int(state) for state in ChannelState}


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "bags/README.md"])
def test_every_link_leads_to_a_file(name, root):
    """Those of the pages of the site are checked where it is built, anchors too: make docs."""
    links = [
        link
        for link in re.findall(r"\]\(([^)]+)\)", (root / name).read_text())
        if "://" not in link
    ]
    targets = [(root / name).parent / link.partition("#")[0] for link in links]
    assert [target for target in targets if not target.exists()] == []


def test_the_notebook_runs_and_shows_what_it_says(root, tmp_path):
    nbformat, nbclient = (
        pytest.importorskip(name, reason="nbclient is not installed")
        for name in ("nbformat", "nbclient")
    )
    notebook = nbformat.read(root / "examples" / "recording.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), (
        "kept without outputs: they would grow stale"
    )
    nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(root / "examples")}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    said = "".join(output.get("text", "") for output in outputs)
    shown = [output["data"] for output in outputs if "data" in output]
    assert "isolated: True" in said
    assert "declared without a fault: 0" in said
    assert "noise.noise_std" in shown[0]["text/html"]
    assert any("FAULTY" in data.get("text/html", "") for data in shown)
    assert any("'imu_2.y', 'FAULTY'" in data["text/plain"] for data in shown)
    assert any("image/png" in data for data in shown)


def test_tables_that_follow_from_the_code_are_up_to_date(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "docs"))
    reference = importlib.import_module("reference")
    for page in reference.PAGES:
        text = (root / "docs" / page).read_text()
        assert reference.filled(text) == text, "python docs/reference.py writes it"
    assert all(
        f"| `{name}` |" in (root / "docs" / "parameters.md").read_text()
        for name in PARAMETERS
    )
