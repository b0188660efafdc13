# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names of flight modes from the numbers that autopilots log."""

from __future__ import annotations

from fdi_ros.mavlink.vehicle import dialect
from fdi_ros.system import there

_PX4_MAIN = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    4: "AUTO",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
}
_PX4_AUTO = {2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND"}
_PX4_NAVIGATION = {
    0: "MANUAL",
    1: "ALTCTL",
    2: "POSCTL",
    3: "AUTO MISSION",
    4: "AUTO LOITER",
    5: "AUTO RTL",
    10: "ACRO",
    12: "DESCEND",
    13: "TERMINATION",
    14: "OFFBOARD",
    15: "STABILIZED",
    17: "AUTO TAKEOFF",
    18: "AUTO LAND",
    19: "FOLLOW",
    20: "PRECISION LAND",
    21: "ORBIT",
}
VEHICLES = {
    **dict.fromkeys((2, 3, 4, 13, 14, 15, 29), "Copter"),
    **dict.fromkeys((1, 16, 19, 20, 21, 22, 23, 24, 25), "Plane"),
    **dict.fromkeys((10, 11), "Rover"),
    12: "Sub",
}
"""ArduPilot's vehicle by MAV_TYPE."""


def ardupilot_mode(vehicle: str, number: int) -> str:
    """Return the name of a mode of ArduPilot: ALT_HOLD, or its number without a name.

    ``vehicle``: Copter, Plane, Rover or Sub. Empty: not known.
    """
    if vehicle and there("pymavlink"):
        prefix = f"{vehicle.upper()}_MODE"
        entry = dialect().enums.get(prefix, {}).get(number)
        if entry is not None and not entry.name.endswith("ENUM_END"):
            return str(entry.name.removeprefix(f"{prefix}_"))
    return f"mode {number}"


def px4_heartbeat_mode(custom_mode: int) -> str:
    """Return the name of the mode in a HEARTBEAT of PX4."""
    main = custom_mode >> 16 & 0xFF
    sub = custom_mode >> 24 & 0xFF
    name = _PX4_MAIN.get(main, f"mode {main}")
    is_auto = main == 4 and sub in _PX4_AUTO
    return f"{name} {_PX4_AUTO[sub]}" if is_auto else name


def px4_navigation_mode(nav_state: int) -> str:
    """Return the name of ``vehicle_status.nav_state``."""
    return _PX4_NAVIGATION.get(nav_state, f"mode {nav_state}")
