# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings: opened, read in bounded memory and decoded to samples."""
