"""Feeds the pages from a replay."""

from __future__ import annotations

import numpy as np

from fdi_ros.bag.samples import Samples
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.comparison_report import Comparison
from fdi_ros.replay.report import Report
from fdi_ros.replay.run import Sink


class ReportSink(Sink):
    """Collects for a report; the times in it count from the first message.

    Parameters
    ----------
    geometry
        Of the monitor.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.report = Report(geometry)
        self._origin = 0

    def begin(self, samples: Samples) -> None:
        """Note when the recording began."""
        self._origin = samples.origin or 0

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples."""
        self.report.add(np.asarray((output.stamp - self._origin) * 1e-9, dtype=np.float64), output)


class ComparisonSink(Sink):
    """Collects what one detector says, for the page of all.

    Parameters
    ----------
    comparison
        Of all detectors.
    detector
        The one watched here.
    """

    def __init__(self, comparison: Comparison, detector: str) -> None:
        self.comparison, self.detector = comparison, detector
        comparison.names.append(detector)
        self._origin = 0

    def begin(self, samples: Samples) -> None:
        """Note when the recording began."""
        self._origin = samples.origin or 0

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples."""
        self.comparison.add(self.detector, np.asarray((output.stamp - self._origin) * 1e-9, dtype=np.float64), output)
