# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of the documentation that follow from the code: parameters, study files, fields of results.

``python docs/reference.py`` writes each between its marks in a page, as ``<!-- parameters -->`` and ``<!-- end of
parameters -->``; a test checks that they are up to date. What the code does not say stands here: when one would
change a parameter, and what the settings of a study mean. A parameter or setting without such words, or words without
a parameter, is an error.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_ros.config.config import PARAMETERS
from fdi_ros.config.settings import NODE_SECTIONS, REQUIRED, Field
from fdi_ros.experiments import PROTOCOLS
from fdi_ros.experiments.montecarlo import protocol_class

PACKAGE = Path(__file__).parents[1] / "fdi_ros"
WHEN = {
    "input": "Always: what your driver publishes.",
    "body_frame": "Your vehicle's frame has another name.",
    "hardware_id": "Several vehicles or boards report to one place.",
    "sample_rate": "Always: as measured by `fdi inspect`. All times and rates of false alarms follow from it.",
    "excluded_channels": "A channel is known to be bad, or is being tested.",
    "publish_under_doubt": "A wrong rate is worse for you than none.",
    "channels.topic": "Always, with this input.",
    "channels.acceleration_topic": "The accelerometers of a redundant unit are to be judged, too.",
    "channels.names": "Names in tables and diagnostics are to be those of your drawing.",
    "channels.units": "Gyros of the array share a chip or a housing, and neither preset nor names say which.",
    "imus.topics": "Always, with this input.",
    "imus.names": "As for `channels.names`.",
    "imus.mounts": "Always, unless `geometry.axes` gives the axes: from the drawing, or `fdi setup`.",
    "imus.delays": "`fdi setup`, `fdi calibrate` or the diagnostics measured a delay.",
    "imus.max_skew": "Units are not sampled together: half the interval of the samples at most.",
    "imus.timeout": "Messages come late or in bursts (a busy machine, a radio): longer; a fast vehicle: shorter.",
    "geometry.preset": "Axes come from elsewhere than the mounts.",
    "geometry.axes": "`fdi calibrate` writes them; or the axes of an array.",
    "geometry.cone_channels": "With the preset `cone`.",
    "noise.noise_std": "Always: measured by `fdi setup`, vibration of your flight included.",
    "noise.scale_std": "From the data sheet, or smaller once calibrated.",
    "noise.timing_std": "Units are not sampled by one clock.",
    "noise.nonlinearity_std": "The data sheet states more, or `fdi setup` measures more.",
    "noise.bound": "With the detector `guaranteed`: the limit from the data sheet.",
    "noise.bias_walk": "As `fdi calibrate` measures it. Larger: slow drifts are no fault; smaller: they are found.",
    "noise.shared_scale_std": "After `fdi setup`, which writes 0.005: a turn by a known angle shows less.",
    "noise.g_sensitivity_std": "The data sheet states another one: 1 deg/s/g is 0.0018.",
    "noise.acceleration_window": "Strong vibration: longer, so that it is not taken for angular acceleration.",
    "bias.fixed": "`fdi calibrate` writes it.",
    "bias.turn_on_std": "From the data sheet (zero-rate offset), or from several starts.",
    "bias.max_drift": "A bias good enough to fly with is larger or smaller. Fast drifts are found long before.",
    "bias.startup_bias_duration": "The vehicle always stands still at the start: a few seconds.",
    "bias.max_rest_rate": "Gyros have larger biases than this, or the start is less quiet.",
    "detector.name": "To compare, or for a method that is described in a paper. `sequential` flies.",
    "detector.false_alarms_per_hour": "Fewer false alarms at the price of delay, or sooner at the price of more.",
    "detector.false_alarm_probability": "A paper or a requirement counts per sample; set the rate per hour to 0.",
    "detector.confidence": "A name that may wait longer and be surer, or come sooner.",
    "detector.tolerance": "To repeat the figures of the paper.",
    "detector.construction": "To compare the two; the results are alike.",
    "detector.norm": "To compare the two.",
    "detector.criterion": "To compare the two.",
    "detector.max_faults": "Never more than one fault at a time: 1 is sharper.",
    "detector.threshold": "False declarations of `guaranteed`, or faults that it does not see.",
    "detector.shift": "The size of fault that matters most to you is larger or smaller.",
    "detector.run_length": "A requirement counts samples between false alarms.",
    "health.max_rate": "Always: the range of the data sheet, a little less.",
    "health.range_recovery_time": "The gyro's filter takes longer to recover from saturation.",
    "health.non_finite_time": "Drivers drop single samples as NaN: longer.",
    "health.stuck_time": "A slow or coarse converter repeats values: longer.",
    "health.stuck_time_at_rest": "As before, at rest.",
    "health.stale_timeout": "As `imus.timeout`, for the channels of an array.",
    "decision.rule": "A method of a paper is to declare at once, or to be confirmed.",
    "decision.confirm_alarms": "With votes: single alarms are too many, or declarations too late.",
    "decision.confirm_window": "With votes.",
    "decision.latch": "A channel that recovered is to be used again without an operator.",
    "decision.clean_time": "Without latch: how long is long enough.",
    "integrity.risk": "Your safety case asks for another one; 0 saves the computation.",
    "integrity.fault_rate": "Your data sheet or fleet says how often a gyro fails.",
    "integrity.exposure": "Flights are shorter or longer than an hour.",
    "integrity.max_rate": "The vehicle turns faster or more slowly.",
    "integrity.max_acceleration": "As before.",
    "accelerometers.enabled": "Accelerometers are not to be judged, or a unit without any is a fault.",
    "accelerometers.noise_std": "Always: as measured in flight, vibration included.",
    "accelerometers.scale_std": "The accelerometers are calibrated, or from the works.",
    "accelerometers.bias_walk": "They warm up in flight.",
    "accelerometers.turn_on_std": "They are calibrated, or from the works.",
    "accelerometers.max_drift": "You know what a healthy bias may do.",
    "accelerometers.max_acceleration": "Their range is another one.",
    "accelerometers.bias": "`fdi setup` or `fdi calibrate` has measured it.",
    "accelerometers.axes": "They point elsewhere than the gyros, or `fdi setup` has measured it.",
    "accelerometers.position_std": "Positions are known better, or worse, than that.",
    "accelerometers.positions": "The units are more than a few centimetres apart.",
}
"""When one would change a parameter."""

_COMMON = {
    "geometry": "axes of the gyros: a name, or a list of axes",
    "geometries": "axes of the gyros: names, or lists of axes; each is a set of trials of its own",
    "detectors": "methods that are compared, or `all`",
    "options": "options of single methods: `{cusum: {shift: 1.0}}`",
    "false_alarms": "probabilities of a false alarm at which all methods are compared",
    "noise_std": "noise of a healthy channel, rad/s",
    "trials": "with a fault, per cell",
    "sound_trials": "without a fault, of which thresholds are found",
    "block": "trials that one process does at once; figures depend on it and on the seed alone",
}
MEANING: dict[str, dict[str, str]] = {
    "residual_search": {
        "selections": "which of the drawn faults are kept: those that stand out, as printed in the paper, or all",
        "max_rate": "largest body rate about an axis, rad/s",
        "sigma_ratio": "standard deviation of the biases, as a multiple of `scale_std` times `max_rate`",
        "scale_std": "standard deviation of the scale errors",
        "worst": "largest error of a failed channel, standard deviations",
    },
    "snapshot": {
        "faults": "channels that are off at once, 1 or 2",
        "sizes": "of the fault, standard deviations of the noise",
        "thresholds": "found by healthy trials, or derived from the probability",
        "max_rate": "largest body rate about an axis, rad/s",
    },
    "delay": {
        "sizes": "of the fault, standard deviations of the noise",
        "run_length": "samples to a false alarm, on average, at which all methods are compared",
        "lead": "healthy samples before the fault",
        "longest": "samples after which a fault counts as not found",
    },
    "flight": {
        "kinds": "kinds of faults, and `none`",
        "sizes": "size of each kind, in its own unit",
        "monitor": "parameters of the monitor by full name, as in a parameter file",
        "duration": "of a flight, s",
        "rest": "at rest at its begin, s",
        "max_rate": "largest body rate about an axis, rad/s",
    },
}
"""What the settings of each kind of study mean."""

REPLAY = {
    "replay/outcomes.py": ("Outcome", "StateChange", "FaultEffect", "Scores"),
    "replay/summary.py": (),
}
"""Modules of which these classes, or all, are the result of a replay."""
SWEEP_MODULE = "replay/sweep_report.py"
SWEEP: dict[str, tuple[str, dict[str, str]]] = {
    "sweep_figures": (
        "The whole file",
        {
            "bag": "recording that was swept",
            "within_s": "a fault was watched for so long",
            "times": "per channel and fault",
            "seed": "of what is drawn",
            "monitors": "one for each config or detector that was compared",
        },
    ),
    "_monitor_figures": (
        "Of a monitor",
        {
            "name": "config or detector",
            "detector": "its method",
            "refused": "why it could not be tried; empty: it was",
            "without_fault": "of the recording as it is, `null` if it was not watched: the next four",
            "duration_s": "length",
            "judged": "share of the samples that are judged",
            "declared": "list of what was declared: `at_s`, `channel`, `state`",
            "episodes": "the same in words",
            "times_s": "at which faults began",
            "times_left_out_s": "at which none could be tried: the recording has gaps, or doubts of its own",
            "smallest": "for each kind the size from which on it is `named`, or `found`; `null`: a larger one",
            "named": "see `smallest`",
            "found": "see `smallest`",
            "faults": "figures of each kind and size, over all channels",
            "channels": "the same, by channel",
        },
    ),
    "_line_figures": (
        "Of a kind and size of fault, beside its numbers by their names",
        {
            "kind": "of fault",
            "channels": "that were struck: `gyros`, or `accelerometers` with sizes in m/s^2",
            "faults": "how many were tried",
            "named": "share isolated: `value`, and its 95 % interval, `low` and `high`",
            "found": "share isolated, or in an ambiguity group: the same",
            "outcomes": "how many, by outcome",
            "named_after_s": "until isolated: `median` and `p95` of all tried; `null`: fewer were",
            "found_after_s": "until isolated or in an ambiguity group: the same",
        },
    ),
}
"""What the figures of a sweep are, by the function that gives them."""

Row = Sequence[str]
RUNNING = " May change while the node runs."


def parameters() -> str:
    """All parameters, a table for each section."""
    _same("WHEN", WHEN, PARAMETERS)
    sections: dict[str, list[Row]] = {}
    for name, declared in PARAMETERS.items():
        kind, default, unit, limits = _about(declared)
        value = [
            kind,
            f"default {default}",
            *(
                f"{what} {one}"
                for what, one in (("in", unit), ("", limits))
                if one != "-"
            ),
        ]
        running = RUNNING if declared.runtime else ""
        words = (
            f"{_sentence(declared.description)}{running}<br>*Change it:* {WHEN[name]}"
        )
        row = (f"`{name}`", "<br>".join(value), words)
        sections.setdefault(
            name.rpartition(".")[0] or "the monitor as a whole", []
        ).append(row)
    head = ("name", "type, default, unit, range", "meaning, and when to change it")
    return "\n\n".join(
        f"## {section}\n\n{_table(head, rows)}" for section, rows in sections.items()
    )


def node_parameters() -> str:
    """Parameters of the nodes that are none of the settings."""
    parts = []
    for node, fields in NODE_SECTIONS.items():
        rows = [
            (
                f"`{name}`",
                *_about(field),
                f"{_sentence(field.description)}{RUNNING if field.runtime else ''}",
            )
            for name, field in fields.items()
        ]
        parts.append(
            f"### {node}\n\n{_table(('name', 'type', 'default', 'unit', 'range', 'meaning'), rows)}"
        )
    return "\n\n".join(parts)


def studies() -> str:
    """Sections of a study file with their settings."""
    parts = []
    _same("MEANING", MEANING, PROTOCOLS)
    for kind in PROTOCOLS:
        schema = protocol_class(kind).schema
        meaning = {
            **{name: _COMMON[name] for name in schema if name in _COMMON},
            **MEANING[kind],
        }
        _same(f"MEANING of {kind}", meaning, schema)
        rows = [
            (f"`{name}`", *_about(declared, unit=False), _sentence(meaning[name]))
            for name, declared in schema.items()
        ]
        parts.append(
            f"### {kind}\n\n{_table(('name', 'type', 'default', 'range', 'meaning'), rows)}"
        )
    return "\n\n".join(parts)


def results() -> str:
    """Fields of the results: of a replay as its classes describe them."""
    parts = ["## What `fdi replay --json` writes"]
    for module, wanted in REPLAY.items():
        for name, words, rows in _classes(PACKAGE / module):
            if name in wanted or (rows and not wanted):
                parts += [
                    f"### {name}",
                    words,
                    _table(("field", "type", "meaning"), rows),
                ]
    parts.append("## What `fdi sweep --json` writes")
    given = _keys(PACKAGE / SWEEP_MODULE)
    for function, (title, meaning) in SWEEP.items():
        _same(f"SWEEP of {function}", meaning, given[function])
        rows = [(f"`{name}`", _sentence(words)) for name, words in meaning.items()]
        parts += [f"### {title}", _table(("field", "meaning"), rows)]
    return "\n\n".join(parts)


MARKS = {
    "parameters": parameters,
    "node parameters": node_parameters,
    "studies": studies,
    "results": results,
}


PAGES = ("parameters.md", "files.md")  # that have marks


def filled(text: str) -> str:
    """Return a page with the tables as they are now between their marks."""
    for name, make in MARKS.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, found, rest = text.partition(begin)
        if found:
            after = rest.partition(end)[2]
            text = f"{before}{begin}\n\n{make()}\n\n{end}{after}"
    return text


def _same(called: str, given: Iterable[str], expected: Iterable[str]) -> None:
    given, expected = set(given), set(expected)
    if given != expected:
        raise ValueError(
            f"{called}: {sorted(expected - given)} missing, {sorted(given - expected)} unknown"
        )


_TYPES = {"numbers": "list of float", "texts": "list of string", "text": "string"}


def _about(declared: Field, unit: bool = True) -> list[str]:
    """Type, default, unit and range in words."""
    kind = _TYPES.get(declared.kind, declared.kind)
    if declared.per:
        each = (
            f"{declared.each} per {declared.per}"
            if declared.each > 1
            else f"one per {declared.per}"
        )
        kind += f", {each}"
    default = (
        "must be given"
        if declared.default in (REQUIRED, None)
        else f"`{_plain(declared.default)}`"
    )
    return [kind, default, *([declared.unit or "-"] if unit else []), _range(declared)]


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_plain, value))}]"
    if isinstance(value, Mapping):
        return (
            f"{{{', '.join(f'{name}: {_plain(one)}' for name, one in value.items())}}}"
        )
    return f"{value:g}" if isinstance(value, float) else str(value) or '""'


def _range(declared: Field) -> str:
    if declared.choices:
        return ", ".join(f"`{choice}`" for choice in declared.choices)
    if math.isinf(declared.low) and math.isinf(declared.high):
        return "-"
    return f"{declared.low:g} to {declared.high:g}"


def _keys(path: Path) -> dict[str, list[str]]:
    """Names that the mappings which each function of a module writes down have."""
    return {
        function.name: [
            str(key.value)
            for node in ast.walk(function)
            if isinstance(node, ast.Dict)
            for key in node.keys
            if isinstance(key, ast.Constant)
        ]
        for function in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(function, ast.FunctionDef)
    }


def _classes(path: Path) -> Iterable[tuple[str, str, list[Row]]]:
    """Classes of a module: name, first line of the docstring, and the fields with what stands behind or below each."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for node in ast.parse(text).body:
        if not isinstance(node, ast.ClassDef):
            continue
        rows = []
        for field, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                said = isinstance(after, ast.Expr) and isinstance(
                    after.value, ast.Constant
                )
                behind = lines[field.lineno - 1].partition("  # ")[2]
                meaning = str(after.value.value) if said else behind  # type: ignore[union-attr]
                rows.append(
                    (
                        f"`{field.target.id}`",
                        f"`{ast.unparse(field.annotation)}`",
                        " ".join(meaning.split()),
                    )
                )
        yield node.name, (ast.get_docstring(node) or "").partition("\n")[0], rows


def _sentence(text: str) -> str:
    begin = text[0] if "_" in text.partition(" ")[0] else text[0].upper()
    return f"{begin}{text[1:]}{'' if text.endswith('.') else '.'}"


def _table(head: Row, rows: Sequence[Row]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |"
        for line in lines
    )


if __name__ == "__main__":
    for page in PAGES:
        path = Path(__file__).with_name(page)
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
