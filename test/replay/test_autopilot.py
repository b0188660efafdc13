# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What an autopilot says of itself stands beside what the monitor declares, whatever log it is in."""

import json
import struct

import pytest
from bag import logs

from fdi_ros.bag.reader import Recording


def dataflash(path):
    """Three IMUs from 10 s on; a switch of the lane at 12 s, an error that is over at 13 s, words at 11 s."""
    extra = logs.format_record(5, "ERR", "QBB", "TimeUS,Subsys,ECode")
    for second, subsystem, code in ((12, 24, 1), (13, 16, 0)):
        extra += logs.HEAD + struct.pack("<BQBB", 5, second * 1_000_000, subsystem, code)
    extra += logs.HEAD + struct.pack("<BQ64s", 66, 11_000_000, b"EKF3 IMU0 is using GPS\r\n")
    return logs.write_dataflash(path, logs.units(3, seconds=6.0, start=10.0), extra=extra)


def test_errors_and_words_of_a_log_are_told_at_their_times(tmp_path, fdi):
    log, config, page = dataflash(tmp_path / "log.bin"), tmp_path / "config.yaml", tmp_path / "page.html"
    fdi("inspect", log, "--output", config, "--quiet")
    told = json.loads(fdi("replay", log, "--config", config, "--json", "-", "--report", page, "--quiet").out)
    assert [(round(one["at_s"], 2), one["kind"], one["text"]) for one in told["autopilot"]] == [
        (1.0, "MSG", "EKF3 IMU0 is using GPS"),
        (2.0, "ERR", "EKF lane switched to 1"),
        (3.0, "ERR", "EKF check: resolved"),
    ]
    assert page.read_text().count("autopilot at 2.000 s: EKF lane switched to 1") == 2


def test_messages_that_px4_logs_are_told(tmp_path):
    message = logs.ulog_message(b"L", struct.pack("<cQ", b"4", 12_000_000) + b"EKF2 0 lost")
    log = logs.write_ulog(tmp_path / "log.ulg", logs.units(2, seconds=4.0, start=10.0), gps=False)
    log.write_bytes(log.read_bytes() + message)
    with Recording(log) as recording:
        (one,) = recording.texts
    assert (one.stamp, one.kind, one.text) == (12_000_000_000, "WARNING", "EKF2 0 lost")


def test_status_texts_of_a_telemetry_log_are_told(root):
    log = root.parent / "shared" / "data" / "sitl" / "biases.tlog"
    if not log.exists():
        pytest.skip("the shared recordings are not there")
    with Recording(log) as recording:
        texts = [one.text for one in recording.texts]
    assert {"AHRS: EKF3 active", "EKF3 IMU1 is using GPS"} <= set(texts)
