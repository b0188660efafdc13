"""What the README says is true: its commands run, its example gives a verdict, its links lead somewhere."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import fdi_ros
from fdi_ros.cli.command_line import VERBS, main
from fdi_ros.monitor.output import ChannelState

pytestmark = pytest.mark.usefixtures("compiled")

README = (Path(__file__).parents[1] / "README.md").read_text()
COMMANDS = re.findall(r"^    (fdi .+)$", README, flags=re.MULTILINE)
ELSEWHERE = ("fdi montecarlo", "fdi compile", "fdi watch")
"""Takes minutes; is run by the fixture `compiled`; runs until it is interrupted (test_watch.py)."""
QUICK = [command for command in COMMANDS if not command.startswith(ELSEWHERE)]


@pytest.mark.parametrize("command", QUICK)
def test_every_offline_command_runs(
    command: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for folder in ("bags", "config"):
        (tmp_path / folder).symlink_to(root / folder)
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command)[1:]) == 0
    assert capfd.readouterr().err == ""
    if "--json" in command:
        assert (tmp_path / "out.json").stat().st_size > 0


def test_there_is_a_command_for_replay_and_one_with_a_fault() -> None:
    assert any("replay" in command and "--fault" not in command for command in COMMANDS)
    assert any("--fault" in command for command in COMMANDS)


def test_every_verb_is_shown() -> None:
    assert {command.split()[1] for command in COMMANDS} == set(VERBS)


def test_every_file_of_a_command_is_there(root: Path) -> None:
    named = {word for command in COMMANDS for word in command.split() if word.startswith(("bags/", "config/"))}
    assert [word for word in named if not (root / word).exists()] == []


def test_the_python_example_gives_a_verdict() -> None:
    (example,) = re.findall(r"^    import fdi_ros\n(?:    .*\n)+", README, flags=re.MULTILINE)
    names = {"z": np.zeros((5, 6))}
    exec("\n".join(line[4:] for line in example.splitlines()), names)
    assert isinstance(names["verdict"], fdi_ros.detectors.Verdict)
    assert names["verdict"].alarm.tolist() == [False] * 5


def test_the_numbers_of_the_states_are_those_of_the_code() -> None:
    stated = {name: int(number) for number, name in re.findall(r"(\d) ([A-Z]+)\b", README)}
    assert stated == {state.name: int(state) for state in ChannelState}


def test_every_link_leads_to_a_file(root: Path) -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (root / link).exists()] == []
