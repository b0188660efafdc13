# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the pipeline gives for a block of samples: figures of each sample, changes of state as events, messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.messages import (
    FROM_TRIANGLE,
    ChannelsTemplate,
    ImuTemplate,
    fill_force,
    fill_half,
    fill_imu,
    fill_integrity,
    integrity_labels,
)
from fdi_ros.core.states import REASONS, ChannelState, Reason
from fdi_ros.core.subsets import members
from fdi_ros.model.quantity import FORCE, RATE
from fdi_ros.model.samples import Array
from fdi_ros.system import require
from fdi_ros.system.text import date_of, figures, html_table, percent

if TYPE_CHECKING:
    import pandas


__all__ = ["ChannelState", "Event", "Output", "Reason"]

_FLAG = np.dtype(np.bool_)


def time_index(stamp: Sequence[int] | NDArray[np.int64]) -> pandas.Index:
    """Return stamps, ns, as an index ``time`` of pandas: UTC, or the time since the start where they are no dates."""
    import pandas

    ns = np.asarray(stamp, dtype=np.int64)
    if len(ns) and date_of(int(ns[0])) is None:
        return pandas.TimedeltaIndex(ns.astype("m8[ns]"), name="time")
    return pandas.DatetimeIndex(ns.astype("M8[ns]"), tz="UTC", name="time")


@dataclass(frozen=True)
class Event:
    """One change of state of one channel."""

    stamp: int  #: Stamp of the sample that brought the change, ns.
    #: Number of the channel, gyros first.
    channel: int
    #: State until then.
    before: ChannelState
    #: State from then on.
    after: ChannelState
    #: Why the state changed.
    reason: Reason
    group: tuple[
        int, ...
    ]  #: AMBIGUOUS: the channels one of which is faulty, otherwise the channel alone.
    error: float  #: Estimated error of the channel, 0 where the reason is neither disagreement nor drift.

    row: int = field(default=0, compare=False)  #: Row of that sample in its output.
    unit: str = RATE.unit  #: Of the error: rad/s of a gyro, m/s^2 of an accelerometer.

    @property
    def declares(self) -> bool:
        """Whether this is a declaration: the channel is faulty, or one of a named set is."""
        return self.after in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)

    def __repr__(self) -> str:
        return f"Event({', '.join(_cells(self, ()))})"


_TABLE_HEAD = ("stamp s", "channel", "change", "why")


def format_reason(event: Event, names: Sequence[str]) -> str:
    """Return why a channel changed its state. Without names channels are numbered."""
    size = f" by {figures(abs(event.error))} {event.unit}" if event.error else ""
    group = ", ".join(names[i] if names else f"channel {i}" for i in event.group)
    return (
        event.reason.value
        + size
        + (f"; one of {group}" if len(event.group) > 1 else "")
    )


def _cells(event: Event, names: Sequence[str]) -> tuple[str, str, str, str]:
    name = names[event.channel] if names else f"channel {event.channel}"
    change = f"{event.before.name} -> {event.after.name}"
    return f"{event.stamp / 1e9:.3f}", name, change, format_reason(event, names)


def events_of(rows: NDArray[Any], gyros: int) -> list[Event]:
    """Return changes of state in order, from their records (E,); channels from ``gyros`` on are accelerometers."""
    return [
        Event(
            stamp=int(row["stamp"]),
            channel=int(row["channel"]),
            before=ChannelState(row["before"]),
            after=ChannelState(row["after"]),
            reason=REASONS[row["reason"]],
            group=members(int(row["group"])),
            error=float(row["error"]),
            unit=RATE.unit if row["channel"] < gyros else FORCE.unit,
            row=int(row["row"]),
        )
        for row in rows
    ]


def of_accelerometers(event: Event, gyros: int) -> Event:
    """Return an event of an accelerometer with the numbers that it has without the gyros."""
    group = tuple(i - gyros for i in event.group)
    return replace(event, channel=event.channel - gyros, group=group)


def _column(name: str, about: str) -> Any:
    """Return a property that is a column of the rows of an output."""
    return property(lambda output: output.rows[name], doc=about)


class Output:
    """Results for N consecutive samples of n channels.

    Parameters
    ----------
    rows
        (N,) records of `fdi_ros.core.records.OutputRow`.
    n
        Number of gyros.
    events
        Changes of state within these samples, in order: of the accelerometers too, with numbers from n on.
    channel_names
        Of the gyros, then of the accelerometers, by default g1, g2, ...
    acceleration
        The same of the accelerometers, None without any: its figures are in m/s^2 where they are rad/s here, its
        channels are numbered from 0.

    Properties build their arrays on demand: for single samples ten views would cost more than judging.
    """

    stamp: NDArray[np.int64] = _column("stamp", "(N,) ns.")
    instant: NDArray[np.int64] = _column(
        "instant",
        "(N,) instants that the fused rate is of, ns: before the stamps, where units are known to be late.",
    )
    rate: Array = _column(
        "rate",
        "(N, 3) fused body rate, rad/s; NaN where there is none: never to be published.",
    )
    statistic: Array = _column(
        "statistic", "(N,) the detector's; NaN where the sample could not be judged."
    )
    threshold: Array = _column(
        "threshold", "(N,) the detector's; NaN where the sample could not be judged."
    )
    level: Array = _column(
        "level",
        "(N, 3) protection level of the fused rate, rad/s; inf where there is none.",
    )

    def __init__(
        self,
        rows: NDArray[Any],
        n: int,
        events: Sequence[Event] = (),
        channel_names: Sequence[str] = (),
        acceleration: Output | None = None,
    ) -> None:
        self.rows = rows
        self.n = n
        self.acceleration = acceleration
        self.events = events
        self.channel_names = tuple(channel_names) or tuple(
            f"g{i + 1}" for i in range(n)
        )

    @property
    def halves(self) -> tuple[Output, ...]:
        """Gyros alone, and accelerometers if there are any: each with its own channels and events."""
        if self.acceleration is None:
            return (self,)
        own = [event for event in self.events if event.channel < self.n]
        gyros = Output(self.rows, self.n, own, self.channel_names[: self.n])
        return (gyros, self.acceleration)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) whether the sample has a fused rate."""
        return self.rows["valid"].view(_FLAG)

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """(N,) the detector's, before confirmation."""
        return self.rows["alarm"].view(_FLAG)

    @property
    def state(self) -> NDArray[np.uint8]:
        """(N, n) ChannelState of each channel after the sample; accelerometers stand behind the gyros."""
        own = np.asarray(self.rows["state"][:, : self.n])
        return (
            own
            if self.acceleration is None
            else np.hstack([own, self.acceleration.state])
        )

    @property
    def residual(self) -> Array:
        """(N, n) bias-free channel minus fused rate along its axis, rad/s, NaN where either is missing.

        Accelerometers stand behind the gyros, minus the fused specific force, m/s^2.
        """
        own = np.asarray(self.rows["residual"][:, : self.n])
        return (
            own
            if self.acceleration is None
            else np.hstack([own, self.acceleration.residual])
        )

    @property
    def covariance(self) -> Array:
        """(N, 3, 3) of the fused rate, (rad/s)^2, NaN where the sample has none."""
        return np.asarray(self.rows["covariance"][:, FROM_TRIANGLE].reshape(-1, 3, 3))

    def __repr__(self) -> str:
        seconds = 0.0
        rated = ""
        if len(self):
            seconds = (int(self.stamp[-1]) - int(self.stamp[0])) / 1e9
            share = float(np.mean(self.valid))
            rated = f", a rate in {percent(share)}"
        size = f"{len(self)} samples of {len(self.channel_names)} channels, {seconds:.3f} s"
        return f"Output({size}{rated}; {len(self.events)} changes of state)"

    def _repr_html_(self) -> str:
        return html_table(
            repr(self),
            _TABLE_HEAD,
            (_cells(event, self.channel_names) for event in self.events),
        )

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row a sample. Needs pandas.

        Columns as in the file that ``fdi replay --csv`` writes, with the same units: fused rate and its standard
        deviation, statistic, threshold, alarm, the protection level (``level_x``, rad/s), and of each channel
        ``NAME.residual`` (rad/s) and ``NAME.state``. The index is the time, as of `time_index`.

        Raises
        ------
        FdiError
            If pandas is not installed.
        """
        require("Output.to_pandas", ("pandas",))
        import pandas

        std = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        vectors = {"rate": self.rate, "std": std, "level": self.level}
        columns: dict[str, Any] = {
            f"{name}_{axis}": values[:, k]
            for name, values in vectors.items()
            for k, axis in enumerate("xyz")
        }
        columns |= {
            "statistic": self.statistic,
            "threshold": self.threshold,
            "alarm": self.alarm,
        }
        names = [state.name for state in ChannelState]
        for i, channel in enumerate(self.channel_names):
            columns[f"{channel}.residual"] = self.residual[:, i]
            columns[f"{channel}.state"] = pandas.Categorical.from_codes(
                self.state[:, i], names
            )
        return pandas.DataFrame(columns, index=time_index(self.stamp))

    def __len__(self) -> int:
        return len(self.rows)


Template = ImuTemplate | ChannelsTemplate


class Topic(NamedTuple):
    """One topic that a monitor publishes."""

    #: name before remapping
    name: str
    #: of its messages: ``sensor_msgs/msg/Imu``
    type: str


class Rows(NamedTuple):
    """What one sample gave: records of `fdi_ros.core.records.OutputRow`."""

    #: record of the gyros
    gyros: Any
    #: record of the accelerometers. None: there are none
    accelerometers: Any = None
    #: unit of the accelerometers' figures, m/s^2
    natural: float = FORCE.natural


@dataclass(frozen=True, eq=False)
class SampleOutput:
    """A message about each sample, on a topic of its own."""

    #: on which the messages are published
    topic: Topic
    make: Callable[[str, Sequence[str], int], Template]
    """Returns a message to be filled, from the frame_id of the rate, the names of all channels, and the number of
    gyros, which come first."""
    fill: Callable[[Template, Rows, int, int, int], None]
    """Fills the message from rows, the numbers of gyros and accelerometers, and the shift in ns to subtract from its
    stamp."""
    #: whether only samples with a fused rate are published
    needs_rate: bool = False
    #: whether the node skips the output without subscribers
    on_demand: bool = False


def _fill_fused(out: Template, rows: Rows, n: int, m: int, shift: int) -> None:
    row = rows.gyros
    other = rows.accelerometers
    instant = int(row["instant"]) - shift
    fill_imu(out.bytes, out.at, instant, row["rate"], row["covariance"])
    if m and other["valid"]:
        fill_force(out.bytes, out.at, rows.natural, other["rate"], other["covariance"])


def _make_integrity(frame_id: str, names: Sequence[str], n: int) -> Template:
    labels = integrity_labels(names, n)
    return ChannelsTemplate(len(labels), labels)


def _fill_integrity(out: Template, rows: Rows, n: int, m: int, shift: int) -> None:
    fill_integrity(out.bytes, out.at, rows.gyros, n, shift)
    if m:
        behind = out.at + 8 * (n + 7)
        fill_half(out.bytes, behind, rows.accelerometers, m, rows.natural)


FUSED = SampleOutput(
    Topic("fused", "sensor_msgs/msg/Imu"),
    lambda frame_id, names, n: ImuTemplate(frame_id),
    _fill_fused,
    needs_rate=True,
)
INTEGRITY = SampleOutput(
    Topic("~/integrity", "std_msgs/msg/Float64MultiArray"),
    _make_integrity,
    _fill_integrity,
    on_demand=True,
)
OUTPUTS = (FUSED, INTEGRITY)  # of each sample, live and in an output bag


class Encoder:
    """Makes messages of the output of a monitor, from the frame_id of the fused rate and the names of the channels.

    ``gyros``: how many of the channels, the first ones, are gyros.
    """

    def __init__(self, frame_id: str, names: Sequence[str], gyros: int) -> None:
        self.n = gyros
        self.m = len(names) - gyros
        self.templates = {
            output: output.make(frame_id, names, gyros) for output in OUTPUTS
        }

    def fill(self, output: SampleOutput, rows: Rows, shift: int = 0) -> None:
        """Write the message about one sample in place."""
        output.fill(self.templates[output], rows, self.n, self.m, shift)

    def encode(
        self, results: Output, shift: int = 0
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Encode the messages about samples: topic, stamp of the sample, ns, and bytes, stamped less the shift."""
        others = results.acceleration
        for k, row in enumerate(results.rows):
            rows = Rows(row, None if others is None else others.rows[k], 1.0)
            for output, template in self.templates.items():
                if row["valid"] or not output.needs_rate:
                    self.fill(output, rows, shift)
                    yield output.topic, int(row["stamp"]), template.bytes.tobytes()
