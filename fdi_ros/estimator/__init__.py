# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What sensors do wrong, estimated: bias, scale, misalignment, delays, and the noise of the moment."""
