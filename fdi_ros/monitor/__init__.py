# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A running monitor: from settings to records, through the sample path, to reports and saved state."""
