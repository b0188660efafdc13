# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where blocks of trials run: this process, processes of this machine, or a Dask cluster.

A worker that dies costs the time of its blocks: they are run again. The results do not depend on which worker ran what.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from joblib import Parallel, delayed, parallel_config

from fdi_ros.errors import StudyError

Job = tuple[Any, ...]
"""Arguments of one call; picklable."""
Function = Callable[..., Any]

MAX_BREAKS = 5
"""Times that workers may die without a block done in between before the study gives up."""
CONNECT_TIMEOUT = 10.0


def run_jobs(function: Function, jobs: Sequence[Job], workers: int, scheduler: str | None) -> Iterator[tuple[int, Any]]:
    """Run all jobs and give (index, result) as they are done, in any order.

    Parameters
    ----------
    function
        Of a module that the workers can import.
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
        return _on_dask(function, jobs, scheduler)
    if workers == 1 or len(jobs) == 1:
        return ((k, function(*job)) for k, job in enumerate(jobs))
    return _on_processes(function, jobs, min(workers, len(jobs)))


def _on_processes(function: Function, jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Any]]:
    left, breaks = dict(enumerate(jobs)), 0
    while left:
        before = len(left)
        # As many processes as cores are enough: one BLAS thread each.
        with parallel_config("loky", inner_max_num_threads=1):
            # Few jobs ahead: those dispatched when the study is stopped are lost. Arrays are sent whole, not as files.
            pool = Parallel(workers, return_as="generator", batch_size=1, pre_dispatch=workers + 1, max_nbytes=None)
        try:
            results = pool(delayed(function)(*job) for job in tuple(left.values()))
            for k, result in zip(tuple(left), results, strict=True):
                del left[k]
                yield k, result
        except BrokenProcessPool as error:
            breaks = breaks + 1 if len(left) == before else 0
            if breaks >= MAX_BREAKS:
                raise StudyError(f"worker processes died {breaks} times in a row without finishing a block") from error


def _on_dask(function: Function, jobs: Sequence[Job], address: str) -> Iterator[tuple[int, Any]]:
    if not re.fullmatch(r"\w+://.+:\d+", address):
        raise StudyError(f"scheduler is {address!r}, expected an address such as tcp://host:8786")
    try:
        import distributed
    except ImportError as error:
        raise StudyError("--scheduler needs Dask: pip install 'fdi_ros[cluster]'") from error
    with _connected(distributed, address) as client:
        # Not pure: the same arguments may be a block of another study's seed on the same cluster.
        futures = {client.submit(function, *job, pure=False, retries=MAX_BREAKS): k for k, job in enumerate(jobs)}
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                yield futures[future], future.result()
        except (distributed.KilledWorker, distributed.client.FutureCancelledError, OSError) as error:
            raise StudyError(f"the cluster at {address} was lost: {_line(error)}") from error


@contextmanager
def _connected(distributed: Any, address: str) -> Iterator[Any]:
    import logging

    # A scheduler that is not there is reported in one line of ours, not in pages of retries.
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
