# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Jobs on a Dask cluster, over TLS where its address says so.

Whoever reaches a scheduler without TLS can run any code on its workers, and, since results are pickled, here. So one
that others can reach is warned of.
"""

from __future__ import annotations

import functools
import ipaddress
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_ros.errors import StudyError

Job = tuple[Any, ...]
"""Arguments of one call; picklable."""
Function = Callable[..., Any]
Lost = Callable[[int, str], Any]
"""Makes the result of a job that is given up, from its index and one line that says why."""

MAX_BREAKS = 5
"""Times that a job is tried again after its worker was lost."""
CONNECT_TIMEOUT = 10.0
"""s."""
TLS = "tls://"


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster, and what proves who is who where it is reached over TLS.

    Raises
    ------
    StudyError
        If the address is none, or the files do not suit it.
    """

    address: str
    """Of the scheduler: ``tcp://host:port`` or ``tls://host:port``."""
    ca_file: Path | None = None
    """Certificate by which those of the cluster are known; without the three Dask's own configuration holds."""
    certificate: Path | None = None
    """Our own."""
    key: Path | None = None
    """Of that certificate."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w+://.+:\d+", self.address):
            raise StudyError(f"scheduler is {self.address!r}, expected an address such as tcp://host:8786")
        files = {"--tls-ca-file": self.ca_file, "--tls-cert": self.certificate, "--tls-key": self.key}
        given = {name: path for name, path in files.items() if path is not None}
        if given and not self.address.startswith(TLS):
            raise StudyError(f"{next(iter(given))} is for a scheduler at {TLS}..., and this is {self.address}")
        if given and len(given) < len(files):
            missing = next(name for name in files if name not in given)
            raise StudyError(f"{missing} is missing: {', '.join(files)} belong together")
        for name, path in given.items():
            if not path.is_file():
                raise StudyError(f"{name}: there is no {path}")


def cluster_of(address: str | None, ca_file: Path | None, certificate: Path | None, key: Path | None) -> Cluster | None:
    """Return the cluster that was asked for; None: none was.

    Raises
    ------
    StudyError
        If what is given does not make one.
    """
    if address is None:
        if any((ca_file, certificate, key)):
            raise StudyError("--tls-ca-file, --tls-cert and --tls-key are for a cluster: give --scheduler, too")
        return None
    return Cluster(address, ca_file, certificate, key)


def on_cluster(
    function: Function, jobs: Sequence[Job], cluster: Cluster, lost: Lost | None
) -> Iterator[tuple[int, Any]]:
    """Run all jobs and give (index, result) as they are done; as `fdi_ros.jobs.workers.run_jobs`."""
    try:
        import distributed
    except ImportError as error:
        raise StudyError("--scheduler needs Dask: pip install 'fdi_ros[cluster]'") from error
    with _connected(distributed, cluster) as client:
        _warn_if_open(client.scheduler_info()["address"], cluster.address)

        def run(numbers: Iterable[int]) -> Iterator[tuple[int, Any]]:
            # Not pure: the same arguments may be a block of another study's seed on the same cluster.
            futures = {client.submit(function, *jobs[k], pure=False, retries=MAX_BREAKS): k for k in numbers}
            return ((futures[future], future) for future in distributed.as_completed(futures, loop=client.loop))

        try:
            yield from _results(run, len(jobs), distributed.KilledWorker, lost)
        except (distributed.KilledWorker, distributed.client.FutureCancelledError, OSError) as error:
            raise StudyError(f"the cluster at {cluster.address} was lost: {_line(error)}") from error


@functools.cache
def _warn_if_open(listens_at: str, address: str) -> None:
    """Say once that a scheduler without TLS listens where others reach it."""
    if listens_at.startswith(TLS):
        return
    host = listens_at.partition("://")[2].rpartition(":")[0].strip("[]")
    try:
        if ipaddress.ip_address(host).is_loopback:
            return
    except ValueError:
        if host == "localhost" or listens_at.startswith("inproc"):
            return
    print(
        f"fdi: warning: the scheduler at {address} listens at {listens_at} without TLS: whoever reaches it can run code"
        " on its workers and on this machine; see docs/fleet.md, A cluster that others reach",
        file=sys.stderr,
    )


def _results(
    run: Callable[[Iterable[int]], Iterator[tuple[int, Any]]], count: int, killed: type[Any], lost: Lost | None
) -> Iterator[tuple[int, Any]]:
    """Results of jobs that `run` gives as futures; those whose error is `killed` are run again."""

    def error_of(future: Any) -> Any:
        """Error of a job that is not to end the run, or None."""
        error = None if lost is None or future.status != "error" else future.exception()
        return error if isinstance(error, killed) else None

    suspects = []
    for k, future in run(range(count)):
        if error_of(future):
            suspects.append(k)
        else:
            yield k, future.result()
    for number in suspects:
        # Dask blames every job that a dead worker had, begun or not. The cause is the one that kills it alone, too.
        for k, future in run([number]):
            error = error_of(future)
            yield k, lost(k, died_words(error.allowed_failures + 1)) if lost and error else future.result()


@contextmanager
def _connected(distributed: Any, cluster: Cluster) -> Iterator[Any]:
    import logging

    # A scheduler that is not there, or is lost, is reported in one line of ours, not in pages of retries.
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in names}
    for logger in levels:
        logger.setLevel(logging.CRITICAL)
    try:
        try:
            security = _security(distributed, cluster)
            client = distributed.Client(
                cluster.address, timeout=CONNECT_TIMEOUT, set_as_default=False, security=security
            )
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            raise StudyError(f"no Dask scheduler at {cluster.address}: {_line(error)}") from error
        with client:
            yield client
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _security(distributed: Any, cluster: Cluster) -> Any:
    """Return what proves who is who; None: there is no TLS."""
    if not cluster.address.startswith(TLS):
        return None
    files = {
        "tls_ca_file": cluster.ca_file,
        "tls_client_cert": cluster.certificate,
        "tls_client_key": cluster.key,
    }
    given = {name: str(path) for name, path in files.items() if path is not None}
    return distributed.Security(require_encryption=True, **given)


def died_words(times: int) -> str:
    """Say that a job was given up."""
    return f"the worker process that ran it died {times} times (out of memory, or a crash in native code)"


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
