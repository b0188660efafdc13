# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a recording holds, what it is fit for, and settings to start from."""
