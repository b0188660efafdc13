# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file of faults that are injected into every flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fdi_ros.errors import FaultError
from fdi_ros.sweep.plan import DEFAULT_FAULTS, Plan, parse_swept
from fdi_ros.yaml_file import read_yaml

_LIMITS: dict[str, tuple[type[int] | type[float], float, float]] = {
    "times": (int, 1, 1000),
    "within": (float, 0.01, 3600.0),
    "seed": (int, 0, 2**31 - 1),
}


def load_injection(path: Path) -> Plan:
    """Read what is injected: a mapping with any of ``faults``, ``times``, ``within`` (s) and ``seed``.

    ``faults`` lists texts as ``fdi sweep --fault`` takes them, ``kind=bias size=0.05,0.1``; default: those of a sweep.

    Raises
    ------
    FaultError
        If it is missing, or holds something else.
    """
    document = read_yaml(path, "study", FaultError)
    if not isinstance(document, dict):
        raise FaultError(f"study {path}: expected keys and values")
    if unknown := sorted(set(map(str, document)) - {"faults", *_LIMITS}):
        raise FaultError(f"study {path}: unknown key {unknown[0]!r}, expected: faults, {', '.join(_LIMITS)}")
    texts = document.get("faults", list(DEFAULT_FAULTS))
    if not isinstance(texts, list) or not texts or not all(isinstance(text, str) for text in texts):
        raise FaultError(f"study {path}: faults is no list of texts such as 'kind=bias size=0.05,0.1'")
    numbers = {name: _number(path, name, document[name]) for name in _LIMITS if name in document}
    return Plan(tuple(dict.fromkeys(one for text in texts for one in parse_swept(text))), **numbers)


def _number(path: Path, name: str, value: Any) -> Any:
    kind, low, high = _LIMITS[name]
    if isinstance(value, bool) or not isinstance(value, int | kind) or not low <= float(value) <= high:
        raise FaultError(f"study {path}: {name} is {value!r}, expected {low:g} to {high:g}")
    return kind(value)
