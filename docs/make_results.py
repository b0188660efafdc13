# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Makes docs/results.md from the studies in config/studies: python docs/make_results.py (about 10 minutes)."""

import math
import platform
import re
import sys
from pathlib import Path

import numpy as np
from scipy import stats

import fdi_ros
from fdi_ros.config.config import Config
from fdi_ros.core.subsets import mask_of, prepare_subsets
from fdi_ros.experiments.montecarlo import StudyResult, load_study, run_study
from fdi_ros.experiments.report import tables
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.report.layout import Section

ROOT = Path(__file__).parents[1]
TABULATED = {
    "dodecahedron": {4: (0.753, 0.161), 6: (0.945, 0.652), 8: (0.993, 0.961)},
    "two_triad_cone": {4: (0.715, 0.153), 6: (0.910, 0.630), 8: (0.978, 0.948)},
}
"""Largest residual the right one, and with an alarm of the chi-square test at 1e-3, by size in standard deviations."""
STUDIES = {
    "reference": """Against closed forms and tabulated figures: the chi-square test of the whole parity vector at
1e-3 a sample, and the name of the largest normalised residual. One standard error is at most 0.05 %.""",
    "residual_search_2019": """The paper prints 80.3 % detected, 8 % undetected, 7.3 % falsely determined, the same
for its four searches. Its printed selection of trials (*printed*: the failed channel's error inside mean +- 3
standard deviations of the healthy ones') cannot have been the one used; the opposite (*stands out*) gives its
figures to within 2.2 points at the ratio sigma_0 = 0.2 sigma_k 2 deg/s, which the paper does not state; 0.1 to
3 all stay within 4.4. The tolerance (8) is no false-alarm guarantee: see *sound*.

At equal false alarms `likelihood_ratio` declares the right channel 2 to 5 points more often than the searches
(*stands out*), because it weighs every channel by its error at the rate of the sample. With constant noise and
symmetric axes all of these name the same channel.""",
    "power": """Thresholds are found on 10^6 healthy samples, so a false-alarm rate of 0.1 % is known to 3 % of itself:
two methods that differ by less than half a point are alike. Bayes' decision that knows the size of the fault
is at most half a point better than the best of them. `guaranteed` is brought to the common false-alarm rate by
its threshold, far below the ten bounds of its own; its set of suspects is then all channels. Delay: *best
possible* is that of a method that knows channel, sign and size (Moustakides 1986). `sequential` begins each
trial with no noise measured, for which it allows most at first, and some of its streams end before the alarm
(a dash); in flights it is quicker, see there.""",
    "roc": "Detection at other false-alarm rates.",
    "double": """Single-fault methods name one channel and call it isolated; where two are off that
is wrong by construction. The set of `likelihood_ratio` holds both from 20 standard deviations on; below, one
fault often explains the sample as well, and one is believed rather than two.""",
    "kinds": """Every method flies the same simulated flights, with misalignment, scale factors, sampling delays,
bias walk and resolution that the monitor is not told beyond noise_std, scale_std, timing_std. Not every fault shows: a
scale factor or a saturation needs motion about that axis, and a fault that never mattered is not declared. Single
spikes are left out of the rate sample by sample; only `cusum`, which adds them up, declares them. `sequential` reports
a noisy channel as noisy and does not declare it; in eight seconds it knows little of slow noise and scale errors,
and waits. `guaranteed` waits for ten bounds of four noise_std by choice.""",
}

SHOWN = {
    "reference": ("One fault, two_triad_cone",),
    "residual_search_2019": ("Protocol of 2019, sound", "Protocol of 2019, stands out"),
    "power": (
        *(f"One fault, {name}" for name in ("two_triad_cone", "cone_5")),
        "Delay",
    ),
    "roc": ("Detection of 6",),
    "double": ("Two faults of 20",),
    "kinds": ("Declared", "Delay"),
}
"""Tables of each study, by how their titles begin."""


def main() -> None:
    """Run all studies and write the file; its sections that benchmark/ is for are kept."""
    target = ROOT / "docs" / "results.md"
    before = target.read_text(encoding="utf-8")
    measured = re.search(
        r"^## In flight\n.*^## Settings from a recording\n.*?(?=^## )",
        before,
        re.DOTALL | re.MULTILINE,
    )
    lines = [
        "# Results",
        "",
        "What follows *Settings from a recording* is made by `python docs/make_results.py`. Figures come from the seed "
        "of each study, shares are in percent; `--json` and `--report` of a study have more, with 95 % intervals.",
        "",
        f"fdi_ros {fdi_ros.__version__}, NumPy {np.__version__}, Python {platform.python_version()}.",
        "",
        *([measured[0].rstrip("\n"), ""] if measured else []),
    ]
    for name, words in STUDIES.items():
        path = ROOT / "config" / "studies" / f"{name}.yaml"
        print(name, file=sys.stderr)
        result = run_study(load_study(path))
        command = f"`fdi montecarlo config/studies/{name}.yaml`, seed {result.seed}."
        lines += [f"## {result.title}", "", command, "", words, ""]
        lines += [agreement(result), ""] if name == "reference" else []
        for one in tables(result):
            if one.title.startswith(SHOWN[name]):
                lines += [*markdown(one), ""]
    lines += ["## Protection level", "", *integrity_table(), ""]
    target.write_text("\n".join(lines).rstrip("\n") + "\n", encoding="utf-8")


def agreement(result: StudyResult) -> str:
    """Largest difference to the closed form and to the tabulated figures, in standard errors of both."""
    worst = {"detection": 0.0, "isolation": 0.0}
    for cell in result.sections[0].cells:
        if not cell["size"]:
            continue
        (figures,) = cell["methods"]["chi_square"]
        closed = float(stats.ncx2.sf(stats.chi2.isf(1e-3, 3), 3, cell["size"] ** 2 / 2))
        known = [("detection", figures["declared"], closed, 0.0)]
        if cell["size"] in TABULATED[cell["geometry"]]:
            pair = zip(
                (figures["identified"], figures["right"]),
                TABULATED[cell["geometry"]][cell["size"]],
                strict=True,
            )
            # Tabulated from 10^6 samples as well, to three digits.
            known += [
                ("isolation", figure, value, value * (1 - value) / 1e6 + 0.0005**2 / 3)
                for figure, value in pair
            ]
        for what, figure, value, variance in known:
            error = math.sqrt(value * (1 - value) / cell["trials"] + variance)
            worst[what] = max(worst[what], abs(figure.value - value) / error)
    return (
        f"Largest differences: detection {worst['detection']:.1f} standard errors from the noncentral chi-square"
        f" (12 cells), isolation {worst['isolation']:.1f} from the tabulated figures (12)."
    )


def integrity_table() -> list[str]:
    """Levels in standard deviations of one channel; how they are checked stands in docs/integrity.md."""
    rows = []
    named = {
        "two_triad_cone": Geometry.two_triad_cone(),
        "dodecahedron": Geometry.dodecahedron(),
    }
    named |= {f"cone_{n}": Geometry.cone(n) for n in (5, 9)}
    for name, geometry in named.items():
        for prior, risk in ((1e-3, 1e-3), (1e-3, 1e-5), (1e-4, 1e-7)):
            rate = {
                "integrity.fault_rate": -math.log1p(-prior),
                "integrity.exposure": 1.0,
                "integrity.risk": risk,
            }
            known = Integrity(
                Config.from_parameters(rate).integrity, 1e-6, geometry, NoiseModel(1.0)
            )
            subsets, whole = (
                prepare_subsets(geometry, NoiseModel(1.0)),
                mask_of(range(geometry.n)),
            )
            worst = known.after_loss(subsets, whole)
            shown = [
                " ".join(f"{x:.2f}" for x in level)
                for level in (subsets["level"][whole], worst)
            ]
            rows.append((name, f"{prior:g}", f"{risk:g}", *shown))
    head = (
        "mounting",
        "prior of a channel",
        "risk",
        "level about x, y, z",
        "after one more loss",
    )
    hint = "In standard deviations of one channel; separation test at 1e-6 per sample. See docs/integrity.md."
    return markdown(Section("Levels", hint, (head, rows)))


def markdown(one: Section) -> list[str]:
    """Lines of a table in Markdown."""
    assert isinstance(one.content, tuple)
    head, body = one.content
    rows = [
        "| " + " | ".join(row) + " |" for row in (head, ("---",) * len(head), *body)
    ]
    return [f"**{one.title}** {one.hint}", "", *rows]


if __name__ == "__main__":
    main()
