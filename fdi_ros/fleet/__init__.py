# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Replays of many recordings: tables of flights and episodes, and a page of flights that need attention."""
