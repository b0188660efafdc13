# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameter files, written whole: each parameter in the order of its declaration, with unit and meaning from there.

What a file is made from is carried over by value; its comments are not.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from fdi_ros.config.config import PARAMETERS, Config, is_monitor, parameters_in
from fdi_ros.errors import ConfigError
from fdi_ros.system.yaml_file import parse_yaml, read_yaml

WIDTH = 110  # columns of a file; a value without a comment beside it may be longer
_PLAIN = re.compile(r"[A-Za-z_/~][A-Za-z0-9_/~.*-]*")
"""Texts that need no quotes, unless they are one of these words: the parser of ROS takes more of them than PyYAML."""
_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity", "~"}


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Writes texts in quotes where they could be taken for something else."""

    def text(self, text: str) -> yaml.Node:
        """Return the node of a text."""
        plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')


_Dumper.add_representer(str, _Dumper.text)


def parameters_of(text: str) -> dict[str, Any]:
    """Return the parameters in the text of a parameter file, ``{"section.field": value}``; `ConfigError` if none."""
    return parameters_in(parse_yaml(text, "config", ConfigError), "config")


def parameter_file(parameters: Mapping[str, Any], origin: str, remarks: Mapping[str, str] | None = None) -> str:
    """Return the text of a parameter file with the parameters ``{"section.field": value}``.

    ``origin``: lines of comment at the top, where the values come from. ``remarks``: what is to be said of single
    values besides unit and meaning, by parameter.
    """
    return _text("/**", {}, parameters, origin, remarks or {})


def with_parameters(
    files: Sequence[Path],
    changes: Mapping[str, Any],
    origin: str,
    remarks: Mapping[str, str],
    without: Sequence[str] = (),
) -> str:
    """Return the text of a parameter file made from others, with the parameters of other nodes that they hold.

    Later files win. ``changes``: ``{"section.field": value}`` that get other values; ``without``: those that are left
    out, as the changes replace them; ``origin`` and ``remarks`` as of `parameter_file`. `ConfigError` if a file is no
    parameter file.
    """
    given: dict[str, Any] = {}
    ros: dict[str, Any] = {}
    others: dict[Any, Any] = {}
    monitors: set[str] = set()
    for file in files:
        document = read_yaml(file, "config", ConfigError)
        given |= parameters_in(document, f"config {file}")
        ros |= parameters_in(document, f"config {file}", ros=True)
        monitors |= set(filter(is_monitor, document))
        _update(others, {node: body for node, body in document.items() if not is_monitor(node)})
    # As checked: of a number that is written as a text the number.
    values = Config.from_parameters(given).parameters()
    kept = {name: values[name] for name in given if name not in without}
    node = monitors.pop() if len(monitors) == 1 else "/**"
    text = _text(node, ros, {**kept, **changes}, origin, remarks)
    return f"{text}\n{_yaml(others)}" if others else text


def _update(tree: dict[Any, Any], new: Mapping[Any, Any]) -> None:
    """Take over the values of a tree into another."""
    for key, value in new.items():
        if isinstance(value, dict):
            if not isinstance(tree.get(key), dict):
                tree[key] = {}
            _update(tree[key], value)
        else:
            tree[key] = value


def _text(
    node: str, ros: Mapping[str, Any], parameters: Mapping[str, Any], origin: str, remarks: Mapping[str, str]
) -> str:
    lines = textwrap.indent(_yaml(dict(ros)), " " * 4).splitlines() if ros else []
    section = ""
    for name in PARAMETERS:
        if name not in parameters:
            continue
        before, section = section, name.rpartition(".")[0]
        if section != before:
            lines += ["", f"    {section}:"]
        lines += _entry(name, parameters[name], remarks.get(name, ""), 6 if section else 4)
    top = [*(f"# {line}" for line in origin.splitlines()), f"{node}:"]
    return "\n".join([*top, f"  ros__parameters:{'' if lines else ' {}'}", *lines]) + "\n"


def _entry(name: str, value: Any, remark: str, indent: int) -> Iterator[str]:
    """Lines of one parameter; a comment that does not fit beside it stands above it."""
    declared, margin = PARAMETERS[name], " " * indent
    meaning = f"{declared.unit}: {declared.description}" if declared.unit else declared.description
    comment = f"# {meaning}. {remark[0].upper()}{remark[1:]}" if remark else f"# {meaning}"
    rows = list(_value(value))
    line = f"{margin}{name.rpartition('.')[2]}: {rows[0] if len(rows) == 1 else ''}".rstrip()
    if len(rows) == 1 and len(line) + 1 + len(comment) <= WIDTH:
        yield f"{line} {comment}"
        return
    yield from textwrap.wrap(
        comment, WIDTH, initial_indent=margin, subsequent_indent=f"{margin}# ", break_long_words=False
    )
    yield line
    yield from (f"{margin}  {row}" for row in rows if len(rows) > 1)


def _value(value: Any) -> Iterator[str]:
    """Write a value; a long list has three on a line: an axis, a unit, or a row of a rotation."""
    if not isinstance(value, (list, tuple)) or len(_flow(value)) <= WIDTH // 2 or len(value) % 3:
        yield _flow(value)
        return
    for k in range(0, len(value), 3):
        row = _flow(value[k : k + 3])[1:-1]
        yield f"{' ' if k else '['}{row}{',' if k + 3 < len(value) else ']'}"


def _flow(value: Any) -> str:
    """Write a value on one line."""
    return _yaml(value, default_flow_style=True).partition("\n")[0]


def _yaml(value: Any, **options: Any) -> str:
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1 << 30, **options))
