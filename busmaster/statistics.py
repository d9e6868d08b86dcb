"""The statistics of a bus, a node and a poll group, and the timeline of a request."""

from busmaster.arbiter.counters import DriverErrors, LineStatistics, NodeStatistics, Quantiles
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.transaction import Timeline
from busmaster.bus.polling import GroupStatistics

__all__ = [
    "DriverErrors",
    "GroupStatistics",
    "LearnedTimes",
    "LineStatistics",
    "NodeStatistics",
    "Quantiles",
    "Timeline",
]
