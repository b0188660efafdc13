# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What happened in a recording: episodes instead of changes of state, told once for every verb."""
