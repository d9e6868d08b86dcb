"""One fault, made in a plant of its own, and what came of it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.verification.plant.account import Account, account, status_told
from tests.verification.plant.plant import HOLDERS, Plant, Site


@dataclass(frozen=True, kw_only=True)
class Fault:
    """`make` begins it, waits for what is to be seen of it, ends it, and returns what the table is to say of it.

    `holders` are the outputs that have to come back. `uncounted` are those of which something is lost that nobody can
    count. `status` is what the last run ends with. `beyond` what is promised are those that may bring wrong values.
    """

    name: str
    make: Callable[[Plant], str | None]
    site: Site = field(default_factory=Site)
    holders: tuple[str, ...] = HOLDERS
    uncounted: tuple[str, ...] = ()
    status: int = 0
    beyond: bool = False


def trial(fault: Fault) -> Account:
    with tempfile.TemporaryDirectory(prefix="busmaster-plant-") as folder, Plant(Path(folder), fault.site) as plant:
        plant.begins()
        plant.over_at = 0.0
        note = fault.make(plant)
        back: dict[str, float] = {}
        status: list[str] = []
        if plant.run.runs:
            over = plant.over_at or time.monotonic()
            back = {holder: when - over for holder, when in plant.flows(over, fault.holders).items()}
            status = status_told(plant)
            plant.end_run()
        found = account(plant, fault.name, fault.uncounted, fault.beyond)
        found.told += [f"MQTT: {', '.join(status)}"] if status else []
        found.back = back
        found.notes += [note] if note else []
        ended = plant.run.popen.returncode
        if ended != fault.status:
            found.problems.append(f"the last run ended with {ended}, not {fault.status}: {plant.run.told[-3:]}")
        return found
