"""The progress bar."""

import io

from fdi_ros.bag.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_sees_a_bar_that_is_wiped_in_the_end():
    with Progress(stream := Terminal()) as progress:
        progress.show(0.5)
    assert stream.getvalue() == "\r[" + 20 * "#" + 20 * " " + "]  50 %" + "\r\x1b[K"


def test_nothing_else_sees_anything():
    with Progress(stream := io.StringIO()) as progress:
        progress.show(0.5)
    assert stream.getvalue() == ""
