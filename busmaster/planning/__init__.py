"""Checks whether a schedule fits a line, and how long a request can wait. Pure calculation; see `plan` and `bounds`."""

from busmaster.planning.fit import BAUDRATES, GroupPlan, MergedReads, Plan, PlannedGroup, plan, plan_steps
from busmaster.planning.losses import Losses
from busmaster.planning.worst_case import (
    Bounds,
    PlannedNode,
    Read,
    Sharing,
    bounds,
    longest_hold,
    shape,
)

__all__ = [
    "BAUDRATES",
    "Bounds",
    "GroupPlan",
    "Losses",
    "MergedReads",
    "Plan",
    "PlannedGroup",
    "PlannedNode",
    "Read",
    "Sharing",
    "bounds",
    "longest_hold",
    "plan",
    "plan_steps",
    "shape",
]
