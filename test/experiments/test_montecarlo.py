# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Studies: figures as published, the same wherever the work is done, refusals; and the flights that they simulate."""

import contextlib
import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chndtr, ndtr, ndtri

from fdi_ros.bag.samples import read_block
from fdi_ros.cli.command_line import main
from fdi_ros.config.config import Config
from fdi_ros.errors import StudyError
from fdi_ros.experiments import montecarlo
from fdi_ros.experiments.contenders import cusum_run_length, moustakides_delay
from fdi_ros.experiments.flight import (
    GyroErrors,
    Motion,
    regular_stamps,
    vehicle_motion,
)
from fdi_ros.experiments.montecarlo import load_study, run_study
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.outcomes import quantiles, share
from fdi_ros.system import jobs
from fdi_ros.system.files import plain

ROOT = Path(__file__).parents[2]
STUDIES = sorted((ROOT / "config" / "studies").glob("*.yaml"))
SMALL = {
    "title": "small",
    "seed": 11,
    "snapshot": {
        "detectors": ["max_residual", "guaranteed", "likelihood_ratio"],
        "sizes": [6],
        "trials": 3000,
        "sound_trials": 4000,
        "block": 1000,
    },
    "delay": {
        "detectors": ["projector", "cusum"],
        "sizes": [3],
        "trials": 20,
        "sound_trials": 100,
        "run_length": 500,
    },
    "flight": {
        "detectors": ["likelihood_ratio"],
        "kinds": ["none", "bias"],
        "trials": 3,
        "block": 1,
    },
}


def study_file(tmp_path, content):
    path = tmp_path / "study.yaml"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def run(tmp_path, kind, seed=8, **settings):
    """Result of a study of one section."""
    path = study_file(tmp_path, {"seed": seed, kind: settings})
    return plain(run_study(load_study(path), workers=1))["sections"][0]


@pytest.fixture
def distributed():
    return pytest.importorskip(
        "distributed", reason="the extra 'cluster' is not installed"
    )


ONE_WORKER = {
    "n_workers": 1,
    "threads_per_worker": 1,
    "dashboard_address": None,
    "silence_logs": 50,
}


def written(folder, *words):
    """What `fdi montecarlo` writes of the small study."""
    result = folder / "result.json"
    assert (
        main(
            [
                "montecarlo",
                str(study_file(folder, SMALL)),
                *words,
                "--json",
                str(result),
            ]
        )
        == 0
    )
    return result.read_text()


class Study(NamedTuple):
    """What came of the small study: its result, its page, and what was printed."""

    result: str
    page: str
    table: str


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The small study in this process."""
    folder = tmp_path_factory.mktemp("study")
    page, table = folder / "page.html", io.StringIO()
    with contextlib.redirect_stdout(table):
        result = written(folder, "--workers", "1", "--report", str(page))
    return Study(result, page.read_text(), table.getvalue())


@pytest.fixture
def killing(monkeypatch):
    """Have a worker killed in the middle of a study; what came of it, by and by."""

    def kill(find):
        run, came = montecarlo.run_jobs, []

        def run_and_kill(*arguments):
            for result in run(*arguments):
                came.append(result)
                if len(came) == 3:
                    os.kill(find(), signal.SIGKILL)
                yield result

        monkeypatch.setattr(montecarlo, "run_jobs", run_and_kill)
        return came

    return kill


def test_a_cluster_gives_the_same_file_also_when_a_worker_is_killed(
    tmp_path, study, killing, distributed
):
    with distributed.LocalCluster(**ONE_WORKER | {"n_workers": 2}) as cluster:
        came = killing(lambda: next(iter(cluster.workers.values())).pid)
        assert (
            written(tmp_path, "--scheduler", cluster.scheduler_address) == study.result
        )
    assert len(came) > 3


def worker_process():
    """One of the processes that this one has started to share work."""
    children = [
        pid
        for task in Path("/proc/self/task").glob("*/children")
        for pid in task.read_text().split()
    ]
    return next(
        int(pid)
        for pid in children
        if b"LokyProcess" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )


@pytest.mark.skipif(
    not Path("/proc/self/task").exists(), reason="finds the worker processes in /proc"
)
def test_two_processes_give_the_same_file_as_one_also_when_one_is_killed(
    tmp_path, study, killing
):
    came = killing(worker_process)
    assert written(tmp_path, "--workers", "2") == study.result
    assert len(came) > 3


WORK = """
import sys
from fdi_ros.system.jobs import run_jobs

lost = None if sys.argv[1] == "None" else print
text = f"import os, time; print(os.getpid(), file=open({sys.argv[2]!r}, 'w'), flush=True); time.sleep(1000)"
list(run_jobs(exec, [(text,), ("",)], 2, None, lost))
"""


@pytest.mark.skipif(
    not Path("/proc/self/task").exists(), reason="finds the worker processes in /proc"
)
@pytest.mark.parametrize("lost", ["None", "given"])
def test_workers_end_when_their_parent_is_killed(tmp_path, lost):
    def until(done):
        end = time.monotonic() + 60
        while not done():
            assert time.monotonic() < end
            time.sleep(0.05)

    said = tmp_path / "said"
    parent = subprocess.Popen([sys.executable, "-c", WORK, lost, said])
    until(lambda: said.exists() and said.read_text().endswith("\n"))
    worker = Path("/proc") / said.read_text().strip()
    assert worker.exists()
    parent.kill()
    parent.wait()
    until(
        lambda: not worker.exists() or "Z" in (worker / "stat").read_text().split()[2]
    )


def test_workers_that_always_die_end_the_study_with_one_line():
    with pytest.raises(
        StudyError,
        match="a job was given up: the worker process that ran it died 3 times",
    ):
        list(jobs.run_jobs(os._exit, [(1,), (1,)], 2, None))


def check_that_one_is_lost(folder, cluster):
    def note(k):
        (folder / f"{k}_{os.getpid()}").touch()
        if k == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return 10 * k

    found = list(
        jobs.run_jobs(
            note, [(k,) for k in range(6)], 2, cluster, lost=lambda k, words: words
        )
    )
    results = dict(found)
    assert len(found) == len(results)
    times = int(
        re.fullmatch(
            r"the worker process that ran it died (\d) times \(.*\)", results.pop(1)
        )[1]
    )
    assert results == {k: 10 * k for k in (0, 2, 3, 4, 5)}
    return times, {k: len(list(folder.glob(f"{k}_*"))) for k in range(6)}


def test_a_job_that_kills_its_process_is_given_up_and_no_other_is_run_twice(tmp_path):
    times, starts = check_that_one_is_lost(tmp_path, None)
    assert times == jobs.MAX_DEATHS
    assert starts == {0: 1, 1: times, 2: 1, 3: 1, 4: 1, 5: 1}
    # A single one is not run in this process either.
    assert list(
        jobs.run_jobs(os._exit, [(1,)], 2, None, lost=lambda k, words: "lost")
    ) == [(0, "lost")]


def test_a_job_that_kills_its_worker_on_a_cluster_is_given_up_and_the_others_are_not(
    tmp_path, distributed
):
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        # One worker: others are with it when it dies.
        distributed.LocalCluster(**ONE_WORKER) as cluster,
    ):
        check_that_one_is_lost(tmp_path, cluster.scheduler_address)


def certificate(folder, name):
    """A certificate that its key has signed itself, and the key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    key, made = folder / f"{name}-key.pem", folder / f"{name}.pem"
    words = f"req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN={name} -keyout {key} -out {made}"
    subprocess.run(["openssl", *words.split()], check=True, capture_output=True)
    return str(made), str(key)


def test_a_cluster_over_tls_works_for_those_with_its_certificate(
    tmp_path, monkeypatch, distributed
):
    import dask

    ours, foreign = certificate(tmp_path, "ours"), certificate(tmp_path, "foreign")
    known = {f"tls_{who}_{what}": path for who in ("scheduler", "worker", "client")
             for what, path in zip(("cert", "key"), ours, strict=True)}  # fmt: skip
    security = distributed.Security(
        tls_ca_file=ours[0], require_encryption=True, **known
    )
    monkeypatch.setattr(jobs, "CONNECT_TIMEOUT", 3.0)
    with distributed.LocalCluster(
        protocol="tls", security=security, processes=False, **ONE_WORKER
    ) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        for given in (ours, foreign, None):
            names = zip(
                ("ca-file", "client.cert", "client.key"),
                (ours[0], *(given or ())),
                strict=False,
            )
            with dask.config.set(
                {f"distributed.comm.tls.{name}": path for name, path in names if given}
            ):
                if given == ours:
                    assert dict(jobs.run_jobs(abs, [(-1,), (-2,)], 1, address)) == {
                        0: 1,
                        1: 2,
                    }
                    continue
                with pytest.raises(
                    StudyError, match=f"no Dask scheduler at {address}: "
                ):
                    list(jobs.run_jobs(abs, [(-1,)], 1, address))


@pytest.mark.parametrize(("host", "warned"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_a_scheduler_without_tls_that_others_reach_is_warned_of(
    host, warned, capsys, distributed
):
    jobs._warn_if_open.cache_clear()
    with distributed.LocalCluster(
        host=host, protocol="tcp://", processes=False, **ONE_WORKER
    ) as cluster:
        port = cluster.scheduler_address.rpartition(":")[2]
        for _ in range(2):
            assert list(jobs.run_jobs(abs, [(-1,)], 1, f"tcp://127.0.0.1:{port}")) == [
                (0, 1)
            ]
    said = capsys.readouterr().err
    assert said.count("fdi: warning: the scheduler at tcp://127.0.0.1:") == warned
    assert (
        "whoever reaches it can run code on its workers and on this machine" in said
    ) == warned


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_a_scheduler_that_is_not_there_is_told_in_one_line(
    tmp_path, refused, monkeypatch, address, distributed
):
    monkeypatch.setattr(jobs, "CONNECT_TIMEOUT", 1.0)
    assert address in refused(
        "montecarlo", study_file(tmp_path, SMALL), "--scheduler", address
    )


def test_chi_square_and_isolation_agree_with_closed_form_and_reference(tmp_path):
    """Shares named, and named and declared, as printed, for sizes 4, 6 and 8."""
    printed = {
        "dodecahedron": [(0.753, 0.161), (0.945, 0.652), (0.993, 0.961)],
        "two_triad_cone": [(0.715, 0.153), (0.910, 0.630), (0.978, 0.948)],
    }
    what = {
        "geometries": [*printed],
        "detectors": ["chi_square"],
        "thresholds": "derived",
        "sizes": [4, 6, 8],
    }
    section = run(tmp_path, "snapshot", 5, **what, trials=30_000, sound_trials=1000)
    for name, shares in printed.items():
        cells = [
            cell
            for cell in section["cells"]
            if cell["geometry"] == name and cell["size"]
        ]
        for cell, (named, both) in zip(cells, shares, strict=True):
            (figures,) = cell["methods"]["chi_square"]
            closed = 1.0 - float(chndtr(16.266, 3, cell["size"] ** 2 / 2))
            for key, truth, digits in (
                ("declared", closed, 0.0),
                ("identified", named, 5e-4),
                ("right", both, 5e-4),
            ):
                error = 3.5 * math.sqrt(truth * (1 - truth) / 3e4) + digits
                assert figures[key]["value"] == pytest.approx(truth, abs=error)


def best_possible(geometry, size, alarm, draws=60_000):
    """Share of faults declared with the right name by Bayes' decision, which knows the size; of one simulation."""
    rng, directions = np.random.default_rng(4), geometry.parity.T
    channel = rng.integers(geometry.n, size=draws)
    struck = (size * rng.choice([-1, 1], draws))[:, None] * directions[channel]

    def odds(struck):
        along = (
            size
            * (rng.standard_normal((draws, directions.shape[1])) + struck)
            @ directions.T
        )
        return np.logaddexp(along, -along) - 0.5 * size**2 * (directions**2).sum(axis=1)

    level, found = np.quantile(odds(0.0).max(axis=1), 1 - alarm), odds(struck)
    return float(
        ((found.max(axis=1) >= level) & (found.argmax(axis=1) == channel)).mean()
    )


def test_every_method_has_the_common_false_alarm_rate_on_samples_not_used_to_find_it(
    tmp_path,
):
    what = {"sizes": [5], "false_alarms": [0.01], "geometries": ["cone_5"]}
    section = run(tmp_path, "snapshot", **what, trials=5000, sound_trials=50_000)
    sound, faulty = section["cells"]
    assert {"determinant", "likelihood_ratio", "guaranteed"} <= set(sound["methods"])
    assert "judges a stream" in section["not_run"]["cone_5"]["cusum"]
    # The threshold is as uncertain as the share: sqrt 2 of its standard error.
    error = math.sqrt(2 * 0.01 * 0.99 / 50_000)
    for name, (figures,) in sound["methods"].items():
        assert figures["declared"]["value"] == pytest.approx(0.01, abs=4 * error), name
    best = best_possible(Geometry.cone(5), 5.0, 0.01)
    for name, (figures,) in faulty["methods"].items():
        assert figures["right"]["low"] <= best + 0.02, name
        assert figures["right"]["value"] > 0.8 * best, name


def test_the_protocol_of_2019_gives_its_printed_figures_under_the_opposite_selection(
    tmp_path,
):
    """80.3 % detected, 8 % undetected, 7.3 % falsely determined; at sigma_0 = 0.2 sigma_k 2 deg/s."""
    names = [
        "mean_abs_residual",
        "mean_square_residual",
        "rate_deviation",
        "max_residual",
        "likelihood_ratio",
    ]
    what = {
        "detectors": names,
        "false_alarms": [0.01],
        "selections": ["stands_out", "printed"],
    }
    section = run(
        tmp_path, "residual_search", 2019, **what, trials=8000, sound_trials=4000
    )
    cells = {cell["selection"]: cell for cell in section["cells"]}
    outcomes = [
        {
            name: figure["value"]
            for name, figure in cells["stands_out"]["paper_tolerance"][search].items()
        }
        for search in names[:4]
    ]
    assert outcomes[1:] == outcomes[:-1], "the four searches name the same channel"
    found = outcomes[0]
    assert found["right_declared"] == pytest.approx(0.803, abs=0.04)
    assert found["right_within"] + found["wrong_within"] == pytest.approx(
        0.08, abs=0.04
    )
    assert found["wrong_declared"] == pytest.approx(0.073, abs=0.04)
    assert (
        0.14
        < cells["sound"]["paper_tolerance"]["max_residual"]["declared"]["value"]
        < 0.18
    )
    assert (
        cells["printed"]["paper_tolerance"]["max_residual"]["right_declared"]["value"]
        < 0.25
    )
    # Rate-dependent errors weighed sample by sample name the right channel more often.
    at_equal_alarms = {
        name: cells["stands_out"]["methods"][name][0]["right_declared"]
        for name in names
    }
    assert (
        at_equal_alarms["likelihood_ratio"]["low"]
        > at_equal_alarms["max_residual"]["high"]
    )


def test_delays_without_memory_are_geometric_and_those_of_cusum_shorter_never_below_the_limit(
    tmp_path,
):
    what = {
        "detectors": ["likelihood_ratio", "cusum"],
        "run_length": 1000,
        "longest": 400,
        "lead": 50,
    }
    (cell,) = run(
        tmp_path, "delay", 9, **what, sizes=[3.0], trials=300, sound_trials=600
    )["cells"]
    ratio, cusum = (cell["methods"][name]["mean_delay"] for name in what["detectors"])
    what = {
        "detectors": ["likelihood_ratio"],
        "false_alarms": [0.001],
        "sound_trials": 100_000,
    }
    section = run(tmp_path, "snapshot", 9, **what, sizes=[3], trials=40_000)
    power = section["cells"][1]["methods"]["likelihood_ratio"][0]["declared"]["value"]
    # Run lengths are found from 600 windows: some 15 % of uncertainty, beside that of 300 delays.
    assert ratio["value"] == pytest.approx(1 / power, rel=0.3)
    assert cell["limit"]["moustakides"] < cusum["high"] < ratio["low"]


def test_cusum_run_lengths_of_the_textbook():
    """Reference 0.5, limit 5: two-sided run length 465 and delay 10.4 at one standard deviation (Montgomery)."""
    assert cusum_run_length(5.0, 0.5, 0.0) / 2 == pytest.approx(465, abs=0.6)
    assert cusum_run_length(5.0, 0.5, 1.0) == pytest.approx(10.4, abs=0.05)
    # Without memory: geometric.
    assert cusum_run_length(0.0, 2.0, 0.0) == pytest.approx(1 / ndtr(-2.0))


@pytest.mark.parametrize(
    ("shift", "known"), [(0.25, 510), (0.5, 138), (1.0, 37), (2.0, 10)]
)
def test_the_least_delay_lies_below_a_cusum_that_watches_both_sides_and_near_the_first_order(
    shift, known
):
    """Two-sided delays as tabulated at a run length of 3.6e8; the first order is Lorden's (1971)."""
    least = moustakides_delay(shift, 3.6e8)
    assert 0.9 * known < least < known * 1.01
    assert least == pytest.approx(math.log(3.6e8) / (0.5 * shift**2), rel=0.25)


def test_faults_through_the_whole_monitor_are_declared_and_sound_flights_are_not(
    tmp_path,
):
    monitor = {
        "noise.noise_std": 0.003,
        "noise.scale_std": 0.002,
        "noise.timing_std": 0.0003,
    }
    monitor |= {"bias.startup_bias_duration": 2.0}
    what = {
        "detectors": ["likelihood_ratio"],
        "kinds": ["none", "bias", "dropout"],
        "monitor": monitor,
    }
    section = run(tmp_path, "flight", 13, **what, trials=8)
    cells = {
        cell["fault"]: cell["methods"]["likelihood_ratio"] for cell in section["cells"]
    }
    assert cells["none"]["wrong"]["value"] == 0
    assert cells["bias"]["right"]["value"] == cells["dropout"]["right"]["value"] == 1
    assert cells["dropout"]["delay_s"]["p50"] == pytest.approx(0.1, abs=0.021)
    assert cells["bias"]["rms_after"] < 2 * cells["none"]["rms_after"]


def test_a_report_has_the_tables_and_shows_bands(study):
    assert "best possible" in study.table
    for kind in ("One fault", "Largest residual is the right one", "Delay"):
        for text in (study.page, study.table):
            assert f"{kind}, two_triad_cone" in text
    assert '"type":"band"' in study.page


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_the_studies_that_come_with_the_package_are_valid(path):
    study = load_study(path, trials=5, seed=1)
    assert all(section.settings["trials"] == 5 for section in study.sections)
    assert study.title


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty or no mapping"),
        ("a: [", "is not YAML"),
        (
            {"seed": 1},
            "has no section, expected some of: residual_search, snapshot, delay, flight",
        ),
        ({"snapshots": {}}, "unknown section 'snapshots'"),
        (
            {"snapshot": {"trails": 5}},
            "unknown setting 'trails', did you mean 'trials'?",
        ),
        ({"snapshot": {"trials": 0}}, "snapshot.trials is 0, expected 1 to 1e+09"),
        (
            {"snapshot": {"trials": 2.5}},
            "snapshot.trials is 2.5, expected a whole number",
        ),
        (
            {"snapshot": {"detectors": ["max"]}},
            "snapshot.detectors is 'max', expected one of: mean_abs_residual",
        ),
        (
            {"snapshot": {"geometries": ["cone_3"]}},
            "snapshot.geometries is 'cone_3', expected one of: two_triad_cone",
        ),
        (
            {"snapshot": {"thresholds": "derived", "false_alarms": [0.1, 0.01]}},
            "expected one of snapshot.false_alarms",
        ),
        (
            {"flight": {"rest": 5, "duration": 8}},
            "flight.duration is 8 s, expected at least 2 flight.rest + 1 s: 11 s",
        ),
        ({"seed": -1, "delay": {}}, "study.seed is -1"),
    ],
)
def test_a_study_that_does_not_fit_is_refused_in_one_line(
    tmp_path, refused, content, words
):
    assert words in refused("montecarlo", study_file(tmp_path, content), "--workers", 1)


def test_arguments_that_do_not_fit_are_refused(tmp_path, refused):
    path = study_file(tmp_path, SMALL)
    assert "cannot read study nowhere.yaml: No such file" in refused(
        "montecarlo", "nowhere.yaml"
    )
    for workers in (0, 257):
        assert f"workers is {workers}, expected 1 to 256" in refused(
            "montecarlo", path, "--workers", workers
        )
    assert "give one" in refused(
        "montecarlo", path, "--workers", 2, "--scheduler", "tcp://a:1"
    )


@given(st.integers(1, 10_000), st.floats(0, 1))
def test_intervals_of_shares_are_those_of_wilson(trials, p):
    count = round(p * trials)
    """Its ends are the shares from which the one found is just 1.96 standard deviations away."""
    figure = share(count, trials)
    found = count / trials
    assert 0.0 <= figure.low <= found <= figure.high <= 1.0
    assert figure.low < figure.high
    for end in (figure.low, figure.high):
        assert (end - found) ** 2 == pytest.approx(
            ndtri(0.975) ** 2 * end * (1.0 - end) / trials, abs=1e-12
        )


@given(st.lists(st.integers(0, 50), min_size=1, max_size=200))
def test_quantiles_of_a_histogram_are_those_of_its_values(values):
    found, counts = np.unique(values, return_counts=True)
    histogram = dict(zip(map(str, found), counts.tolist(), strict=True))
    expected = np.quantile(values, [0.5, 0.9, 0.99], method="inverted_cdf").tolist()
    assert list(quantiles(histogram).values()) == expected


# Flights: the motion is possible for a vehicle, and the gyros are off by what was asked for ---------------------------


ERRORS = (
    "noise_std",
    "bias_std",
    "bias_walk",
    "scale_std",
    "misalignment_std",
    "delay_std",
    "resolution",
)
PERFECT = GyroErrors(**dict.fromkeys(ERRORS, 0), max_rate=np.inf)
CONE = Geometry.two_triad_cone()


def acceleration(motion, t):
    return (motion.rate_at(t + 1e-4) - motion.rate_at(t - 1e-4)) / 2e-4


@given(
    seed=st.integers(0, 2**32 - 1),
    max_rate=st.floats(0.1, 10),
    max_acceleration=st.floats(1, 100),
)
def test_motion_keeps_its_bounds(seed, max_rate, max_acceleration):
    motion = vehicle_motion(
        30.0,
        np.random.default_rng(seed),
        rest=5.0,
        max_rate=max_rate,
        max_acceleration=max_acceleration,
    )
    t = np.linspace(-1, motion.time[-1] + 1, 4000)
    assert np.abs(motion.rate_at(t)).max() <= max_rate * (1 + 1e-12)
    assert np.abs(acceleration(motion, t)).max() <= max_acceleration * (1 + 1e-6)
    assert not motion.rate_at(t[t <= 5.0]).any()
    assert not motion.rate_at(motion.time[-1:] + 1).any()


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ({"noise_std": 0.01}, lambda t: np.full_like(t, 0.01)),
        ({"bias_std": 0.02}, lambda t: np.full_like(t, 0.02)),
        ({"bias_walk": 0.003}, lambda t: 0.003 * np.sqrt(t)),
    ],
)
def test_errors_at_rest_have_the_deviation_asked_for(errors, expected):
    still = Motion(np.array([0.0, 1.0]), np.zeros((2, 3)))
    stamps = regular_stamps(16.0, 10.0)
    rng = np.random.default_rng(11)
    made = (replace(PERFECT, **errors).draw(CONE, rng) for _ in range(400))
    z = np.stack([gyros.measure(still, stamps, rng).z for gyros in made])
    measured = z.std(axis=(0, 2))[1:]
    # 2400 draws: the deviation is known to 1.4 %.
    np.testing.assert_allclose(measured, expected((stamps[1:]) * 1e-9), rtol=0.07)


def test_scale_and_misalignment_turn_and_stretch_the_axes():
    rng = np.random.default_rng(5)
    axes = np.stack(
        [
            replace(PERFECT, scale_std=0.01, misalignment_std=0.02).draw(CONE, rng).axes
            for _ in range(2000)
        ]
    )
    along = np.sum(axes * CONE.axes, axis=2)
    across = np.linalg.norm(axes - along[..., None] * CONE.axes, axis=2)
    assert np.std(along) == pytest.approx(0.01, rel=0.05)
    assert np.sqrt(np.mean(across**2) / 2) == pytest.approx(0.02, rel=0.05)


def test_sampling_skew_is_acceleration_times_delay_and_one_a_chip():
    ramp = Motion(np.array([0.0, 10.0]), np.array([[0.0, 0, 0], [3.0, -2.0, 1.0]]))
    stamps = regular_stamps(10.0, 100.0)
    gyros = replace(PERFECT, delay_std=1e-3).draw(CONE, np.random.default_rng(6))
    assert len(np.unique(gyros.delay)) == 2
    t = stamps * 1e-9
    off = (
        gyros.measure(ramp, stamps, np.random.default_rng(0)).z
        - ramp.rate_at(t) @ CONE.axes.T
    )
    np.testing.assert_allclose(
        off, acceleration(ramp, t) @ CONE.axes.T * gyros.delay, atol=1e-6
    )


def test_the_bundled_bag_is_what_its_script_makes(flight, root, monkeypatch):
    """Channels and both Imu topics of the bag against the simulation run again."""
    monkeypatch.syspath_prepend(str(root / "bags"))
    import make_bags

    made = make_bags.fly()
    channels, imus = (
        read_block(flight, Config.from_file(root / "config" / name))
        for name in ("two_triads.yaml", "two_imus.yaml")
    )
    # A last-bit difference of the machine's arithmetic may move a value over the edge of a step, no further.
    assert np.abs(channels.z - made.z).max() <= 1.001 * GyroErrors().resolution
    along = np.sum(
        np.vstack([mount.T for mount in make_bags.mounts()[:2]]) * CONE.axes, axis=1
    )
    np.testing.assert_allclose(np.abs(along), 1, atol=1e-12)
    np.testing.assert_array_equal(imus.z, channels.z * np.sign(along))
    for read in (channels, imus):
        np.testing.assert_array_equal(read.stamp, made.stamp)
