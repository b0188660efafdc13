# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where jobs run (blocks of trials, recordings): this process, processes of this machine, or a Dask cluster.

A worker that dies costs the time of its jobs: they are run again. The results do not depend on which worker ran what.
A job that kills its worker every time ends the run, or, where the caller says what stands for it, costs itself alone.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import ProcessPoolExecutor, TerminatedWorkerError

from fdi_ros.errors import StudyError
from fdi_ros.jobs.cluster import Cluster, Function, Job, Lost, died_words, on_cluster

MAX_BREAKS = 5
"""Times that workers may die without a block done in between before the study gives up."""
MAX_DEATHS = 3
"""Processes that a job may kill until it is given up."""
ONE_THREAD = dict.fromkeys(
    (
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
    ),
    "1",
)
"""Environment of a worker process: as many processes as cores are enough."""


def run_jobs(
    function: Function,
    jobs: Sequence[Job],
    workers: int,
    cluster: Cluster | None,
    lost: Lost | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run all jobs and give (index, result) as they are done, in any order.

    Parameters
    ----------
    function
        Of a module that the workers can import.
    jobs
        Its arguments.
    workers
        Processes; 1: this process alone.
    cluster
        Dask cluster that works instead, or None.
    lost
        Makes the result of a job that kills its worker again and again. Without it such a job ends the run. In this
        process alone there is no worker to be killed.

    Raises
    ------
    StudyError
        If the scheduler is not there, or is lost, or workers die again and again and `lost` is not given.
    """
    if not jobs:
        return iter(())
    if cluster is not None:
        return on_cluster(function, jobs, cluster, lost)
    # A single job that may kill its process is kept out of this one.
    if workers == 1 or (len(jobs) == 1 and lost is None):
        return ((k, function(*job)) for k, job in enumerate(jobs))
    if lost is None:
        return _on_processes(function, jobs, min(workers, len(jobs)))
    return _on_single_processes(function, jobs, min(workers, len(jobs)), lost)


def _on_processes(function: Function, jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Any]]:
    left, breaks = dict(enumerate(jobs)), 0
    while left:
        before = len(left)
        # As many processes as cores are enough: one BLAS thread each.
        with parallel_config("loky", inner_max_num_threads=1):
            # Few jobs ahead: those dispatched when the study is stopped are lost. Arrays are sent whole, not as files.
            pool = Parallel(workers, return_as="generator", batch_size=1, pre_dispatch=workers + 1, max_nbytes=None)
        try:
            results = pool(delayed(_in_worker)(os.getpid(), function, job) for job in tuple(left.values()))
            for k, result in zip(tuple(left), results, strict=True):
                del left[k]
                yield k, result
        except BrokenProcessPool as error:
            breaks = breaks + 1 if len(left) == before else 0
            if breaks >= MAX_BREAKS:
                raise StudyError(f"worker processes died {breaks} times in a row without finishing a block") from error


def _on_single_processes(
    function: Function, jobs: Sequence[Job], workers: int, lost: Lost
) -> Iterator[tuple[int, Any]]:
    """Run each job in a process that has no other: if it dies, the cause is known and no other job is run again.

    The processes of one pool would all be ended together. They are kept from one call to the next, though, which suits
    many short jobs.
    """
    waiting, deaths = deque(range(len(jobs))), Counter[int]()
    idle = [_SingleProcess() for _ in range(workers)]
    running: dict[Future[Any], tuple[int, _SingleProcess]] = {}
    finished: list[tuple[int, Any]] = []
    try:
        while waiting or running or finished:
            # Those that have killed a process come last, one at a time: together they may want too much memory.
            while idle and waiting and not (deaths[waiting[0]] and running):
                k, process = waiting.popleft(), idle.pop()
                running[process.submit(function, jobs[k])] = k, process
            # Only now, so that no process waits for what is done with the results.
            yield from finished
            finished.clear()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                k, process = running.pop(future)
                idle.append(process)
                try:
                    finished.append((k, future.result()))
                except TerminatedWorkerError:
                    deaths[k] += 1
                    if deaths[k] < MAX_DEATHS:
                        waiting.append(k)
                    else:
                        finished.append((k, lost(k, died_words(deaths[k]))))
    finally:
        for process in (*idle, *(process for _, process in running.values())):
            process.kill()


class _SingleProcess:
    """A worker process for one job at a time; it starts with the first, and again after it died."""

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(1, env=ONE_THREAD)

    def submit(self, function: Function, job: Job) -> Future[Any]:
        """Begin a job."""
        try:
            return self._submit(function, job)
        except TerminatedWorkerError:
            # It died under the last job, or since.
            self.kill()
            self._pool = ProcessPoolExecutor(1, env=ONE_THREAD)
            return self._submit(function, job)

    def kill(self) -> None:
        """End it, whatever it does."""
        self._pool.shutdown(kill_workers=True)

    def _submit(self, function: Function, job: Job) -> Future[Any]:
        future: Future[Any] = self._pool.submit(_in_worker, os.getpid(), function, job)
        return future


def _in_worker(parent: int, function: Function, job: Job) -> Any:
    """Do a job in a worker process, which ends when its parent does: killed, that can no longer end it."""
    _follow(parent)
    return function(*job)


@functools.cache
def _follow(parent: int) -> None:
    """Watch from now on whether the parent lives."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
