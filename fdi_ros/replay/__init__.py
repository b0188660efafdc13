# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording through the pipeline: run, evaluated, checked, written, reported."""
