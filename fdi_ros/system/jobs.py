# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run jobs (blocks of trials, recordings) here, in local processes, or on a Dask cluster.

A job whose worker dies runs again. Results do not depend on the choice of workers. A
job that kills every worker ends the run, unless the caller provides a substitute
result.

A cluster address with tls:// uses the certificates of Dask's configuration. A scheduler
without TLS lets everybody who reaches its port run code on the workers and, since
results are pickled, here. A warning names such a scheduler.
"""

from __future__ import annotations

import functools
import ipaddress
import os
import re
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from typing import Any

from joblib.externals.loky.process_executor import (
    BrokenProcessPool,
    ProcessPoolExecutor,
)

from fdi_ros.errors import StudyError
from fdi_ros.system import require

#: arguments of one call, picklable
Job = tuple[Any, ...]
Function = Callable[..., Any]
Lost = Callable[[int, str], Any]
"""Makes the result of an abandoned job from its index and one line with the reason."""

#: processes that a job may kill before the run gives up; retries of a job on a cluster
MAX_DEATHS = 3
#: processes on this machine
MOST_WORKERS = 256
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")
ONE_THREAD = dict.fromkeys(
    (*(f"{name}_NUM_THREADS" for name in _THREADS), "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment of a worker process: as many processes as cores are enough."""


def worker_count(workers: int | None) -> int:
    """Return the number of processes, None means one per core. `StudyError` if out of range."""
    count = (os.cpu_count() or 1) if workers is None else workers
    if not 1 <= count <= MOST_WORKERS:
        raise StudyError(f"workers is {count}, expected 1 to {MOST_WORKERS}")
    return count


def _give_up(k: int, words: str) -> Any:
    raise StudyError(f"a job was given up: {words}")


def run_jobs(
    function: Function,
    jobs: Sequence[Job],
    workers: int,
    cluster: str | None,
    lost: Lost = _give_up,
) -> Iterator[tuple[int, Any]]:
    """Run all jobs and yield (index, result) as they finish.

    A job holds the arguments of a function that workers can import. ``workers``: number
    of processes, 1 for this process alone. ``cluster``: address of a Dask scheduler to
    use instead, ``tcp://host:port`` or ``tls://host:port``. ``lost`` makes the result
    of a job that repeatedly kills its worker; without ``lost`` such a job ends the run.
    `StudyError` if the address is invalid, the scheduler is unreachable, or a job is
    abandoned.
    """
    if not jobs:
        return iter(())
    if cluster is not None:
        if not re.fullmatch(r"\w+://.+:\d+", cluster):
            raise StudyError(
                f"scheduler is {cluster!r}, expected an address such as tcp://host:8786"
            )
        return _on_cluster(function, jobs, cluster, lost)
    # A single job that may kill its process is kept out of this one.
    if workers == 1 or (len(jobs) == 1 and lost is _give_up):
        return ((k, function(*job)) for k, job in enumerate(jobs))
    return _on_processes(function, jobs, min(workers, len(jobs)), lost)


def _on_processes(
    function: Function, jobs: Sequence[Job], workers: int, lost: Lost
) -> Iterator[tuple[int, Any]]:
    """Run each job in a process of its own, so that a crash identifies the job.

    A process pool would end all its processes together.
    """
    waiting = deque(range(len(jobs)))
    deaths = Counter[int]()
    idle = [ProcessPoolExecutor(1, env=ONE_THREAD) for _ in range(workers)]
    running: dict[Future[Any], tuple[int, ProcessPoolExecutor]] = {}

    def begin(k: int, process: ProcessPoolExecutor) -> None:
        """Begin a job, in a new process if the idle one has died."""
        try:
            running[process.submit(_in_worker, os.getpid(), function, jobs[k])] = (
                k,
                process,
            )
        except BrokenProcessPool:
            process.shutdown(kill_workers=True)
            begin(k, ProcessPoolExecutor(1, env=ONE_THREAD))

    try:
        while waiting or running:
            # Those that have killed a process come last, one at a time: together they may want too much memory.
            while idle and waiting and not (deaths[waiting[0]] and running):
                begin(waiting.popleft(), idle.pop())
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                k, process = running.pop(future)
                idle.append(process)
                try:
                    yield k, future.result()
                except BrokenProcessPool:
                    deaths[k] += 1
                    if deaths[k] < MAX_DEATHS:
                        waiting.append(k)
                    else:
                        yield k, lost(k, _died_words(deaths[k]))
    finally:
        for process in (*idle, *(process for _, process in running.values())):
            process.shutdown(kill_workers=True)


def _in_worker(parent: int, function: Function, job: Job) -> Any:
    """Run a job in a worker process that ends together with its parent."""
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


# On a cluster ---------------------------------------------------------------------------------------------------------

#: s
CONNECT_TIMEOUT = 10.0
TLS = "tls://"


def _on_cluster(
    function: Function, jobs: Sequence[Job], cluster: str, lost: Lost
) -> Iterator[tuple[int, Any]]:
    """Run all jobs on the cluster and yield (index, result), as `run_jobs` does."""
    require("--scheduler", ("dask", "distributed"))
    import distributed

    with _connected(distributed, cluster) as client:
        _warn_if_open(client.scheduler_info()["address"], cluster)

        def run(numbers: Iterable[int]) -> Iterator[tuple[int, Any]]:
            # Not pure: the same arguments may be a block of another study's seed on the same cluster.
            futures = {
                client.submit(function, *jobs[k], pure=False, retries=MAX_DEATHS): k
                for k in numbers
            }
            return (
                (futures[future], future)
                for future in distributed.as_completed(futures, loop=client.loop)
            )

        def deaths(future: Any) -> int:
            error = future.exception() if future.status == "error" else None
            return (
                error.allowed_failures + 1
                if isinstance(error, distributed.KilledWorker)
                else 0
            )

        suspects: list[int] = []
        try:
            for k, future in run(range(len(jobs))):
                if deaths(future):
                    suspects.append(k)
                else:
                    yield k, future.result()
            # Dask blames every job of a dead worker, begun or not. Only the guilty one
            # kills a worker that has no other job.
            for number in suspects:
                for k, future in run([number]):
                    times = deaths(future)
                    yield k, lost(k, _died_words(times)) if times else future.result()
        except (distributed.client.FutureCancelledError, OSError) as error:
            raise StudyError(
                f"the cluster at {cluster} was lost: {_line(error)}"
            ) from error


@functools.cache
def _warn_if_open(listens_at: str, address: str) -> None:
    """Warn once about a scheduler without TLS that others can reach."""
    host = listens_at.partition("://")[2].rpartition(":")[0].strip("[]")
    try:
        private = ipaddress.ip_address(host).is_loopback
    except ValueError:
        private = host == "localhost" or listens_at.startswith("inproc")
    if not private and not listens_at.startswith(TLS):
        print(
            f"fdi: warning: the scheduler at {address} listens at {listens_at} without TLS: whoever reaches it can run"
            " code on its workers and on this machine; see docs/fleet.md, A cluster that others reach",
            file=sys.stderr,
        )


@contextmanager
def _connected(distributed: Any, cluster: str) -> Iterator[Any]:
    import logging

    # A scheduler that is not there, or is lost, is reported in one line of ours, not in pages of retries.
    names = [
        name
        for name in logging.root.manager.loggerDict
        if name.partition(".")[0] == "distributed"
    ]
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in names}
    for logger in levels:
        logger.setLevel(logging.CRITICAL)
    try:
        try:
            security = (
                distributed.Security(require_encryption=True)
                if cluster.startswith(TLS)
                else None
            )
            client = distributed.Client(
                cluster,
                timeout=CONNECT_TIMEOUT,
                set_as_default=False,
                security=security,
            )
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            raise StudyError(
                f"no Dask scheduler at {cluster}: {_line(error)}"
            ) from error
        with client:
            yield client
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _died_words(times: int) -> str:
    """Return the line for an abandoned job."""
    return f"the worker process that ran it died {times} times (out of memory, or a crash in native code)"


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
