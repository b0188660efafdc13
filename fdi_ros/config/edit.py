# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Write a ROS 2 parameter file: a new one, or some parameters of one with every other character left as it is.

A file that a person wrote is more than its values: PyYAML gives the position of each value, and only that text is
replaced. What is not there yet is added at the end of its section.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from fdi_ros.config.config import PARAMETERS, parameters_in, read_parameter_file
from fdi_ros.errors import ConfigError
from fdi_ros.yaml_file import compose_yaml, parse_yaml, read_text

Edit = tuple[int, int, str]
"""Start and end in the text, and what to put there."""
BOM = "\ufeff"
"""Some editors begin a file with this."""
GUESS = "# inspect:"
"""Begins comments of ``fdi inspect`` on values, behind them or above, that are true of these values alone."""
ALIAS = re.compile(r"\s*:\s+(\*[^\s,\[\]{}]+)")
"""Of a value that stands elsewhere, behind its key."""
MARK = "# Calibrated: "
"""Begins the lines at the top that the next change replaces."""


def with_parameters(source: Path, changes: Mapping[str, object], note: str, gone: Sequence[str] = ()) -> str:
    """Return the text of a parameter file with some parameters changed.

    Parameters
    ----------
    source
        The file as it is.
    changes
        ``{"section.field": value}``.
    note
        Lines of comment before the first node: where the values come from.
    gone
        Parameters that are no longer used: taken out with the comments above them, where they have lines of their
        own.

    Raises
    ------
    ConfigError
        If it is no parameter file, or written in a way that cannot be changed in place.
    """
    before = read_text(source, "config", ConfigError)
    read_parameter_file(source)
    text = before.removeprefix(BOM).replace("\r\n", "\n")
    for name in gone:
        text = _without(text, name)
    top = _parameters(compose_yaml(text))
    edits = [edit for name, value in changes.items() for edit in _edits(text, top, name, value)]
    edits += [edit for name in changes if (edit := _stale_above(text, top, name)) is not None]
    sections: dict[str, dict[str, object]] = {}
    for name, value in changes.items():
        if _find_key(top, name) is None:
            section, _, key = name.rpartition(".")
            sections.setdefault(section, {})[key] = value
    # What a section lacks comes before sections that are not there yet: both may begin behind its last line.
    for section in sorted(sections, key=lambda name: bool(name) and _find(top, name) is None):
        edits.append(_addition(text, top, section, sections[section]))
    for _, (start, end, new) in sorted(enumerate(edits), key=lambda one: (one[1][0], one[0]), reverse=True):
        text = text[:start] + new + text[end:]
    text = _noted(text, note)
    _check(source, before, text, changes, gone)
    text = text.replace("\n", "\r\n") if "\r\n" in before else text
    return BOM + text if before.startswith(BOM) else text


def _check(source: Path, before: str, text: str, changes: Mapping[str, object], gone: Sequence[str]) -> None:
    """Refuse what would not be the file with these parameters changed, and no others: aliases, names given twice."""
    was = parse_yaml(before, f"config {source}", ConfigError)
    try:
        now = parse_yaml(text, "config", ConfigError)
        own = {key for key in was if key == "/**" or key.rpartition("/")[2] == "fdi_node"}
        wrong = {key for key in {*was, *now} - own if was.get(key) != now.get(key)}
        expected, found = parameters_in(was, "config"), parameters_in(now, "config")
        expected.update({name: list(v) if isinstance(v, tuple) else v for name, v in changes.items()})
        wrong |= {name for name in {*expected, *found} - {*gone} if expected.get(name) != found.get(name)}
    except ConfigError:
        wrong = set(changes)
    if wrong:
        raise ConfigError(
            f"{source} is written in a way in which {min(wrong)} cannot be changed in place: write its parameters out,"
            " each once, without aliases of whole sections"
        )


def _parameters(root: yaml.MappingNode) -> yaml.MappingNode:
    """Return the mapping of the parameters: the node's own section wins over ``/**``."""
    found = None
    for key, value in root.value:
        if key.value == "/**" or key.value.rpartition("/")[2] == "fdi_node":
            inner = next(part for name, part in value.value if name.value == "ros__parameters")
            found = inner if found is None or key.value != "/**" else found
    return found


def _find(top: yaml.MappingNode, name: str) -> yaml.Node | None:
    """Node of a parameter, nested or flat; None if it is not there."""
    found = _find_key(top, name)
    return None if found is None else found[1]


def _find_key(top: yaml.MappingNode, name: str) -> tuple[yaml.Node, yaml.Node, yaml.MappingNode] | None:
    """Nodes of a parameter's key, of its value and of the mapping that they are in; None if it is not there."""
    for key, value in top.value:
        if key.value == name:
            return key, value, top
        prefix = f"{key.value}."
        if name.startswith(prefix) and isinstance(value, yaml.MappingNode):
            return _find_key(value, name[len(prefix) :])
    return None


def _edits(text: str, top: yaml.MappingNode, name: str, value: object) -> list[Edit]:
    """Replace the value of a parameter that stands there."""
    found = _find_key(top, name)
    if found is None:
        return []
    key, node, _ = found
    if alias := ALIAS.match(text, key.end_mark.index):
        return [(alias.start(1), alias.end(1), value_text(value, 0, 0, wrap=False))]
    start, end = node.start_mark.index, node.end_mark.index
    if text[start] == "&":
        raise ConfigError(f"{name} has an anchor, {text[start:].split()[0]}, and others take its value: write it out")
    if isinstance(node, yaml.SequenceNode) and not node.flow_style and isinstance(value, list):
        return _dashed(text, node, value)
    column = start - (text.rfind("\n", 0, start) + 1)
    indent = len(text[start - column : start]) - len(text[start - column : start].lstrip())
    return [(start, _without_stale(text, end), value_text(value, indent + 2, column))]


def _dashed(text: str, node: yaml.SequenceNode, value: list[object]) -> list[Edit]:
    """Replace the items of a list with dashes, each where it stands: comments between them stay."""
    edits = [
        (item.start_mark.index, _last(item).end_mark.index, _scalar(new))
        for item, new in zip(node.value, value, strict=False)
    ]
    for item in node.value[len(value) :]:
        begin = text.rfind("\n", 0, item.start_mark.index)
        edits.append((begin, _end_of_line(text, _last(item).end_mark.index), ""))
    if more := value[len(node.value) :]:
        at = _end_of_line(text, _last(node).end_mark.index)
        edits.append((at, at, "".join(f"\n{' ' * node.start_mark.column}- {_scalar(new)}" for new in more)))
    return edits


def _without_stale(text: str, end: int) -> int:
    """End of a value with the comment behind it, if that is one of ``fdi inspect`` on the value that goes."""
    line = text[end : _end_of_line(text, end)]
    return end + len(line) if line.lstrip().startswith(GUESS) else end


def _stale_above(text: str, top: yaml.MappingNode, name: str) -> Edit | None:
    """Remove the comment above a parameter, if that is one of ``fdi inspect`` on the value that goes."""
    found = _find_key(top, name)
    if found is None:
        return None
    start = text.rfind("\n", 0, found[0].start_mark.index) + 1
    above = _comments_begin(text, start)
    return (above, start, "") if text[above:start].lstrip().startswith(GUESS) else None


def _without(text: str, name: str) -> str:
    """Take out a parameter; what is written in another way than on lines of its own stays."""
    found = _find_key(_parameters(compose_yaml(text)), name)
    if found is None:
        return text
    key, value, mapping = found
    begin, end = key.start_mark.index, _last(value).end_mark.index
    start = text.rfind("\n", 0, begin) + 1
    named = ALIAS.match(text, key.end_mark.index) or text[value.start_mark.index] == "&"
    if mapping.flow_style or len(mapping.value) == 1 or named or text[start:begin].strip():
        return text
    return text[: _comments_begin(text, start)] + text[_end_of_line(text, end) + 1 :]


def _comments_begin(text: str, at: int) -> int:
    """Begin of the lines of comment that end at the begin of a line."""
    while at and text[text.rfind("\n", 0, at - 1) + 1 : at].lstrip().startswith("#"):
        at = text.rfind("\n", 0, at - 1) + 1
    return at


def _addition(text: str, top: yaml.MappingNode, section: str, values: Mapping[str, object]) -> Edit:
    """Add parameters to a section, or the section to all others."""
    own = _find(top, section) if section else top
    if own is not None and own.flow_style:
        inside = ", ".join(f"{key}: {value_text(value, 0, 0, wrap=False)}" for key, value in values.items())
        at = own.end_mark.index - 1
        follows = bool(own.value) and not text[:at].rstrip().endswith(",")
        return at, at, (", " if follows else "") + inside
    into = top if own is None else own
    indent = into.start_mark.column
    lines = []
    if own is None:
        lines, indent = ["", f"{' ' * indent}{section}:"], indent + 2
    for key, value in values.items():
        lines.append(_parameter_text(key, value, indent))
    at = _end_of_line(text, _last(into).end_mark.index)
    return at, at, "\n" + "\n".join(lines)


def _last(node: yaml.Node) -> yaml.Node:
    """Last scalar or flow collection in a node: where a block ends, its comments would count to it."""
    if isinstance(node, yaml.ScalarNode) or node.flow_style or not node.value:
        return node
    last = node.value[-1]
    return _last(last[1] if isinstance(node, yaml.MappingNode) else last)


def _end_of_line(text: str, at: int) -> int:
    end = text.find("\n", at)
    return len(text) if end < 0 else end


def _parameter_text(key: str, value: object, indent: int) -> str:
    """Write a parameter on lines of its own."""
    return f"{' ' * indent}{key}: {value_text(value, indent + 2, indent + len(key) + 2)}".replace(": \n", ":\n")


def value_text(value: object, indent: int, column: int, wrap: bool = True) -> str:
    """Write a value; a list that is too long for its line goes on below."""
    if not isinstance(value, list):
        return _scalar(value)
    items = [_scalar(item) for item in value]
    flat = "[" + ", ".join(items) + "]"
    if not wrap or column + len(flat) <= 110:
        return flat
    per_line = 3 if len(value) % 3 == 0 else len(value)
    rows = [", ".join(items[k : k + per_line]) for k in range(0, len(value), per_line)]
    return "\n" + textwrap.indent("[" + ",\n ".join(rows) + "]", " " * indent)


def _scalar(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if not isinstance(value, float):
        return str(value)
    text = repr(float(value))
    # Without a point, 1e-05 is a text.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _noted(text: str, note: str) -> str:
    lines = text.rstrip("\n").split("\n")
    first = next(k for k, line in enumerate(lines) if line.strip() and not line.startswith(("#", "---", "%")))
    top = [line for line in lines[:first] if not line.startswith((MARK.rstrip(), GUESS))]
    return "\n".join([*top, *(MARK + line for line in note.splitlines()), *lines[first:]]) + "\n"


def file_text(parameters: Mapping[str, object], comments: Mapping[str, str]) -> str:
    """Return a new parameter file, in the order in which the node describes its parameters."""
    lines = ["/**:", "  ros__parameters:"]
    sections: dict[str, list[str]] = {}
    for name in PARAMETERS:
        if name in parameters:
            section, _, key = name.rpartition(".")
            sections.setdefault(section, []).append(key)
    for section, keys in sections.items():
        indent = 6 if section else 4
        lines += ["", f"    {section}:"] if section else []
        for key in keys:
            name = f"{section}.{key}" if section else key
            lines += _entry(key, parameters[name], comments.get(name, ""), indent)
    return "\n".join(lines) + "\n"


def _entry(key: str, value: object, comment: str, indent: int) -> list[str]:
    """Lines of one parameter; what does not fit beside it stands above it."""
    value = list(value) if isinstance(value, tuple) else value
    text = _parameter_text(key, value, indent)
    if not comment:
        return text.splitlines()
    if "\n" in text or len(text) + len(comment) > 110:
        return [f"{' ' * indent}# {comment}", *text.splitlines()]
    return [f"{text} # {comment}"]
