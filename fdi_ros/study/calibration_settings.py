"""Settings of the monitor from a calibration, and a parameter file that holds them, comments and all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.config import Config
from fdi_ros.errors import CalibrationError, ConfigError
from fdi_ros.monitor.build import build_geometry, build_noise
from fdi_ros.study.calibration_data import Array
from fdi_ros.study.calibration_noise import NoiseFit

LEAST_NOISE = 1e-9
"""What noise.noise_std may be at least, rad/s."""


def settings(config: Config, active: list[int], axes: Array, bias: Array, noise: NoiseFit) -> dict[str, object]:
    """Parameters to be changed; channels that are not in use keep what they have.

    Parameters
    ----------
    config
        As it was.
    active
        Numbers of the channels calibrated.
    axes, bias, noise
        Of these, (k, 3), (k,) rad/s.
    """
    all_axes = build_geometry(config).axes.copy()
    n = len(all_axes)
    all_axes[active] = axes
    all_bias = np.array(config.bias.fixed) if config.bias.fixed else np.zeros(n)
    all_bias[active] = bias
    before = build_noise(config, n)
    std, scale, timing = before.noise_std.copy(), before.scale_std.copy(), before.timing_std.copy()
    std[active], scale[active], timing[active] = np.maximum(noise.std, LEAST_NOISE), noise.scale, noise.timing
    return {
        "geometry.preset": "axes",
        "geometry.axes": _rounded(all_axes.ravel(), 6),
        "noise.noise_std": [float(f"{value:.4g}") for value in std],
        "noise.scale_std": _short(scale),
        "noise.timing_std": _short(timing),
        "bias.fixed": _rounded(all_bias, 7),
        "bias.startup_bias_duration": 0.0,
    }


def _rounded(values: Array, digits: int) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _short(values: Array) -> list[float]:
    numbers = [float(f"{value:.4g}") for value in values]
    return numbers[:1] if len(set(numbers)) == 1 else numbers


COMMENTS = {
    "geometry.axes": "calibrated: 3 numbers a channel",
    "noise.noise_std": "rad/s, calibrated",
    "noise.scale_std": "calibrated",
    "noise.timing_std": "s, calibrated",
    "bias.fixed": "rad/s, calibrated",
    "bias.startup_bias_duration": "s; 0: off, the calibrated biases are used",
}
"""Written behind the values that are set."""


def write_settings(source: Path, target: Path, changes: Mapping[str, object], note: str) -> None:
    """Write a parameter file with some parameters changed; all else in it stays, comments included.

    Parameters
    ----------
    source
        The file as it was.
    target
        The file to write; may be the same.
    changes
        ``{"section.field": value}``.
    note
        Lines of comment for the top: where the values come from.

    Raises
    ------
    CalibrationError
        If ruamel.yaml is not installed, or the file cannot be written.
    """
    try:
        from ruamel.yaml import YAML
    except ImportError as error:
        raise CalibrationError("writing a config needs ruamel.yaml: pip install 'fdi_ros[calibrate]'") from error
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 110
    document = yaml.load(source.read_text(encoding="utf-8"))
    top = _parameters_of(document, source)
    for name, value in changes.items():
        _put(top, name, value)
    previous = document.ca.comment
    lines = [] if previous is None else [token.value for token in previous[1] or []]
    old = "".join(lines).rstrip("\n").splitlines()
    kept = [line.removeprefix("#").removeprefix(" ") for line in old if not line.startswith(f"# {MARK}")]
    document.yaml_set_start_comment("\n".join([*kept, *(f"{MARK} {line}" for line in note.splitlines())]))
    try:
        with target.open("w", encoding="utf-8") as file:
            yaml.dump(document, file)
    except OSError as error:
        raise CalibrationError(f"cannot write {target}: {error.strerror}") from error
    Config.from_file(target)


MARK = "Calibrated:"
"""Begins the lines at the top that a new calibration replaces."""


def _parameters_of(document: Any, source: Path) -> Any:
    """Section that the changes go to: of the node itself if there is one, since it wins over ``/**``."""
    names = [name for name in document if str(name) == "/**" or str(name).rpartition("/")[2] == "fdi_node"]
    if not names:
        raise ConfigError(f"config {source} has no parameters for /** or fdi_node")
    return document[sorted(names, key=lambda name: name == "/**")[0]]["ros__parameters"]


def _put(top: Any, name: str, value: object) -> None:
    """Set one parameter, whether it stands nested or as ``section.field``."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, list):
        sequence = CommentedSeq(value)
        sequence.fa.set_flow_style()
        value = sequence
    section, _, field = name.partition(".")
    if name in top:
        top[name] = value
        return
    if section not in top:
        top[section] = CommentedMap()
    top[section][field] = value
    if field not in (top[section].ca.items or {}) and name in COMMENTS:
        top[section].yaml_add_eol_comment(COMMENTS[name], field)
