# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The methods of papers and textbooks, one sample at a time, for comparison; what flies is `detectors.sequential`."""
