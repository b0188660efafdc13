# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the sensors are: their axes, their errors, one block of their samples."""
