# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Building blocks of pages and tables: sections, plots, long series, text tables, units."""
