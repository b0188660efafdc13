# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMUs of PX4 and ArduPilot over MAVLink: the messages, the clock, the link and the conversation, without ROS."""
