# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Flight logs for the tests: dataflash, ULog and telemetry logs of given rates, as their programs write them."""

import struct
from dataclasses import dataclass

import numpy as np
from mavlink.autopilots import NS, Autopilot

HEAD = b"\xa3\x95"
FORMATS = {
    "b": "i1",
    "B": "u1",
    "M": "u1",
    "H": "<u2",
    "I": "<u4",
    "E": "<u4",
    "Q": "<u8",
    "f": "<f4",
    "d": "<f8",
}
FORMATS |= (
    dict.fromkeys("hc", "<i2")
    | dict.fromkeys("iLe", "<i4")
    | {"n": "S4", "N": "S16", "Z": "S64"}
)
ULOG_HEAD = b"ULog\x01\x12\x35\x01"
WEEK, MS = 2200, 345_600_000
"""GPS time of the first fix: Thursday, 10 March 2022, 00:00:00 GPS."""
UTC = (315_964_800 + WEEK * 604_800 + MS // 1000 - 18) * 10**9
"""The same as UTC, ns since 1970."""
FIX = 5_000_000
"""The first fix comes so long after the start of the autopilot, us."""

GRAVITY = np.array([0.0, 0.0, -9.81])
"""What accelerometers at rest measure, m/s^2."""


@dataclass
class Unit:
    """What one IMU measured, in the body frame of a flight stack: x to the front, y to the right, z down."""

    stamp: np.ndarray
    """(K,) us since the start of the autopilot."""
    rate: np.ndarray
    """(K, 3) rad/s."""
    acceleration: np.ndarray
    """(K, 3) m/s^2."""
    temperature: np.ndarray | None = None
    """(K,) degC. 0, as without one given: no thermometer."""

    def __post_init__(self):
        if self.temperature is None:
            self.temperature = np.zeros(len(self.stamp))


def units(count=3, seconds=20.0, rate=100.0, seed=0, start=10.0, apart=0):
    """IMUs in gentle motion after 4 s at rest; each takes its samples `apart` us after the one before."""
    random = np.random.default_rng(seed)
    made = []
    for k in range(count):
        time = np.arange(round(seconds * rate)) / rate + 1e-6 * apart * k
        moving = np.clip(time - 4.0, 0.0, 1.0)[:, None]
        omega = moving * np.column_stack(
            [
                0.5 * np.sin(0.8 * time),
                0.4 * np.cos(1.1 * time),
                0.3 * np.sin(0.5 * time),
            ]
        )
        omega += random.normal(0.0, 0.002, omega.shape)
        force = GRAVITY + random.normal(0.0, 0.05, omega.shape)
        stamp = np.round((start + time) * 1e6).astype(np.int64)
        made.append(Unit(stamp, omega.astype("f4"), force.astype("f4")))
    return made


# Dataflash -----------------------------------------------------------------------------------------------------------


def record_type(form, columns):
    fields = [
        ("head", "S2"),
        ("type", "u1"),
        *zip(columns.split(","), (FORMATS[c] for c in form), strict=True),
    ]
    return np.dtype(fields)


MESSAGES = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (64, "QNff", "TimeUS,Name,Value,Default"),
    "GPS": (
        65,
        "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
    ),
    "MSG": (66, "QZ", "TimeUS,Message"),
    "IMU": (
        70,
        "QBffffffIIfBBHH",
        "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
    ),
    "GYR": (71, "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
}
AXES = "GyrX,GyrY,GyrZ,AccX,AccY,AccZ"
INSTANCES = {
    "IMU2": ("IMU", "QffffffIIfBBHH", f"TimeUS,{AXES},EG,EA,T,GH,AH,GHz,AHz"),
    "IMT": (
        "IMT",
        "Qfffffffff",
        "TimeUS,DelT,DelvT,DelaT,DelAX,DelAY,DelAZ,DelVX,DelVY,DelVZ",
    ),
    "TimeMS": ("IMU", "IffffffIIf", f"TimeMS,{AXES},ErrG,ErrA,Temp"),
    "GYR1": ("GYR", "IIfff", "TimeMS,TimeUS,GyrX,GyrY,GyrZ"),
}
"""Before 4.1 each instance is a message of its own: IMU, IMU2, IMU3; the last two are those before 3.3."""
OLD_GPS = (
    65,
    "BIHBcLLeeEefI",
    "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
)


def records(message, count=1, **logged):
    """Records of a message; of what is logged it takes what it has columns for, and the others are zero."""
    number, form, columns = message
    out = np.zeros(count, dtype=record_type(form, columns))
    for name in {"head", "type", *logged} & {*out.dtype.names}:
        out[name] = {"head": HEAD, "type": number, **logged}[name]
    return out


def format_record(number, name, form, columns):
    size = record_type(form, columns).itemsize
    return records(
        MESSAGES["FMT"],
        Type=number,
        Length=size,
        Name=name,
        Format=form,
        Columns=columns,
    ).tobytes()


def write_dataflash(path, units, kind="IMU", gps=True, extra=b""):
    """A log as ArduPilot writes it; kind IMU or GYR (with instances), or one of `INSTANCES`."""
    old = kind in ("TimeMS", "GYR1")
    messages = {name: MESSAGES[name] for name in ("FMT", "PARM", "GPS", "MSG")} | (
        {"GPS": OLD_GPS} if old else {}
    )
    if kind in INSTANCES:
        name, form, columns = INSTANCES[kind]
        names = [f"{name}{k or 1}" if kind == "GYR1" or k else name for k in (0, 2, 3)]
        sensors = {name: (72 + k, form, columns) for k, name in enumerate(names)}
    else:
        sensors = {kind: MESSAGES[kind]}
    out = [
        format_record(number, name, *rest)
        for name, (number, *rest) in (messages | sensors).items()
    ]
    out.append(
        records(
            messages["PARM"],
            TimeUS=1_000_000,
            Name="LOG_BITMASK",
            Value=180_222,
            Default=176_126,
        ).tobytes()
    )
    out.append(
        records(
            messages["MSG"], TimeUS=1_000_000, Message="ArduCopter V4.5.7"
        ).tobytes()
    )
    out.append(extra)
    samples = np.concatenate(
        [_samples(unit, k, tuple(sensors.values())) for k, unit in enumerate(units)]
    )
    time = "TimeMS" if old else "TimeUS"
    samples = samples[np.argsort(samples[time], kind="stable")]
    cut = np.searchsorted(samples[time], samples[time][0] + (500 if old else 500_000))
    at = FIX + 200_000 * np.arange(5)
    # Before 3.3 a fix has its own time in T, and that of the week in TimeMS.
    week = {
        "TimeMS" if old else "GMS": MS + (at - FIX) // 1000,
        "Week": WEEK,
        "GWk": WEEK,
    }
    fixes = records(messages["GPS"], len(at), Status=3, TimeUS=at, T=at // 1000, **week)
    out += [
        samples[:cut].tobytes(),
        fixes.tobytes() if gps else b"",
        samples[cut:].tobytes(),
    ]
    path.write_bytes(b"".join(out))
    return path


def _samples(unit, k, messages):
    message = messages[k % len(messages)]
    # GYR is written some time after its samples were taken.
    written = unit.stamp + 150 * ("SampleUS" in message[2])
    logged = {
        "I": k,
        "TimeUS": written,
        "SampleUS": unit.stamp,
        # A record that has both times is written after its sample.
        "TimeMS": (unit.stamp + 1500 * ("TimeUS" in message[2])) // 1000,
        "T": unit.temperature,
        "Temp": unit.temperature,
    }
    for a, axis in enumerate("XYZ"):
        logged |= {f"Gyr{axis}": unit.rate[:, a], f"Acc{axis}": unit.acceleration[:, a]}
    if "DelaT" in message[2]:
        logged["DelaT"] = logged["DelvT"] = step = np.float32(
            np.median(np.diff(unit.stamp)) * 1e-6
        )
        for axis in "XYZ":
            logged |= {
                f"DelA{axis}": logged[f"Gyr{axis}"] * step,
                f"DelV{axis}": logged[f"Acc{axis}"] * step,
            }
    return records(message, len(unit.stamp), **logged)


# ULog ----------------------------------------------------------------------------------------------------------------

ULOG_FORMATS = {
    "sensor_gyro": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;"
    "float temperature;uint32_t error_count;uint8_t[3] clip_counter;uint8_t samples;uint8_t[4] _padding0;",
    "sensor_accel": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;"
    "float temperature;uint32_t error_count;uint8_t[3] clip_counter;uint8_t samples;uint8_t[4] _padding0;",
    "vehicle_imu": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t accel_device_id;uint32_t gyro_device_id;"
    "float[3] delta_angle;float[3] delta_velocity;uint32_t delta_angle_dt;uint32_t delta_velocity_dt;"
    "uint8_t delta_angle_clipping;uint8_t delta_velocity_clipping;uint8_t accel_calibration_count;"
    "uint8_t gyro_calibration_count;uint8_t[4] _padding0;",
    "sensor_gyro_fifo": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float dt;float scale;"
    "int16_t[32] x;int16_t[32] y;int16_t[32] z;uint8_t samples;uint8_t[3] _padding0;",
    "vehicle_imu_status": "uint64_t timestamp;uint32_t gyro_device_id;float[3] mean_gyro;"
    "float temperature_gyro;uint32_t gyro_error_count;uint8_t[4] _padding0;",
    "sensor_gps": "uint64_t timestamp;uint64_t timestamp_sample;uint64_t time_utc_usec;uint8_t fix_type;"
    "uint8_t[7] _padding0;",
}
ULOG_TYPES = {
    "uint64_t": "<u8",
    "uint32_t": "<u4",
    "float": "<f4",
    "int16_t": "<i2",
    "uint8_t": "u1",
}
FIFO_SAMPLES = 8
SCALE = np.float32(np.radians(2000.0) / 32768.0)


def ulog_message(kind, content):
    return struct.pack("<H", len(content)) + kind + content


def ulog_type(name):
    """The data message of a topic; what pads its end is not logged."""
    fields = [("size", "<u2"), ("kind", "S1"), ("id", "<u2")]
    for field in ULOG_FORMATS[name].rstrip(";").split(";"):
        kind, _, name_of = field.partition(" ")
        kind, _, count = kind.partition("[")
        if not name_of.startswith("_padding"):
            fields.append(
                (name_of, ULOG_TYPES[kind], (int(count[:-1]),))
                if count
                else (name_of, ULOG_TYPES[kind])
            )
    return np.dtype(fields)


def write_ulog(path, units, kind="sensor_gyro", gps=True, accel=False):
    """A log as PX4 writes it. ``accel``: with accelerometers, 300 us before the gyros."""
    out = [
        ULOG_HEAD,
        struct.pack("<Q", max(0, int(units[0].stamp[0]) - 1000)),
        ulog_message(b"B", bytes(40)),
    ]
    key = b"char[3] sys_name"
    out.append(ulog_message(b"I", bytes([len(key)]) + key + b"PX4"))
    out += [
        ulog_message(b"F", f"{name}:{form}".encode())
        for name, form in ULOG_FORMATS.items()
        if accel or name != "sensor_accel"
    ]
    out.append(
        ulog_message(b"P", b"\x15" + b"int32_t SDLOG_PROFILE" + struct.pack("<i", 1))
    )
    topics = [*((kind, k) for k in range(len(units))), ("sensor_gps", 0)]
    topics += [("sensor_accel", k) for k in range(len(units)) if accel]
    out += [
        ulog_message(b"A", struct.pack("<BH", k, n) + name.encode())
        for n, (name, k) in enumerate(topics)
    ]
    fixes = _data("sensor_gps", len(units), FIX + 200_000 * np.arange(5))
    fixes["time_utc_usec"], fixes["fix_type"] = (
        UTC // 1000 + fixes["timestamp"] - FIX,
        3,
    )
    samples = np.concatenate(
        [_ulog_samples(unit, n, kind) for n, unit in enumerate(units)]
    )
    out += [
        fixes.tobytes() if gps else b"",
        *(
            _raw(unit.acceleration, len(units) + 1 + n, unit.stamp - 300).tobytes()
            for n, unit in enumerate(units)
            if accel
        ),
        samples[np.argsort(samples["timestamp"], kind="stable")].tobytes(),
    ]
    path.write_bytes(b"".join(out))
    return path


def _data(kind, number, stamp, late=0):
    """Data messages of a topic, of values that are zero as yet."""
    out = np.zeros(len(stamp), dtype=ulog_type(kind))
    out["size"], out["kind"], out["id"], out["timestamp"] = (
        out.dtype.itemsize - 3,
        b"D",
        number,
        stamp + late,
    )
    if "timestamp_sample" in out.dtype.names:
        out["timestamp_sample"] = stamp
    return out


def _ulog_samples(unit, number, kind):
    if kind == "sensor_gyro_fifo":
        return _fifo(unit, number)
    if kind == "vehicle_imu_status":
        out = _data(kind, number, unit.stamp)
        out["mean_gyro"], out["temperature_gyro"] = unit.rate, 40.0 + number
        out["gyro_error_count"] = 3 * number
        return out
    out = _data(kind, number, unit.stamp, late=300)
    if kind == "vehicle_imu":
        step = int(np.clip(np.median(np.diff(unit.stamp)), 1, 10**6))
        out["delta_angle"], out["delta_angle_dt"] = (
            unit.rate * np.float32(step * 1e-6),
            step,
        )
        out["delta_velocity"], out["delta_velocity_dt"] = (
            unit.acceleration * np.float32(step * 1e-6),
            step,
        )
        return out
    return _raw(unit.rate, number, unit.stamp)


def _raw(values, number, stamp):
    """Messages of a gyro or an accelerometer."""
    out = _data("sensor_gyro", number, stamp, late=300)
    for a, axis in enumerate("xyz"):
        out[axis] = values[:, a]
    return out


def _fifo(unit, number):
    """Eight samples a message; its time is that of the last of them."""
    full = len(unit.stamp) // FIFO_SAMPLES
    steps = np.clip(
        np.nan_to_num(np.round(unit.rate[: full * FIFO_SAMPLES] / SCALE)), -32768, 32767
    )
    raw = steps.astype("i2").reshape(full, FIFO_SAMPLES, 3)
    out = _data(
        "sensor_gyro_fifo",
        number,
        unit.stamp[: full * FIFO_SAMPLES][FIFO_SAMPLES - 1 :: FIFO_SAMPLES],
        late=300,
    )
    out["dt"], out["scale"], out["samples"] = (
        np.median(np.diff(unit.stamp)),
        SCALE,
        FIFO_SAMPLES,
    )
    for a, axis in enumerate("xyz"):
        out[axis][:, :FIFO_SAMPLES] = raw[..., a]
    return out


# Telemetry log ------------------------------------------------------------------------------------------------------

SCALED = {26: 50.0, 116: 50.0, 129: 50.0}
"""Messages of IMUs and their rates, Hz."""


def telemetry(*autopilots, seconds=6.0, version=2, left_out=()):
    """What a ground station writes down: each message some ms after it was sent.

    Messages with the numbers left out are lost.
    """
    out = b""
    for now in range(0, round(seconds * NS), 1_000_000):
        for autopilot in autopilots:
            for data in autopilot.step(now):
                data = data if version == 2 else as_version_1(autopilot, data)
                number = data[5] if data[0] == 0xFE else data[7] | data[8] << 8
                if number in left_out:
                    continue
                late = 4000 + int(autopilot.random.integers(3000))
                out += struct.pack(">Q", (UTC + now) // 1000 + late) + data
    return out


def as_version_1(autopilot, data):
    (message,) = autopilot.inbound.parse_buffer(data)
    return bytes(message.pack(autopilot.mav, force_mavlink1=True))


def write_tlog(path, seconds=20.0):
    path.write_bytes(telemetry(Autopilot(rates=SCALED), seconds=seconds))
    return path
