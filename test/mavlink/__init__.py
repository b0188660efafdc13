# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tests of the MAVLink link; a package, as `benchmark/mavlink.py` would stand in the way of a folder without this."""
