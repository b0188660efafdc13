# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials per second, of one sample and of whole flights, by number of processes; and the same figures from each.

python benchmark/montecarlo.py
"""

import sys
import time
from pathlib import Path

from fdi_ros.experiments.montecarlo import load_study, run_study
from fdi_ros.report.layout import table
from fdi_ros.result_file import plain

STUDIES = Path(__file__).parents[1] / "config" / "studies"
TRIALS = {"double": 20_000, "kinds": 6}
"""Studies without a limit to be integrated, which is the same work whatever the trials."""


def main() -> None:
    rows = []
    for name, trials in TRIALS.items():
        study, results, took = load_study(STUDIES / f"{name}.yaml", trials=trials), [], []
        for section in study.sections:
            if "sound_trials" in section.settings:
                section.settings["sound_trials"] = 4 * trials
        for workers in (1, 2):
            print(f"{name}, {workers}", file=sys.stderr)
            begun = time.perf_counter()
            results.append(run_study(study, workers=workers))
            took.append(time.perf_counter() - begun)
        count = sum(cell.get("drawn", cell["trials"]) for section in results[0].sections for cell in section.cells)
        same = "yes" if plain(results[0]) == plain(results[1]) else "NO"
        rows.append((name, f"{count}", *(f"{count / seconds:.0f}" for seconds in took), same))
    print("\n".join(table(("study", "trials", "per s, 1 process", "per s, 2 processes", "same figures"), rows)))


if __name__ == "__main__":
    main()
