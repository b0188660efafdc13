# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path as plain Python, for a debugger: slow, and the same to the bit."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from detectors.detector_trials import VARIANTS, usual_geometry
from detectors.detector_trials import sound as healthy
from monitor.streams import config, run

from fdi_ros import NoiseModel, create_detector
from fdi_ros.compiling.compiled import INTERPRETED
from fdi_ros.core.alignment import Alignment, as_block
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate
from fdi_ros.detectors.papers import single_fault
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.sources.channels import ChannelsSource
from fdi_ros.sources.imus import ImuSource

FAULTS = (
    "channel=g3 kind=bias size=0.1 start=0.6 stop=0.9",
    "channel=g5 kind=dropout start=0.8 stop=0.9",
    "channel=g1 kind=stuck start=1.0",
)


def digest(parts: list[np.ndarray | bytes]) -> str:
    return hashlib.sha256(b"".join(np.asarray(part).tobytes() for part in parts)).hexdigest()


def messages() -> tuple[str, int]:
    """Of messages that are whole, damaged and cut off; and how many of the last kind could be read."""
    rng, made, rows = np.random.default_rng(5), [], []
    for k in range(80):
        for row in (
            ImuTemplate("x" * (k % 9)).fill(5**k % 2**60, rng.normal(size=3), np.arange(9.0)),
            ChannelsTemplate(6).fill(rng.normal(size=6)),
        ):
            made.append(bytes(row))
            damaged = bytearray(row)
            damaged[k % 20] = rng.choice([0, 1, 255, damaged[k % 20]])
            rows.append(bytes(damaged[: len(damaged) - k % 2]))
    length = np.array([len(row) for row in rows])
    packed = np.frombuffer(b"".join(rows), np.uint8), length.cumsum() - length, length
    imus, arrays = ImuSource.decode(*packed, 3), ChannelsSource.decode(*packed, 6)
    return digest([*made, *imus, *arrays]), int(arrays.good.sum())


def alignment() -> tuple[str, int]:
    """Of stamps that jump, repeat and go back; and how many samples they gave."""
    rng, parts, count = np.random.default_rng(5), [], 0
    for units in (2, 3, 4):
        aligner = Alignment(units, 3, 25)
        stamp = np.cumsum(rng.integers(-1, 4, 150)) + rng.choice([0, 0, 0, 0, 40, -200], 150).cumsum() // 2
        rate = rng.normal(size=(150, 3))
        rate[::17] = np.nan
        for block in (aligner.push_block(rng.integers(0, units, 150), stamp, rate), as_block(aligner.flush(), units)):
            parts += [block.stamp, block.z, block.delivered]
            count += len(block)
        parts.append(aligner.rows)
    return digest(parts), count


def flight(detector: str) -> tuple[str, int]:
    """Of three faults in a short flight; and how many events there were."""
    biases = {"bias__startup_bias_duration": 0.3, "bias__max_rest_rate": 10.0}
    decision = {"decision__latch": False, "decision__clean_time": 0.2}
    pipeline = Pipeline(config(detector__name=detector, noise__scale_std=0.002, **biases, **decision))
    _, output = run(pipeline, 140, *FAULTS, size=0.02)
    columns = [output.rows[name] for name in output.rows.dtype.names]
    return digest([*columns, "\n".join(map(repr, output.events)).encode()]), len(output.events)


def verdicts() -> tuple[str, int]:
    """Of all variants of all detectors, after fewer trials at their making than usual; and how many alarms."""
    parts, alarms = [], 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(single_fault, "TRIALS", 2)
        for name, options in VARIANTS:
            for noise in (NoiseModel(1e-3, bound=1e-3), NoiseModel(1e-3, 2e-3, 3e-4, bound=4e-3)):
                detector = create_detector(name, usual_geometry(name), noise, **options)
                z, acceleration = healthy(np.random.default_rng(21), detector.geometry, noise, 8)
                z[2:, 0] += 0.5
                z[6:, 1] = np.nan
                verdict = detector.detect(z, acceleration)
                parts += verdict
                alarms += int(verdict.alarm.sum())
    return digest(parts), alarms


def digests() -> dict[str, list[str | int]]:
    found = {"messages": messages(), "alignment": alignment(), "verdicts": verdicts()}
    found |= {name: flight(name) for name in ("likelihood_ratio", "sequential")}
    return {name: list(one) for name, one in found.items()}


def test_plain_python_gives_the_same_bits(root: Path) -> None:
    path = {"PYTHONPATH": os.pathsep.join([str(root / "test"), str(root)])}
    done = subprocess.run(
        [sys.executable, "-m", "core.test_interpreted"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"} | path,
        cwd=root,
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    plain = json.loads(done.stdout)
    assert plain["interpreted"]
    assert plain["digests"] == digests()
    assert min(count for _, count in plain["digests"].values()) > 8


if __name__ == "__main__":
    print(json.dumps({"interpreted": INTERPRETED, "digests": digests()}))
