# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The content of a recording, its fitness for a monitor, and settings to start from."""
