# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies of detectors: a class for each kind of trial, a row for each in `PROTOCOLS`."""

PROTOCOLS = {
    "residual_search": "residual_search:ResidualSearch",
    "snapshot": "white_noise:Snapshot",
    "delay": "white_noise:Delay",
    "flight": "flight:Flight",
}
"""Modules, in this package, and classes of the trial protocols, by the name of their section in a study."""
