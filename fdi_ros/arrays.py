# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Types of arrays, by what they hold; shapes stand where an array is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Int = NDArray[np.int64]
Bytes = NDArray[np.uint8]
