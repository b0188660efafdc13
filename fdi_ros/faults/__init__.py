# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults of gyros, and their injection into samples and messages."""
