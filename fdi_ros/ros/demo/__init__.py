# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The demo: the real node in a process of its own, a recorded flight played to it over DDS, a fault on the way.

The fault is not in the recording. It is added to the channel before the message is published, so the node sees what
it would see of a gyro that goes bad in flight.
"""
