# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a mounting can do: published figures, independent computations, and Monte-Carlo of the smallest error."""

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fdi_ros.config.config import Config
from fdi_ros.detectors import create_detector
from fdi_ros.experiments.contenders import moustakides_delay
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import (
    NoiseModel,
    assumption_words,
    coincidences,
    smallest_detectable,
    summary_line,
)
from fdi_ros.setup.mounting import (
    DETECTION_TIMES,
    VIBRATION,
    assess,
    loss,
    mounting_text,
    pair_lines,
)

CONFIG = Path(__file__).parents[2] / "config"


def two_imus(second):
    return Config.from_parameters(
        {
            "input": "imus",
            "imus.topics": ["a", "b"],
            "imus.mounts": [*np.eye(3).ravel(), *second.ravel()],
        }
    )


def test_two_lost_against_plain_least_squares():
    """Of one axis they leave no rate."""
    geometry, noise = Geometry.dodecahedron(), NoiseModel(0.01).for_channels(6)
    kept = [0, 2, 3, 5]
    expected = np.linalg.inv(geometry.axes[kept].T @ geometry.axes[kept])
    found = loss(geometry, noise, (1, 4))
    assert found.gdop == pytest.approx(math.sqrt(np.trace(expected)))
    assert np.allclose(found.std, 0.01 * np.sqrt(np.diag(expected)))
    assert found.isolable == ()
    none = loss(Geometry.from_triads([np.eye(3), np.eye(3)]), noise, (0, 3))
    assert (none.gdop, none.detectable) == (math.inf, ())


@pytest.mark.parametrize(
    "geometry", [Geometry.dodecahedron(), Geometry.two_triad_cone()]
)
def test_smallest_error_is_seen_99_times_in_100(geometry):
    probability = 1e-3
    noise = NoiseModel(np.linspace(0.8, 1.3, 6))
    smallest = smallest_detectable(geometry, noise, probability)
    detector = create_detector(
        "likelihood_ratio", geometry, noise, false_alarm_probability=probability
    )
    rng = np.random.default_rng(4)
    for channel in (0, 5):
        z = noise.noise_std * rng.standard_normal((20000, 6))
        z[:, channel] += smallest[channel]
        # Five standard errors of 20000 draws at 0.99; another channel may pass the threshold where its own does not.
        assert 0.9865 < detector.detect(z).alarm.mean() < 0.9955


def test_an_error_as_large_as_stated_is_found_in_the_time_stated():
    config = two_imus(
        Rotation.from_euler("xyz", [40, 30, 20], degrees=True).as_matrix()
    )
    config = config.replaced(
        {
            "noise.noise_std": [0.001 * (i + 1) for i in range(6)],
            "noise.scale_std": [0.01],
        }
    )
    result = assess(config)
    rest, turning, vibration = result.waiting.values()
    assert (np.diff(rest, axis=0) < 0).all()
    assert (turning > rest).all()
    np.testing.assert_allclose(vibration, VIBRATION * rest)
    # Of a wait shorter than two samples nothing is said.
    assert np.isnan(
        assess(config.replaced({"sample_rate": 25.0})).waiting["at rest"][
            DETECTION_TIMES.index(0.02)
        ]
    ).all()
    # A stream with that error, whitened: the CUSUM of the channel's own direction.
    V, R = result.geometry.parity, np.diag(result.noise.noise_std**2)
    inverse = np.linalg.inv(V @ R @ V.T)
    own = float(V[:, 2] @ inverse @ V[:, 2])
    shift = rest[DETECTION_TIMES.index(0.5), 2] * math.sqrt(own)
    assert moustakides_delay(
        shift, 1 / result.false_alarm_probability
    ) == pytest.approx(50, rel=0.03)


def test_what_names_rest_on_is_said():
    rng = np.random.default_rng(0)
    three = Geometry(np.tile(np.eye(3), (3, 1)) + 0.003 * rng.standard_normal((9, 3)))
    assert coincidences(three) == ((0, 3, 6), (1, 4, 7), (2, 5, 8))
    config = {
        "input": "imus",
        "imus.topics": ["a", "b", "c"],
        "imus.mounts": [*np.tile(np.eye(3).ravel(), 3)],
    }
    text = mounting_text(assess(Config.from_parameters(config)))
    assert "naming assumes no two failing alike of a.x/b.x/c.x, a.y/" in text
    # Two that fail as the third would look give its parity: so it is for every set that is listed, and no other.
    for geometry in (
        three,
        Geometry.cone(6),
        Geometry.cone(5),
        Geometry(np.tile(np.eye(3), (4, 1))),
    ):
        directions = geometry.parity / np.linalg.norm(geometry.parity, axis=0)
        listed = [set(found) for found in coincidences(geometry)]
        for i, j, k in combinations(range(geometry.n), 3):
            left = np.linalg.lstsq(directions[:, [j, k]], directions[:, i], rcond=None)[
                0
            ]
            rest = np.linalg.norm(directions[:, i] - directions[:, [j, k]] @ left)
            assert (rest < 0.05) == any({i, j, k} <= found for found in listed)
    assert assumption_words(Geometry(np.tile(np.eye(3), (4, 1)))) == ""


def test_look_alikes_are_named_in_words():
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert assess(two_imus(quarter)).alike == [[0, 4], [1, 3], [2, 5]]
    result = assess(two_imus(np.eye(3)))
    assert result.alike == [[0, 3], [1, 4], [2, 5]]
    expected = "a.x and b.x measure the same axis: a fault of either is detected, but not which one"
    assert expected in pair_lines(result)
    assert expected in mounting_text(result)
    assert "0 of 6 single faults can be isolated" in summary_line(
        result.geometry, result.noise, result.false_alarm_probability
    )


@pytest.mark.parametrize("name", ["two_imus", "three_imus", "two_triads"])
def test_verb_on_the_bundled_files(name, tmp_path, fdi):
    report = tmp_path / "page.html"
    code, out, _ = fdi("geometry", CONFIG / f"{name}.yaml", "--report", report)
    assert code == 0
    assert "every single fault can be detected and isolated" in out
    assert "scatter3d" in report.read_text()
