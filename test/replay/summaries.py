# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Summaries of replays for the tests."""

from fdi_ros.replay.summary import BiasResult, MonitorResult, ProtectionLevel, SampleRate, StreamResult, Summary


def summary_of(scores, bag="bag"):
    """The summary of a replay of which nothing but the scores matters."""
    levels = ProtectionLevel((None,) * 3, (None,) * 3)
    monitor = MonitorResult((), (), (), BiasResult("fixed", ()), "", levels, 1.0)
    stream = StreamResult(SampleRate(100.0, 100.0), None, 0, {}, 0, {}, ())
    return Summary("sequential", scores, monitor, bag=bag, stream=stream, seconds=1.0)
