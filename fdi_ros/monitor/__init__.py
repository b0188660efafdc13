# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What to do about it: health of each channel, decisions over time, the fused rate, the pipeline."""
