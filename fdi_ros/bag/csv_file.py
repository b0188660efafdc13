# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of text (.csv, .tsv): a line of column names, then a line per sample.

Names give the columns of time and of the rates about x, y and z of each IMU, with
units: ``time_us``, ``gyro_1_x [deg/s]``, ``imu_0.x``. Names such as ``accel_1_x [g]``
give the specific force of the same IMUs, if each has one. A file ``columns.yaml`` in
the same folder replaces names that are not clear. All its entries are optional:

    time: t
    time_unit: ms                   # s, ms, us or ns
    rate_unit: deg/s                # rad/s or deg/s
    imus: [[wx1, wy1, wz1], [wx2, wy2, wz2]]
    acceleration_unit: g            # m/s^2 or g
    accelerations: [[ax1, ay1, az1], [ax2, ay2, az2]]

An IMU keeps the number in its names: ``gyro_1_x`` is on ``/imu_1``. Without numbers, IMUs
are counted from 0. Axes are not turned. An IMU without a value in a line has no message there. Times are
doubles, so dates are exact to 0.3 us. Files are read in portions of bounded memory.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

import numpy as np

from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.bag.flight_log import (
    SETTINGS,
    FlightLog,
    ImuSamples,
    Portion,
    Source,
    Track,
    imu_samples,
)
from fdi_ros.bag.raw import MOST_SHOWN, Damage
from fdi_ros.errors import BagError
from fdi_ros.model.quantity import STANDARD_GRAVITY
from fdi_ros.model.samples import Array, Int
from fdi_ros.system.files import RECORDING, TABLE, TIMES, open_regular
from fdi_ros.system.text import own_numbers, shown
from fdi_ros.system.yaml_file import read_yaml

COLUMNS = "columns.yaml"
GUIDE = 'docs/flight_logs.md, "Tables of text"'
KIND = "columns"
#: IMUs have up to three digits
MOST_IMUS = 1000
#: bytes that are read at once
_READ_BYTES = 1 << 21
_TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_DEGREES = math.pi / 180.0
_RATE_UNITS = {
    "rad/s": 1.0,
    "rad_s": 1.0,
    "radps": 1.0,
    "deg/s": _DEGREES,
    "deg_s": _DEGREES,
    "dps": _DEGREES,
}
_FORCE_UNITS = {
    "m/s^2": 1.0,
    "m/s2": 1.0,
    "m/s²": 1.0,
    "m_s2": 1.0,
    "mps2": 1.0,
    "g": STANDARD_GRAVITY,
    "mg": 1e-3 * STANDARD_GRAVITY,
}
_UNIT = re.compile(
    r"[\[(]([^\d\[(\])][^\[(\])]*)[\])]$|_(rad_s|radps|deg_s|dps|m_s2|mps2|m?g)$|(?<=[a-z])_?(ns|us|ms)$|_(s|sec)$"
)
_TIME_NAME = re.compile(
    r"\W*_*(?:field\.)?(?:header\.)?(?:t|time|time_?stamp|stamp|timestamp_sample|secs?|seconds)"
)
_AXIS = re.compile(r"(?:([xyz])|\[([012])\])[._ ]*(\d*)$")
_GYRO = re.compile(r"gyr|omega|angular_?vel|(^|[._ \d])[gw]\d*$")
_ACCELEROMETER = re.compile(r"acc|specific_?force|(^|[._ \d])[af]\d*$")
_OTHER = re.compile(
    r"acc|mag|delta|cov|quat|ori|pos|att|force|vel|temp|(^|[._ \d])[abmq]\d*$"
)
"""Names without their axis: of rates, of accelerations, of anything but rates."""
_ENTRIES = {
    "time",
    "time_unit",
    "rate_unit",
    "imus",
    "acceleration_unit",
    "accelerations",
}


class Note(Protocol):
    """Takes notes on the choice of columns."""

    def __call__(self, line: str, names: str = "", why: str = "") -> None:
        """Note a line, and the names of columns of a gyro that are left out, and why."""


class Columns(NamedTuple):
    """Which columns of a table are read."""

    #: names of all columns
    names: tuple[str, ...]
    #: index of the column
    time: int
    #: seconds of one unit of time, 0 if the first time decides
    tick: float
    #: number of each IMU
    numbers: tuple[int, ...]
    #: indices of the rates about x, y and z of each
    imus: tuple[tuple[int, int, int], ...]
    #: rates of each IMU are multiplied by this for rad/s
    factors: tuple[float, ...]
    #: indices of the accelerations along x, y and z of each, empty without any
    accelerations: tuple[tuple[int, int, int], ...] = ()
    #: accelerations of each IMU are multiplied by this for m/s^2
    force_factors: tuple[float, ...] = ()
    #: names of the IMUs in the table, empty if these hold the numbers
    labels: tuple[str, ...] = ()


class CsvLog(FlightLog):
    """An open table, read in portions."""

    magic = b""
    refusal = "is no table of text (.csv, .tsv)"
    kinds = (KIND,)
    settings = (
        f"does the name of the time have its unit (time_ms), or {COLUMNS} a time_unit,"
        " and do times differ from line to line?"
    )
    one_imu = "one IMU cannot be checked: this table has no other ({})"
    slowest = 5.0
    #: number of its only IMU, None for the numbers in the names of the columns
    number: int | None = None
    #: name of the column of times, and a time that is no number, empty for none
    _untimed: tuple[str, str] = ("", "")

    def find_context(self) -> FlightContext:
        """Return the names of the IMUs in the table, where these are not numbers."""
        _, columns = find_columns(self.file, lambda *_: None, self.number)
        labels = dict(zip(columns.numbers, self._labels(columns), strict=False))
        return FlightContext(
            {
                self._topic(source): labels[source.instance]
                for source in self._sources
                if source.instance in labels
            }
        )

    def _labels(self, columns: Columns) -> tuple[str, ...]:
        return columns.labels

    def _note_columns(self, line: str, names: str = "", why: str = "") -> None:
        """Note how columns were chosen, and those of a gyro that are left out."""
        if names:
            self.note(line)
            self.leave_out(names, why)
        else:
            self.state(line)

    def _refusal(self, sensors: Mapping[Source, Track]) -> str:
        """Describe why the lines of the table hold no samples."""
        lines = self.counts["lines"]
        if any(track.count for track in sensors.values()):
            return super()._refusal(sensors)
        if not lines:
            return " has names of columns, and no line of numbers below them"
        name, cell = self._untimed
        if name:
            what = f"{shown(cell, 32)!r} in its column {shown(name, 32)!r}"
            return (
                f" has no line whose time is a number: it has {what}. What to do: write times in s, or"
                f" in another unit that the name states, such as time_ms ({SETTINGS})"
            )
        return f" has {lines} lines of numbers, and no times that increase. What to do: {self.settings} ({SETTINGS})"

    def portions(self) -> Iterator[Portion]:
        """Read the table from its start up to `end`."""
        delimiter, columns = find_columns(self.file, self._note_columns, self.number)
        offset = self.file.tell()
        bad = 0
        rest = b""
        while rest or offset < self.end:
            data = rest + self.file.read(
                max(0, min(_READ_BYTES, self.end - offset - len(rest)))
            )
            final = offset + len(data) >= self.end
            size = data.rfind(b"\n") + 1
            if not size and not final:
                raise BagError(
                    f"{self.file.name} has a line of more than {len(data)} bytes at byte {offset}"
                )
            if final and size < len(data):
                self.note("the last line is not finished and was left out")
            lines = data[:size].split(b"\n")[:-1]
            lengths = [len(one) + 1 for one in lines]
            ends = offset + np.cumsum(lengths, dtype=np.int64)
            used = [
                k
                for k, one in enumerate(lines)
                if one.strip() and not one.startswith(b"#")
            ]
            table = _numbers(
                [lines[k].decode("utf-8", "replace") for k in used], columns, delimiter
            )
            good = np.isfinite(table[:, 0])
            bad += int((~good).sum())
            if not good.all() and not self._untimed[0]:
                line = lines[used[int(np.argmin(good))]].decode("utf-8", "replace")
                cells = [*line.split(delimiter), *[""] * len(columns.names)]
                self._untimed = columns.names[columns.time], cells[columns.time].strip()
            # Numbers of a damaged table may be anything.
            with np.errstate(all="ignore"):
                if not columns.tick and good.any():
                    # Dates by their size, else seconds.
                    first = table[good, 0][0]
                    tick = next(
                        (
                            tick
                            for tick in (1e-9, 1e-6, 1e-3)
                            if first * tick * 1e9 >= TIMES.earliest
                        ),
                        1.0,
                    )
                    columns = columns._replace(tick=tick)
                samples = _samples(table[good], ends[used][good], columns)
            self.counts["lines"] += len(used)
            offset = offset + size
            rest = b"" if final else data[size:]
            yield samples, offset / self.end
            if final:
                break
        if bad:
            lines_are = (
                "line without a time was" if bad == 1 else "lines without a time were"
            )
            self.note(f"{bad} {lines_are} left out")


class CsvUnit(CsvLog):
    """An open table of one IMU, whose others are in other tables of the same folder."""

    fewest_imus = 1

    def __init__(self, path: Path, damage: Damage, most: int, number: int) -> None:
        self.number = number
        super().__init__(path, damage, most)
        if len(self.topics) > 1:
            self.close()
            raise BagError(
                f"{path} holds {len(self.topics)} IMUs, so it is a recording of its own:"
                " name the file, or run fdi fleet on the folder"
            )

    def _labels(self, columns: Columns) -> tuple[str, ...]:
        numbers = [int(one) for one in re.findall(r"[0-9]{1,9}", self.path.stem)]
        is_numbered = self.number in numbers
        return () if is_numbered else (self.path.name,)


def unit_numbers(paths: Sequence[Path]) -> list[int]:
    """Return a number for the IMU of each table: the last in each name, if all differ."""
    found = [re.findall(r"[0-9]{1,3}", path.stem)[-1:] for path in paths]
    numbers = [int(one[0]) for one in found if one]
    all_differ = len(set(numbers)) == len(paths)
    return numbers if all_differ else list(range(len(paths)))


def find_columns(
    file: BinaryIO, note: Note, number: int | None = None
) -> tuple[str, Columns]:
    """Return the delimiter and the columns to read, and move the file behind the names.

    ``number``: of the first IMU, None for the numbers in the names. `BagError` if no
    line holds names, or no name is of a gyro.
    """
    file.seek(0)
    if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        raise BagError(f"{file.name} is UTF-16: save it as UTF-8")
    file.seek(0)
    for _ in range(64):
        line = file.readline(TABLE.line_bytes).decode("utf-8", "replace")
        separators = sum(map(line.count, ",;\t"))
        if separators >= 3 and len(line) < TABLE.line_bytes:
            break
    else:
        raise BagError(
            f"{file.name} has no line with four or more names of columns, between commas, semicolons or tabs"
        )
    delimiter = max("\t;,", key=line.count)
    names = [
        name.strip().strip('"')
        for name in line.lstrip("\ufeff# ").strip().split(delimiter)
    ]
    if len(names) > TABLE.columns:
        raise BagError(
            f"{file.name} has {len(names)} columns, expected at most {TABLE.columns}"
        )
    if (longest := max(map(len, names))) > RECORDING.name_length:
        raise BagError(
            f"{file.name} has a column name of {longest} characters, expected at most"
            f" {RECORDING.name_length}"
        )
    numbers = [_number(names, k) for k in range(len(names))]
    if np.isfinite(numbers).all():
        raise BagError(
            f"{file.name} has no names of columns: its first line holds numbers. Put a line of names before"
            f" it, such as time,gyro1_x,gyro1_y,gyro1_z,gyro2_x,...: {GUIDE}"
        )
    return delimiter, _columns(file, names, note, number)


class _Choice(NamedTuple):
    """Columns of a table by name, before their units."""

    #: entries of ``columns.yaml``, empty without the file
    given: dict[str, Any]
    #: name of the column of times
    time: str
    #: rates about x, y and z of each IMU
    imus: list[list[str]]
    #: accelerations along x, y and z of each IMU, empty without any
    forces: list[list[str]]

    def factors(
        self, entry: str, triads: list[list[str]], units: dict[str, float]
    ) -> list[float]:
        """Return the factor of each IMU: by an entry of ``columns.yaml``, else by its first name."""
        return [
            _factor(str(self.given.get(entry, _split(x)[1])), units, 1.0, x)
            for x, _, _ in triads
        ]


def _columns(
    file: BinaryIO, names: Sequence[str], note: Note, number: int | None
) -> Columns:
    """Choose the columns and note the choice.

    `BagError` if no gyro is found, or ``columns.yaml`` names other columns.
    """
    choice = _chosen_names(file, names, note)
    time_unit = str(choice.given.get("time_unit", _split(choice.time)[1]))
    first = number or 0
    heads = [_of_imu(x) for x, _, _ in choice.imus]
    numbers = own_numbers(heads)
    if number is not None or max(numbers, default=MOST_IMUS) >= MOST_IMUS:
        numbers = list(range(first, first + len(choice.imus)))
    columns = Columns(
        tuple(names),
        names.index(choice.time),
        _factor(time_unit, _TIME_UNITS, 0.0, choice.time),
        tuple(numbers),
        _places(names, choice.imus),
        tuple(choice.factors("rate_unit", choice.imus, _RATE_UNITS)),
        _places(names, choice.forces),
        tuple(choice.factors("acceleration_unit", choice.forces, _FORCE_UNITS)),
        () if own_numbers(heads) == numbers else tuple(heads),
    )
    _note_choice(choice, columns, note)
    return columns


def _chosen_names(file: BinaryIO, names: Sequence[str], note: Note) -> _Choice:
    """Choose columns by ``columns.yaml`` in the folder of a table, else by their names."""
    path = Path(file.name).parent / COLUMNS
    given = read_yaml(path, "file", BagError) if path.exists() else {}
    if not isinstance(given, dict) or set(given) - _ENTRIES:
        raise BagError(f"{path}: expected {', '.join(sorted(_ENTRIES))}")
    imus = given["imus"] if "imus" in given else _imus(names, note)
    forces = (
        given["accelerations"] if "accelerations" in given else _forces(names, imus)
    )
    for entry, triads in (("imus", imus), ("accelerations", forces)):
        if not isinstance(triads, list) or any(
            not isinstance(triad, list) or len(triad) != 3 for triad in triads
        ):
            raise BagError(f"{path}: {entry} is a list of three columns for each IMU")
    if forces and len(forces) != len(imus):
        raise BagError(
            f"{path}: accelerations names {len(forces)} IMUs, imus names {len(imus)}"
        )
    by_name = (name for name in names if _TIME_NAME.fullmatch(_split(name)[0]))
    time: Any = given.get("time", next(by_name, None))
    listed = shown(", ".join(names), MOST_SHOWN)
    count = Counter(names)
    both = (*imus, *forces)
    for name in (time, *itertools.chain.from_iterable(both)):
        if name not in names:
            missing = "no column of times" if name is None else f"no column {name!r}"
            raise BagError(
                f"{file.name} has {missing}, it has {listed}; {COLUMNS} says which: {GUIDE}"
            )
        if count[name] > 1:
            raise BagError(
                f"{file.name} has {count[name]} columns {name!r}: give each a name of its own"
            )
    if not imus:
        raise BagError(
            f"{file.name} has no columns of gyros among {listed}; {COLUMNS} says which: {GUIDE}"
        )
    return _Choice(given, time, imus, forces)


def _places(
    names: Sequence[str], triads: list[list[str]]
) -> tuple[tuple[int, int, int], ...]:
    """Return the indices of the columns of each IMU."""
    place = names.index
    return tuple((place(x), place(y), place(z)) for x, y, z in triads)


def _note_choice(choice: _Choice, columns: Columns, note: Note) -> None:
    """Note which columns are read, and in which units."""
    source = COLUMNS if "imus" in choice.given else "their names"
    imus = "; ".join(
        f"/imu_{number} = {', '.join(imu)}"
        for number, imu in zip(columns.numbers, choice.imus, strict=True)
    )
    unit = ""
    if _DEGREES in columns.factors:
        unit = " in deg/s"
    elif "rate_unit" not in choice.given and not all(
        _split(x)[1] for x, _, _ in choice.imus
    ):
        unit = "; no unit in the names: rad/s assumed"
    note(f"columns, by {source}: time = {choice.time}; {imus}{unit}")
    if choice.forces:
        listed = "; ".join(", ".join(force) for force in choice.forces)
        in_unit = "" if set(columns.force_factors) == {1.0} else ", converted to m/s^2"
        note(f"accelerations in the order of the IMUs: {listed}{in_unit}")


def has_gyros(file: BinaryIO) -> bool:
    """Whether a table has columns of gyros."""
    try:
        find_columns(file, lambda *_: None)
    except BagError:
        return False
    return True


def is_table_of_gyros(path: Path) -> bool:
    """Whether a file is a table with columns of gyros."""
    try:
        with open_regular(path) as file:
            return has_gyros(file)
    except OSError:
        return False


def _split(name: str) -> tuple[str, str]:
    """Return a name in small letters and its unit, which may be empty."""
    name = name.lower()
    unit = _UNIT.search(name)
    return (
        (name[: unit.start()].rstrip(" _"), next(filter(None, unit.groups())).strip())
        if unit
        else (name, "")
    )


def _factor(unit: str, known: dict[str, float], default: float, name: str) -> float:
    """Return the factor of a unit. `BagError` if the unit is unknown."""
    if unit and unit not in known:
        raise BagError(
            f"column {name!r} has the unit {unit!r}, expected one of {', '.join(known)}"
        )
    return known.get(unit, default)


class _Place(NamedTuple):
    """What the name of a column says of a vector."""

    #: name without its axis and its number
    head: str
    #: number behind the axis, may be empty
    number: str
    #: x, y or z
    axis: str


def _place_of(name: str) -> _Place | None:
    """Return the place of a column in a vector, None if its name has no axis."""
    plain = _split(name)[0]
    match = _AXIS.search(plain)
    if match is None or _TIME_NAME.fullmatch(plain):
        return None
    axis = match[1] or "xyz"[int(match[2])]
    return _Place(plain[: match.start()].rstrip("._ "), match[3], axis)


def _of_imu(name: str) -> str:
    """Return the name of a column without its axis."""
    place = _place_of(name)
    return name if place is None else f"{place.head}_{place.number}".rstrip("_")


def _triads(names: Sequence[str]) -> dict[tuple[str, str], dict[str, str]]:
    """Return the columns of each vector by axis, keyed by the name without its axis and its number."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        if place := _place_of(name):
            axes = groups.setdefault((place.head, place.number), {})
            axes.setdefault(place.axis, name)
    return groups


def _repeated(names: Sequence[str]) -> list[str]:
    """Return the columns of gyros whose place in a vector a column before has, in another unit."""
    taken = set()
    found = []
    for name in names:
        place = _place_of(name)
        if place and _is_gyro(place.head):
            if place in taken:
                found.append(name)
            taken.add(place)
    return found


def _imus(names: Sequence[str], note: Note) -> list[list[str]]:
    """Return the columns x, y, z of each gyro, by names of gyros, or else by any names.

    A gyro that lacks an axis is noted and left out, and so is one that is there before
    in another unit.
    """
    if repeated := _repeated(names):
        found = ", ".join(repeated)
        verb = "is" if len(repeated) == 1 else "are"
        why = "a column before has the same name but for its unit"
        note(f"{found} {verb} left out: {why}", f"the gyro of {found}", why)
    groups = _triads(names)
    whole = {
        key: [axes[axis] for axis in "xyz"]
        for key, axes in groups.items()
        if len(axes) == 3
    }
    for key, axes in groups.items():
        if key not in whole and _is_gyro(key[0]):
            found = " and ".join(axes.values())
            why = f"no column for {' and '.join(sorted(set('xyz') - set(axes)))}"
            verb = "is" if len(axes) == 1 else "are"
            note(f"{found} {verb} left out: {why}", f"the gyro of {found}", why)
    gyros = [axes for (head, _), axes in whole.items() if _is_gyro(head)]
    return gyros or [
        axes for (head, _), axes in whole.items() if not _OTHER.search(head)
    ]


def _forces(names: Sequence[str], imus: Any) -> list[list[str]]:
    """Return the columns x, y, z of the accelerometer of each IMU, in the order of the names.

    None, unless there is one for each IMU: nothing tells which IMU lacks one. Nor
    is one taken whose unit is unknown: its rates are of use without it.
    """
    found = [
        [axes[axis] for axis in "xyz"]
        for (head, _), axes in _triads(names).items()
        if len(axes) == 3
        and _ACCELEROMETER.search(head)
        and not _GYRO.search(head)
        and "cov" not in head
    ]
    known = all(
        _split(name)[1] in ("", *_FORCE_UNITS) for axes in found for name in axes
    )
    is_whole = isinstance(imus, list) and len(found) == len(imus)
    return found if is_whole and known else []


def _is_gyro(head: str) -> bool:
    """Whether a name without its axis names a gyro."""
    return _GYRO.search(head) is not None and "cov" not in head


def _numbers(lines: Sequence[str], columns: Columns, delimiter: str) -> Array:
    """Return time, rates and accelerations of each line; cells without a number are NaN.

    (k, 1 + 3 IMUs), or (k, 1 + 6 IMUs) with accelerations.
    """
    triads = (*columns.imus, *columns.accelerations)
    chosen = [columns.time, *(column for triad in triads for column in triad)]
    if not lines:
        return np.empty((0, len(chosen)))
    if delimiter == ";":
        lines = [line.replace(",", ".") for line in lines]
    with contextlib.suppress(ValueError):
        table = np.loadtxt(
            lines,
            delimiter=delimiter,
            usecols=chosen,
            comments=None,
            quotechar='"',
            ndmin=2,
        )
        if len(table) == len(lines):
            return table
    rows = []
    for line in lines:
        cells: list[str] = []
        with contextlib.suppress(csv.Error):
            cells = next(csv.reader([line], delimiter=delimiter), [])
        rows.append([_number(cells, k) for k in chosen])
    return np.array(rows)


def _number(cells: Sequence[str], column: int) -> float:
    try:
        return float(cells[column])
    except (ValueError, IndexError):
        return math.nan


def _samples(
    table: Array, end: Int, columns: Columns
) -> list[tuple[Source, ImuSamples]]:
    """Return the samples of each IMU in lines, as of `_numbers`, that end at bytes (k,)."""
    # Impossible dates are left out later.
    micros = np.clip(table[:, 0] * columns.tick * 1e6, -1.0, 9e18)
    stamp = np.round(micros).astype(np.int64)
    found = []
    behind = 3 * len(columns.imus)
    for k, factor in enumerate(columns.factors):
        at = 1 + 3 * k
        rate = table[:, at : at + 3] * factor
        force = np.full(rate.shape, np.nan)
        if columns.accelerations:
            force = table[:, behind + at : behind + at + 3] * columns.force_factors[k]
        measured = ~np.isnan(rate).all(axis=1)
        samples = imu_samples(stamp, rate, force, end)
        found.append((Source(KIND, columns.numbers[k]), samples[measured]))
    return found
