# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording to settings: inspection, mounts, calibration, proof; and what a mounting can do."""
