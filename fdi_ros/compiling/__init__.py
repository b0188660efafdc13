# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compiling with Numba, and the records that compiled code works on."""
