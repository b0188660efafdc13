# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path as plain Python, for a debugger: slow, and the same to the bit."""

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from detectors.detector_trials import VARIANTS, usual_geometry
from detectors.detector_trials import sound as healthy
from monitor.streams import parallel, stream, struck
from monitor.test_receiver import Ear, messages

from fdi_ros import NoiseModel, create_detector
from fdi_ros.compiling.compiled import INTERPRETED
from fdi_ros.detectors.papers import single_fault
from fdi_ros.monitor.pipeline import Pipeline

FAULTS = (
    "channel=imu_1.z kind=bias size=0.1 start=0.6 stop=0.9",
    "channel=imu_2.y kind=dropout start=0.8 stop=0.9",
    "channel=imu_1.x kind=stuck start=1.0",
)


def digest(parts):
    return hashlib.sha256(
        b"".join(np.asarray(part).tobytes() for part in parts)
    ).hexdigest()


def flight(detector, samples):
    """Of messages in and out, with three faults, a lost and a cut message; and how many events there were."""
    biases = {"bias__startup_bias_duration": 0.3, "bias__max_rest_rate": 10.0}
    decision = {"decision__latch": False, "decision__clean_time": 0.2}
    pipeline = Pipeline(
        parallel(
            2, detector__name=detector, noise__scale_std=0.002, **biases, **decision
        )
    )
    block, ear = (
        struck(
            stream(pipeline.geometry, samples, 0.02), FAULTS, pipeline.channel_names
        ),
        Ear(pipeline),
    )
    for k, (unit, data) in enumerate(messages(block, 2)):
        if k != 41:
            ear.take(unit, data[: 50 if k == 81 else None])
    events = "\n".join(map(repr, ear.events)).encode()
    return digest([*ear.fused, *ear.integrity, events]), len(ear.events)


def verdicts():
    """Of all variants of all detectors, after fewer trials at their making than usual; and how many alarms."""
    parts, alarms = [], 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(single_fault, "TRIALS_PER_CHANNEL", 2)
        for name, options in VARIANTS:
            for noise in (
                NoiseModel(1e-3, bound=1e-3),
                NoiseModel(1e-3, 2e-3, 3e-4, bound=4e-3),
            ):
                detector = create_detector(name, usual_geometry(name), noise, **options)
                z, acceleration = healthy(
                    np.random.default_rng(21), detector.geometry, noise, 8
                )
                z[2:, 0] += 0.5
                z[6:, 1] = np.nan
                verdict = detector.detect(z, acceleration)
                parts += verdict
                alarms += int(verdict.alarm.sum())
    return digest(parts), alarms


def digests():
    found = {
        "verdicts": verdicts(),
        # The third fault takes its time; what the other method adds is its votes.
        "likelihood_ratio": flight("likelihood_ratio", 75),
        "sequential": flight("sequential", 110),
    }
    return {name: list(one) for name, one in found.items()}


def test_plain_python_gives_the_same_bits(root):
    path = {
        "PYTHONPATH": os.pathsep.join([str(root / "test"), str(root)]),
        "NUMBA_DISABLE_JIT": "1",
    }
    command = [sys.executable, "-m", "core.test_interpreted"]
    done = subprocess.run(
        command,
        env=os.environ | path,
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
