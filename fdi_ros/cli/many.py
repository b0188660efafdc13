# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Work for many processes: ``fdi fleet``, many recordings; ``fdi montecarlo``, many simulated trials."""

from __future__ import annotations

import sys
from argparse import Namespace

from fdi_ros.cli.arguments import FILE, RESULTS, WORKERS, Verb, config_files, shipped
from fdi_ros.errors import BagError, FdiError, StudyError
from fdi_ros.system.installation import BAGS, POOL, resolve
from fdi_ros.system.text import shown, storable

PAGE = "fleet.html"


def _fleet(arguments: Namespace) -> int:
    """Judge them, write tables and page, print what needs a person."""
    from fdi_ros.cli.ahead import compile_for_workers
    from fdi_ros.cli.outputs import Kind, Outputs, Progress, check_target, config_words, versions
    from fdi_ros.config.config import with_parameters
    from fdi_ros.fleet.judge import find_recordings, judge_all
    from fdi_ros.fleet.tables import Fleet, Tables
    from fdi_ros.system.files import write_text
    from fdi_ros.system.jobs import worker_count

    workers = worker_count(arguments.workers)
    names = ", ".join(shown(file.name) for file in arguments.config)
    parameters = with_parameters(arguments.config, {}, f"as in {names}", {}) if names else ""
    paths, unread = find_recordings(arguments.paths)
    outputs = Outputs(arguments, ("output", "json"), [*paths, *arguments.config], output=None)
    folder = arguments.output.absolute()
    if folder.exists():
        check_target(folder / PAGE, Kind.PAGE, force=True)
    tables = Tables(folder, {"config": parameters, "calibrate": arguments.calibrate}, arguments.force)
    compile_for_workers(arguments)
    try:
        with Progress(sys.stderr, arguments.quiet, "flights") as progress:
            given = parameters, arguments.calibrate == "each", tables
            judge_all(paths, *given, workers, arguments.scheduler, progress.show)
    except KeyboardInterrupt:
        print("fdi: stopped; what was judged is kept, the same command goes on from there", file=sys.stderr)
        raise
    except (FdiError, OSError):
        tables.give_up()
        raise
    fleet = Fleet([tables.flights[storable(str(path))] for path in paths])
    about = {
        "recordings": f"{len(paths)}, from {', '.join(map(str, arguments.paths))}",
        "config": config_words(arguments) or "what fdi inspect writes for each recording",
        "calibrated": arguments.calibrate,
        "versions": versions(),
    }
    write_text(folder / PAGE, fleet.html(about))
    others = len(tables.flights) - len(paths)
    more = [f"The tables have {others} more, of other runs: not counted here."] if others else []
    more += [f"Not searched: {shown(line)}." for line in unread]
    text, figures = fleet.text() + "".join(f"{line}\n" for line in more), fleet.figures() | {"not_searched": unread}
    code = outputs.finish(text, figures, severity=fleet.verdict.severity)
    if not fleet.judged:
        raise BagError(f"none of the {len(paths)} recordings could be judged: {arguments.output / PAGE} says why")
    return code


FLEET = Verb(
    "judge many recordings: tables of flights and episodes, and a page of what needs a person",
    ("fdi fleet logs --output fleet", "fdi fleet logs bags/2026 --calibrate each --workers 4 --output fleet"),
    {
        "paths": {"nargs": "+", "metavar": "PATH", "help": "recordings, and folders with recordings"},
        **config_files("; default: of each recording what fdi inspect writes for it", required=False, default=[]),
        "--output": {**FILE, "metavar": "DIR", "help": "folder for the tables and the page", "required": True},
        "--calibrate": {
            "choices": ("none", "each"),
            "default": "none",
            "help": "each: calibrate each recording on itself, where it allows that; default none",
        },
        **WORKERS,
        **RESULTS,
        "--force": {"help": "begin anew where the folder holds a run with other settings"},
    },
    _fleet,
    (*BAGS, *POOL, "pyarrow", "scipy"),
)


def _montecarlo(arguments: Namespace) -> int:
    """Run the study; print its headline table."""
    from fdi_ros.cli.ahead import compile_for_workers
    from fdi_ros.cli.outputs import Outputs, Progress
    from fdi_ros.experiments.montecarlo import load_study, run_study
    from fdi_ros.experiments.report import headline, report
    from fdi_ros.system.files import plain

    if arguments.scheduler is not None and arguments.workers is not None:
        raise StudyError("--workers is for local processes, --scheduler for a cluster: give one")
    outputs = Outputs(arguments, ("report", "json"), [arguments.study])
    study = load_study(arguments.study, arguments.trials, arguments.seed)
    compile_for_workers(arguments)
    with Progress(sys.stderr, arguments.quiet, study.name) as progress:
        result = run_study(study, arguments.workers, arguments.scheduler, progress.show)
    return outputs.finish(f"{headline(result)}\n", plain(result), lambda: report(result))


MONTECARLO = Verb(
    "compare detectors over many simulated trials",
    ("fdi montecarlo power.yaml --trials 200 --report power.html",),
    {
        "study": {"type": resolve, "metavar": "STUDY.yaml", "help": f"what to run; shipped: {shipped('studies')}"},
        "--trials": {"type": int, "metavar": "N", "help": "trials per cell, instead of the file's"},
        "--seed": {"type": int, "metavar": "S", "help": "seed, instead of the file's"},
        **WORKERS,
        "--report": {"help": "write curves and tables as one page"},
        **RESULTS,
    },
    _montecarlo,
    POOL,
)
