# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""YAML files, read within limits and with plain values only."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, ClassVar

import yaml

from fdi_ros.errors import FdiError
from fdi_ros.system import shipped_files
from fdi_ros.system.files import YAML, open_regular
from fdi_ros.system.text import shown

try:
    from yaml import CSafeLoader as _SafeLoader
except ImportError:  # PyYAML built without libyaml
    from yaml import SafeLoader as _SafeLoader


class _Refused(yaml.YAMLError):  # type: ignore[misc]
    """Valid YAML beyond the limits of this package."""

    def __init__(self, mark: Any, words: str) -> None:
        super().__init__(f"line {mark.line + 1}: {words}")


_KINDS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_TAG = "tag:yaml.org,2002:"


class _Loader(_SafeLoader):  # type: ignore[misc]
    """Loader for the types of a ROS 2 parameter file; no dates, binary data or big integers."""

    yaml_implicit_resolvers: ClassVar = {
        first: [
            (tag, pattern)
            for tag, pattern in resolvers
            if tag.removeprefix(_TAG) in _KINDS
        ]
        for first, resolvers in _SafeLoader.yaml_implicit_resolvers.items()
    }
    yaml_constructors: ClassVar = {
        tag: function
        for tag, function in _SafeLoader.yaml_constructors.items()
        if tag is None or tag.removeprefix(_TAG) in _KINDS
    }

    def number(self, node: yaml.Node) -> int | float:
        """Value of a number."""
        text = self.construct_scalar(node)
        if len(text) > YAML.digits:
            raise _Refused(
                node.start_mark,
                f"a number of {len(text)} characters, expected at most {YAML.digits}",
            )
        kind = node.tag.removeprefix(_TAG)
        try:
            value: int | float = (
                self.construct_yaml_int(node)
                if kind == "int"
                else self.construct_yaml_float(node)
            )
        except (ValueError, IndexError, OverflowError) as error:
            raise _Refused(node.start_mark, f"{text!r} is no {kind}") from error
        if kind == "int" and not -(2**63) <= value < 2**64:
            raise _Refused(node.start_mark, f"{text} does not fit into 64 bits")
        return value

    def truth(self, node: yaml.Node) -> bool:
        """Value of true or false."""
        try:
            return bool(self.construct_yaml_bool(node))
        except KeyError as error:
            raise _Refused(
                node.start_mark, f"{node.value!r} is neither true nor false"
            ) from error


_Loader.add_constructor(f"{_TAG}int", _Loader.number)
_Loader.add_constructor(f"{_TAG}float", _Loader.number)
_Loader.add_constructor(f"{_TAG}bool", _Loader.truth)


def read_yaml(path: str | Path, what: str, error: type[FdiError]) -> Any:
    """Read a YAML file within limits.

    ``what`` and the path name the file in errors, which are of class ``error``:
    unreadable, not YAML, or beyond the limits.
    """
    try:
        with open_regular(path) as file:
            data = file.read(YAML.length + 1)
        if len(data) > YAML.length:
            raise error(f"{what} {path} is longer than {YAML.length} bytes")
        text = data.decode("utf-8")
    except UnicodeDecodeError as refused:
        raise error(f"{what} {path} is not YAML: {refused}") from refused
    except FileNotFoundError as refused:
        raise error(
            f"cannot read {what} {path}: {refused.strerror}{_meant(Path(path))}"
        ) from refused
    except (OSError, ValueError) as refused:
        raise error(
            f"cannot read {what} {path}: {getattr(refused, 'strerror', None) or refused}"
        ) from refused
    return parse_yaml(text, f"{what} {path}", error)


def _meant(path: Path) -> str:
    """Return a hint to the file of a similar name, in the same folder or shipped, or nothing."""
    names = {
        file.stem: file.name
        for file in (*path.parent.glob("*.yaml"), *shipped_files())
        if file.suffix == ".yaml"
    }
    close = difflib.get_close_matches(path.stem, names, n=1)
    return f", did you mean {shown(names[close[0]])!r}?" if close else ""


def parse_yaml(text: str, called: str, error: type[FdiError]) -> Any:
    """Parse a YAML text. ``called`` names the text in errors of class ``error``."""
    try:
        _check_size(text)
        # The loader is derived from the safe one.
        return yaml.load(text, Loader=_Loader)
    except _Refused as refused:
        raise error(f"{called}, {refused}") from refused
    except yaml.YAMLError as refused:
        raise error(f"{called} is not YAML: {_problem(refused)}") from refused


def _problem(refused: yaml.YAMLError) -> str:
    """Describe a YAML error by its line and column."""
    if not isinstance(refused, yaml.MarkedYAMLError) or refused.problem_mark is None:
        return " ".join(str(refused).replace(' in "<unicode string>"', "").split())
    mark = refused.problem_mark
    why = ", ".join(filter(None, (refused.context, refused.problem)))
    return " ".join(f"line {mark.line + 1}, column {mark.column + 1}: {why}".split())


class _Collection:
    """A sequence or mapping whose end has not been read yet."""

    def __init__(self, event: yaml.CollectionStartEvent, before: int) -> None:
        self.anchor: str | None = event.anchor
        self.before = before  #: number of values before this collection
        self._mapping = isinstance(event, yaml.MappingStartEvent)
        self._keys: set[str] = set()
        self._children = 0

    def add(self, event: yaml.NodeEvent) -> None:
        """Take the next child. A mapping alternates keys and values, and keys must differ."""
        is_key = self._mapping and self._children % 2 == 0
        self._children += 1
        if not is_key or not isinstance(event, yaml.ScalarEvent):
            return
        if event.value in self._keys:
            raise _Refused(
                event.start_mark, f"the key {shown(event.value)!r} is given twice"
            )
        self._keys.add(event.value)


def _check_size(text: str) -> None:
    """Refuse deep nesting, too many values with aliases followed, and repeated keys."""
    sizes: dict[str, int] = {}
    outer: list[_Collection] = []
    count = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            ended = outer.pop()
            anchor = ended.anchor
            before = ended.before
        elif isinstance(event, yaml.NodeEvent):
            if outer:
                outer[-1].add(event)
            anchor = event.anchor
            before = count
            alias = isinstance(event, yaml.AliasEvent)
            if alias and event.anchor not in sizes:
                raise _Refused(
                    event.start_mark,
                    f"the alias *{event.anchor} stands for nothing before it",
                )
            count += sizes[event.anchor] if alias else 1
        else:
            continue
        if isinstance(event, yaml.CollectionStartEvent):
            outer.append(_Collection(event, before))
        elif anchor:
            sizes[anchor] = count - before
        if len(outer) > YAML.depth:
            raise _Refused(event.start_mark, f"nested deeper than {YAML.depth}")
        if count > YAML.nodes:
            raise _Refused(
                event.start_mark, f"more than {YAML.nodes} values, aliases followed"
            )
