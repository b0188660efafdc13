# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Many recordings judged by one pipeline: a dataset of flights and events, and a page of what to look at."""
