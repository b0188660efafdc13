# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Memory that is given back."""

import gc
import weakref

from fdi_ros.system.memory import give_back


class Circle:
    """Refers to itself, as publishers of rclpy do."""

    def __init__(self) -> None:
        self.self = self


def test_what_only_refers_to_itself_is_given_back() -> None:
    gc.disable()
    try:
        seen = weakref.ref(Circle())
        assert seen() is not None
        give_back()
        assert seen() is None
    finally:
        gc.enable()
