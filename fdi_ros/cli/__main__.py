# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``python -m fdi_ros.cli``: the command line where no script is installed."""

import sys

from fdi_ros.cli.command_line import main

sys.exit(main())
