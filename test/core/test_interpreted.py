# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path as plain Python, for a debugger: slow, and the same to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys
import numpy as np
from fdi_ros.core.compiled import INTERPRETED
from fdi_ros.config.config import Config
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.faults.fault import parse_fault
from fdi_ros.faults.injection import Injector

bag, config, out, *names = sys.argv[1:]
for name in names:
    settings = Config.from_file(config, {"detector.name": name, "bias.startup_bias_duration": 1.0,
                                         "decision.latch": False, "decision.clean_time": 0.3,
                                         "bias.max_rest_rate": 10.0})
    pipeline = Pipeline.from_config(settings)
    injector = Injector([parse_fault("channel=g3 kind=bias size=0.1 start=1.6 stop=2.2"),
                         parse_fault("channel=g5 kind=dropout start=1.9 stop=2.1"),
                         parse_fault("channel=g1 kind=stuck start=2.3")], pipeline.channel_names)
    rows, events = [], []
    with Recording(bag) as recording:
        samples = Samples(recording, settings, pipeline.geometry.n, end=2.9)
        for block in samples.blocks():
            injector.start_stamp = samples.origin
            output = pipeline.process(injector.apply(block))
            rows += [np.ascontiguousarray(output.rows[name]).tobytes() for name in output.rows.dtype.names]
            events += map(repr, output.events)
    with open(f"{out}_{name}", "wb") as file:
        file.write(b"".join(rows) + "\\n".join(events).encode())
    print(INTERPRETED, len(events))
"""
NAMES = ("likelihood_ratio", "cusum", "sequential")


def test_short_replay_is_equal_to_the_bit(flight: Path, root: Path, tmp_path: Path) -> None:
    said = []
    for interpreted in ("0", "1"):
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT, flight, root / "config" / "two_triads.yaml", tmp_path / interpreted, *NAMES],
            env={**os.environ, "NUMBA_DISABLE_JIT": interpreted},
            cwd=root,
            text=True,
            capture_output=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr
        said.append(run.stdout.split())
    compiled, plain = said
    assert (compiled[::2], plain[::2]) == (["False"] * 3, ["True"] * 3)
    assert compiled[1::2] == plain[1::2]
    assert min(map(int, plain[1::2])) > 10
    for name in NAMES:
        assert (tmp_path / f"0_{name}").read_bytes() == (tmp_path / f"1_{name}").read_bytes(), name
