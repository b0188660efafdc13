"""The regular part of a recording: rounds in which every triad speaks once, within the skew."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
_NEVER = np.iinfo(np.int64).max
Scalar = TypeVar("Scalar", bound=np.generic)


def by_triad(triad_of: Stamps, values: NDArray[Scalar], triads: int) -> NDArray[Scalar]:
    """Sort messages of whole rounds (R * k,) or (R * k, 3) by triad: (R, k) or (R, k, 3).

    In a round that does not hold every triad once the result is meaningless, but has the shape.
    """
    order = np.argsort(triad_of.reshape(-1, triads), axis=1, kind="stable")
    rounds = values.reshape(-1, triads, *values.shape[1:])
    return rounds[np.arange(len(rounds))[:, None], order]


def count_regular(
    triad_of: Stamps, stamps: Stamps, newest: list[int], last: int, max_skew: int, timeout: int
) -> tuple[int, int]:
    """Count the leading rounds of which `Aligner.push` would form one sample each, of all messages as they are.

    Parameters
    ----------
    triad_of
        (R * k,) whose message, in order of arrival.
    stamps
        (R * k,) ns.
    newest
        (k,) stamp of the last message of each triad before, all used in the sample before.
    last
        Stamp of the sample before.
    max_skew, timeout
        ns.

    Returns
    -------
    The number of rounds, and the triad at whose stamps the samples are.
    """
    k = len(newest)
    complete = (np.sort(triad_of.reshape(-1, k), axis=1) == np.arange(k)).all(axis=1)
    at = np.vstack([np.array(newest, dtype=np.int64), by_triad(triad_of, stamps, k)])
    before, now = at[:-1], at[1:]
    lead = int(np.argmin(np.where(before[0] >= last, now[0], _NEVER)))
    # Who has a sample between its last message and this one does not anchor the next.
    may_anchor = before >= np.concatenate([[last], before[1:, lead]])[:, None]
    anchor = np.argmin(np.where(may_anchor, now, _NEVER), axis=1)
    row = np.arange(len(now))
    stamp, step = now[:, lead], now - before
    apart = np.abs(now - stamp[:, None])
    regular = (
        complete
        & may_anchor[row, anchor]
        & (now[row, anchor] == stamp)
        & (now.min(axis=1) > before.max(axis=1))
        & (apart.max(axis=1) <= max_skew)
        # Nobody is overdue while the round arrives, and no stamp leaves the time base.
        & (now.max(axis=1) - before.min(axis=1) <= timeout)
        & (2 * apart < np.minimum(step, step[row, anchor][:, None])).all(axis=1)
    )
    return (len(regular) if regular.all() else int(np.argmin(regular))), lead
