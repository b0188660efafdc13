# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a sweep injects: kinds and sizes of faults, as given on the command line, how often and for how long."""

from __future__ import annotations

from dataclasses import dataclass

from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Fault, fault_from, key_values
from fdi_ros.faults.kinds import KINDS

DEFAULT_FAULTS = (
    "kind=bias size=0.005,0.01,0.02,0.05,0.1,0.2,0.5",
    "kind=drift size=0.005,0.01,0.02,0.05",
    "kind=noise size=0.05,0.2",
    "kind=scale size=0.05,0.2",
    "kind=stuck",
    "kind=dropout",
)
"""What is swept unless asked otherwise; sizes in rad/s, rad/s^2, and as a share of the rate."""


@dataclass(frozen=True)
class Swept:
    """One kind of fault in one size."""

    kind: str
    items: tuple[tuple[str, str], ...]
    """Its numbers by name, as given."""

    @property
    def size(self) -> float | None:
        """Its size; None: the kind has none."""
        return next((float(value) for name, value in self.items if name == "size"), None)

    @property
    def words(self) -> str:
        """As a title: kind, size and unit, other numbers."""
        size = [] if self.size is None else [f"{self.size:g} {self.unit}".strip()]
        return " ".join([self.kind, *size, *self._others])

    @property
    def unit(self) -> str:
        """Of its size."""
        option = KINDS[self.kind].options().get("size")
        return option.unit if option else ""

    @property
    def family(self) -> str:
        """What it shares with the same fault in other sizes."""
        return " ".join([self.kind, *self._others])

    @property
    def _others(self) -> list[str]:
        return [f"{name}={value}" for name, value in self.items if name != "size"]

    def fault(self, channel: str, start: float, sign: float, seed: int) -> Fault:
        """Return the fault on a channel from a time on, s; the size of a kind that may have either sign gets it."""
        items: dict[str, object] = {
            "channel": channel,
            "kind": self.kind,
            "start": start,
            "seed": seed,
            **dict(self.items),
        }
        if self.size is not None and KINDS[self.kind].has_signed_size():
            items["size"] = sign * self.size
        return fault_from(items)


def parse_swept(text: str) -> tuple[Swept, ...]:
    """Read what is to be swept: ``kind=bias size=0.05,0.1,0.3``, one entry per size.

    Raises
    ------
    FaultError
        If it is not of that form, or a number does not fit its kind.
    """
    items = key_values(text)
    for name in items:
        if name in ("channel", "start", "stop", "seed"):
            raise FaultError(f"fault {text!r}: {name} is chosen by the sweep")
    kind = items.pop("kind", "")
    if kind in KINDS and KINDS[kind].whole_unit:
        raise FaultError(f"fault {kind} strikes a whole unit; a sweep strikes one channel at a time")
    sizes = items.pop("size", "").split(",")
    found = tuple(Swept(kind, (*([("size", size)] if size else []), *items.items())) for size in dict.fromkeys(sizes))
    for one in found:
        fault_from({"channel": "any", "kind": kind, **dict(one.items)})
        if one.size is not None and one.size < 0 and KINDS[kind].has_signed_size():
            raise FaultError(f"fault {kind}: size is {one.size:g}, expected more than 0: signs are drawn")
    return tuple(sorted(found, key=lambda one: one.size or 0.0))


@dataclass(frozen=True)
class Plan:
    """What is injected, when, and how long it is watched."""

    faults: tuple[Swept, ...]
    times: int = 10
    """Spread over the recording, for every channel."""
    within: float = 5.0
    """A fault is watched, and is to be found, for this long, s."""
    seed: int = 1
    """Of signs and of the random kinds."""
