# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults of many kinds and sizes in the user's own recording."""
