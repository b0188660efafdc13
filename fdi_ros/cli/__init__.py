# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line: `command_line` declares the verbs, the other modules run them."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of ``fdi`` beside those of a verdict."""

    #: done, or the verdict is good
    DONE = 0
    #: a replay does not meet its ``--check``
    UNMET = 1
    #: wrong arguments or input
    REFUSED = 2
    #: a defect of fdi: EX_SOFTWARE of sysexits.h
    DEFECT = 70
    #: a signal, as a shell reports it after an interrupt
    STOPPED = 130
