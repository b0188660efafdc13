# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover: which IMUs of an ArduPilot are to be in use, and why."""
