# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Live: the nodes. Only this package imports rclpy and message packages."""
