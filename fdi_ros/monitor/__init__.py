# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A running monitor: from the settings to its records, through the sample path, to reports and what it keeps."""
