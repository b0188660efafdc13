# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies of detectors: a class and a row of `PROTOCOLS` a kind of trial."""

PROTOCOLS = {
    "residual_search": "residual_search:ResidualSearch",
    "snapshot": "white_noise:Snapshot",
    "delay": "white_noise:Delay",
    "flight": "flight:Flight",
}
"""Module and class of each trial protocol, by the name of its section in a study."""
