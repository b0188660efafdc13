# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path: records of fixed size and compiled functions over them, one sample at a time."""
