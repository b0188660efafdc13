# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What was declared against what was injected, in one vocabulary for replay, sweep, fleet and studies."""
