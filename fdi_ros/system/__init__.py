# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The computer around: files and their limits, text from outside, what is installed, processes that share the work."""
