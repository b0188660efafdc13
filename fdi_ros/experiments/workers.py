"""Where blocks of trials run: this process, processes of this machine, or a Dask cluster.

A worker that dies costs the time of its blocks: they are run again. The results do not depend on who ran what.
"""

from __future__ import annotations

import multiprocessing
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from fdi_ros.errors import StudyError

Job = tuple[Any, ...]
"""Arguments of one call; picklable."""
Work = Callable[..., Any]

BLAS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MAX_BREAKS = 5
"""Times that workers may die without a block done in between before the study gives up."""
CONNECT_TIMEOUT = 10.0


def run_jobs(work: Work, jobs: Sequence[Job], workers: int, scheduler: str | None) -> Iterator[tuple[int, Any]]:
    """Run all jobs and give (index, result) as they are done, in any order.

    Parameters
    ----------
    work
        Function of a module that the workers can import.
    jobs
        Its arguments.
    workers
        Processes; 1: this process alone.
    scheduler
        Address of a Dask scheduler, or None.

    Raises
    ------
    StudyError
        If the scheduler is not there, or workers die again and again.
    """
    if not jobs:
        return iter(())
    if scheduler is not None:
        return _on_dask(work, jobs, scheduler)
    if workers == 1 or len(jobs) == 1:
        return ((k, work(*job)) for k, job in enumerate(jobs))
    return _on_processes(work, jobs, min(workers, len(jobs)))


def _on_processes(work: Work, jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Any]]:
    left, breaks = dict(enumerate(jobs)), 0
    while left:
        before = len(left)
        try:
            for k, result in _pooled(work, left, workers):
                del left[k]
                yield k, result
        except BrokenProcessPool as error:
            breaks = breaks + 1 if len(left) == before else 0
            if breaks >= MAX_BREAKS:
                raise StudyError(f"worker processes died {breaks} times in a row without finishing a block") from error


def _pooled(work: Work, left: dict[int, Job], workers: int) -> Iterator[tuple[int, Any]]:
    # Spawned: forking a process that has BLAS or ROS threads can hang.
    context = multiprocessing.get_context("spawn")
    with _one_blas_thread(), ProcessPoolExecutor(workers, mp_context=context) as pool:
        # Few jobs ahead: what is submitted has to finish when the study is stopped.
        waiting = iter(list(left.items()))
        running: dict[Future[Any], int] = {}
        try:
            while True:
                while len(running) < workers + 1 and (item := next(waiting, None)) is not None:
                    running[pool.submit(work, *item[1])] = item[0]
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    k = running.pop(future)
                    yield k, future.result()
        finally:
            for future in running:
                future.cancel()


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Children inherit one BLAS thread each: as many processes as cores are enough."""
    before = {name: os.environ.get(name) for name in BLAS}
    os.environ.update(dict.fromkeys(BLAS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _on_dask(work: Work, jobs: Sequence[Job], address: str) -> Iterator[tuple[int, Any]]:
    if not re.fullmatch(r"\w+://.+:\d+", address):
        raise StudyError(f"scheduler is {address!r}, expected an address such as tcp://host:8786")
    try:
        import distributed
    except ImportError as error:
        raise StudyError("--scheduler needs Dask: pip install 'fdi_ros[cluster]'") from error
    with _connected(distributed, address) as client:
        # Not pure: the same arguments may be a block of another study's seed on the same cluster.
        futures = {client.submit(work, *job, pure=False, retries=MAX_BREAKS): k for k, job in enumerate(jobs)}
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                yield futures[future], future.result()
        except (distributed.KilledWorker, distributed.client.FutureCancelledError, OSError) as error:
            raise StudyError(f"the cluster at {address} was lost: {_line(error)}") from error


@contextmanager
def _connected(distributed: Any, address: str) -> Iterator[Any]:
    import logging

    # A scheduler that is not there is told by one line of ours, not by pages of retries.
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        try:
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise StudyError(f"no Dask scheduler at {address}: {_line(error)}") from error
        with client:
            yield client
    finally:
        logger.setLevel(level)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
