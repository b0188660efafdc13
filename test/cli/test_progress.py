# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The progress bar."""

import io
import time

from fdi_ros.cli.console import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_sees_a_bar_that_is_wiped_in_the_end():
    with Progress(stream := Terminal()) as progress:
        progress.show(0.25)
        time.sleep(0.11)
        progress.show(0.5)
    assert " 50 %|" in stream.getvalue()
    assert stream.getvalue().endswith(" \r")
    assert "\n" not in stream.getvalue()


def test_what_has_no_share_done_says_what_it_is_and_for_how_long():
    with Progress(stream := Terminal()) as progress, progress.during("fitting"):
        pass
    assert "fitting, 00:00" in stream.getvalue()
    assert "\n" not in stream.getvalue()


def test_nothing_else_sees_anything():
    for stream, quiet in ((io.StringIO(), False), (Terminal(), True)):
        with Progress(stream, quiet) as progress:
            progress.show(0.5)
            with progress.during("fitting"):
                pass
        assert stream.getvalue() == ""
