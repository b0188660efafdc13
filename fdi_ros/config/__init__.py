# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of a monitor, from one ROS 2 parameter file."""
