# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line: one module declares all verbs, the others have what they do, by kind."""

STOPPED = 130  # exit code, as a shell has it of what the keyboard has interrupted
