# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line: `command_line` declares the verbs, the other modules run them."""

STOPPED = 130
"""Exit code after a signal, as a shell reports it after an interrupt."""
