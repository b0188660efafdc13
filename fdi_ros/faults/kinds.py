"""Faults to be injected: what kinds there are, and their description on the command line and in scenario files.

Both are validated in one place, `fault_from`. Times are seconds from the first sample of the stream, so that a
fault strikes at the same sample whatever part of a recording is replayed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from fdi_ros.errors import FaultError
from fdi_ros.yaml_file import read_yaml


@dataclass(frozen=True)
class Option:
    """One number that a kind of fault takes."""

    unit: str
    low: float
    high: float
    default: float | None = None
    """None: it must be given, unless `optional`."""
    optional: bool = False
    whole: bool = False


@dataclass(frozen=True)
class Kind:
    """One kind of fault: what it does, and the numbers it takes."""

    meaning: str
    options: Mapping[str, Option]


_RATE = Option("rad/s", -100.0, 100.0)
_POSITIVE_RATE = Option("rad/s", 1e-9, 100.0)

KINDS: dict[str, Kind] = {
    "bias": Kind("adds size", {"size": _RATE}),
    "drift": Kind("adds size times the time since start", {"size": Option("rad/s^2", -10.0, 10.0)}),
    "scale": Kind("multiplies by 1 + size", {"size": Option("", -10.0, 10.0)}),
    "stuck": Kind("repeats size, or without size the last value", {"size": Option("rad/s", -100, 100, optional=True)}),
    "dropout": Kind(
        "gives NaN; with missing=1 gives nothing", {"missing": Option("", 0.0, 1.0, default=0.0, whole=True)}
    ),
    "intermittent": Kind(
        "adds size for the share duty of every period",
        {
            "size": _RATE,
            "period": Option("s", 1e-3, 3600.0, default=1.0),
            "duty": Option("", 1e-3, 0.999, default=0.5),
        },
    ),
    "noise": Kind("adds white noise of standard deviation size", {"size": _POSITIVE_RATE}),
    "spike": Kind(
        "adds size with either sign to single samples, rate times a second on average",
        {"size": _POSITIVE_RATE, "rate": Option("1/s", 1e-3, 1e4, default=1.0)},
    ),
    "saturation": Kind("clips at +-size", {"size": _POSITIVE_RATE}),
    "sign": Kind("reverses the sign", {}),
    "delay": Kind("gives what it measured size samples ago", {"size": Option("samples", 1, 100_000, whole=True)}),
    "oscillation": Kind(
        "adds a sine of amplitude size", {"size": _POSITIVE_RATE, "frequency": Option("Hz", 1e-3, 1e4, default=1.0)}
    ),
    "triad_loss": Kind("the unit, three channels, gives nothing", {}),
}
"""Every kind of fault by name."""


@dataclass(frozen=True)
class Fault:
    """One fault, validated.

    Attributes
    ----------
    channel
        A channel (``imu_2.y``), a unit (``imu_2``: all its channels), or several of these with commas.
    kind
        A key of `KINDS`; the other numbers are its options.
    start, stop
        Seconds from the first sample; active where start <= t < stop.
    seed
        Of the random kinds.

    Raises
    ------
    FaultError
        If a value is missing, out of range, or not taken by this kind.
    """

    channel: str
    kind: str
    start: float = 0.0
    stop: float = math.inf
    seed: int = 0
    size: float | None = None
    missing: float | None = None
    period: float | None = None
    duty: float | None = None
    rate: float | None = None
    frequency: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FaultError(f"unknown fault kind {self.kind!r}, expected one of: {', '.join(KINDS)}")
        if not (math.isfinite(self.start) and self.start >= 0):
            raise FaultError(f"fault {self.kind}: start is {self.start:g} s, expected 0 or more")
        if not self.stop > self.start:
            raise FaultError(f"fault {self.kind}: stop is {self.stop:g} s, expected more than start {self.start:g} s")
        if self.seed < 0:
            raise FaultError(f"fault {self.kind}: seed is {self.seed}, expected 0 or more")
        options = KINDS[self.kind].options
        for name in _OPTION_NAMES:
            value = getattr(self, name)
            if name in options:
                object.__setattr__(self, name, _checked(self.kind, name, options[name], value))
            elif value is not None:
                raise FaultError(f"fault {self.kind} takes no {name}, only: {', '.join(_keys(self.kind))}")

    def channels(self, channel_names: Sequence[str]) -> tuple[int, ...]:
        """Find the indices of the channels it strikes.

        Raises
        ------
        FaultError
            If there is no such channel or unit; the message lists the channels.
        """
        struck: list[int] = []
        for name in self.channel.split(","):
            found = [i for i, known in enumerate(channel_names) if name == known or known.startswith(f"{name}.")]
            if not found:
                raise FaultError(f"fault on unknown channel {name!r}, expected one of: {', '.join(channel_names)}")
            struck += [i for i in found if i not in struck]
        if self.kind == "triad_loss" and len(struck) != 3:
            raise FaultError(f"fault triad_loss on {self.channel!r} strikes {len(struck)} channels, expected 3")
        return tuple(struck)

    def __str__(self) -> str:
        default = {f.name: f.default for f in fields(self)}
        items = ((f.name, getattr(self, f.name)) for f in fields(self))
        given = [(name, value) for name, value in items if value != default[name] or name == "start"]
        return " ".join(
            f"{name}={value:.12g}" if isinstance(value, float) else f"{name}={value}" for name, value in given
        )


_OPTION_NAMES = tuple(f.name for f in fields(Fault))[5:]


def _keys(kind: str) -> tuple[str, ...]:
    return ("channel", "kind", "start", "stop", "seed", *KINDS[kind].options)


def _checked(kind: str, name: str, option: Option, value: float | None) -> float | None:
    if value is None:
        if option.default is None and not option.optional:
            raise FaultError(f"fault {kind} needs {name}" + (f" in {option.unit}" if option.unit else ""))
        return option.default
    unit = f" {option.unit}" if option.unit else ""
    if not option.low <= value <= option.high:
        raise FaultError(f"fault {kind}: {name} is {value:g}{unit}, expected {option.low:g} to {option.high:g}{unit}")
    if option.whole and not float(value).is_integer():
        raise FaultError(f"fault {kind}: {name} is {value:g}{unit}, expected a whole number")
    if value == 0 and name == "size" and kind != "stuck":
        raise FaultError(f"fault {kind}: size is 0{unit}, which changes nothing")
    return float(value)


def fault_from(items: Mapping[str, Any]) -> Fault:
    """Build a fault from names and values, as a scenario file or the command line gives them.

    Raises
    ------
    FaultError
        If a name is unknown or a value does not fit.
    """
    known = [f.name for f in fields(Fault)]
    for name in items:
        if name not in known:
            raise FaultError(f"fault has unknown key {name!r}, expected one of: {', '.join(known)}")
    for name in ("channel", "kind"):
        if not isinstance(items.get(name), str) or not items[name]:
            raise FaultError(f"fault needs {name}, got: {dict(items)}")
    numbers = {name: _number(name, value) for name, value in items.items() if name not in ("channel", "kind")}
    return Fault(items["channel"], items["kind"], **numbers)


def _number(name: str, value: Any) -> Any:
    try:
        number = float(value)
        if name == "seed":
            number = int(str(value))
    except (TypeError, ValueError) as error:
        raise FaultError(f"fault: {name} is {value!r}, expected a number") from error
    if math.isnan(number):
        raise FaultError(f"fault: {name} is {value!r}, expected a number")
    return number


def parse_fault(text: str) -> Fault:
    """Read a fault from the command line: ``channel=imu_2.y kind=bias size=0.2 start=30 stop=60``.

    Raises
    ------
    FaultError
        If it is not of that form.
    """
    items: dict[str, str] = {}
    for word in text.split():
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise FaultError(f"fault {text!r}: {word!r} is not of the form key=value")
        if name in items:
            raise FaultError(f"fault {text!r}: {name} is given twice")
        items[name] = value
    return fault_from(items)


def load_scenario(path: str | Path) -> tuple[Fault, ...]:
    """Read the faults of a scenario file: a mapping with a list ``faults``.

    Raises
    ------
    FaultError
        If the file is missing, is no scenario, or a fault in it is wrong.
    """
    document = read_yaml(path, "scenario", FaultError)
    entries = document.get("faults") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise FaultError(f"scenario {path} has no list 'faults'")
    faults = []
    for number, entry in enumerate(entries, 1):
        if not isinstance(entry, dict):
            raise FaultError(f"scenario {path}, fault {number}: expected keys and values, got {entry!r}")
        try:
            faults.append(fault_from(entry))
        except FaultError as error:
            raise FaultError(f"scenario {path}, fault {number}: {error}") from error
    return tuple(faults)
