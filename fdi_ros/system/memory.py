# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Memory that the C library has got back from the program, and keeps."""

from __future__ import annotations

import ctypes
import gc


def give_back() -> None:
    """Return freed memory to the system, where the C library can (glibc). Takes some 10 ms.

    Loading compiled code and building a monitor free some 100 MB in small pieces, which
    glibc keeps for later, in a pool for each thread. Publishers and subscriptions of rclpy
    refer to themselves in circles, and hold the buffers of a monitor until Python looks for
    such circles.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))
