"""What is done to the page of metrics."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from pathlib import Path

from tests.verification.plant.plant import Plant, Site
from tests.verification.plant.trial import Fault

HALF_OPEN = 1_000
SCRAPES = 200


def threads(plant: Plant) -> int:
    return len(list(Path(f"/proc/{plant.run.popen.pid}/task").iterdir()))


def half_open(plant: Plant) -> str:
    before = threads(plant)
    with ExitStack() as stack:
        for number in range(HALF_OPEN):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", plant.metrics), 10.0))
            if number % 2:
                connection.sendall(b"GET /metr")
        answered = plant.scrape()
        most = threads(plant)
    plant.over()
    return f"a scrape at the same time returns {len(answered)} numbers; threads: {before}, then {most}"


def at_once(plant: Plant) -> str:
    before, most = threads(plant), 0
    found: list[int] = []

    def scrape() -> None:
        try:
            found.append(len(plant.scrape(60.0)))
        except (OSError, ValueError):
            found.append(0)

    askers = [threading.Thread(target=scrape) for _ in range(SCRAPES)]
    for asker in askers:
        asker.start()
    while any(asker.is_alive() for asker in askers):
        most = max(most, threads(plant))
        askers[-1].join(0.01)
        askers = [asker for asker in askers if asker.is_alive()] or askers[-1:]
    plant.over()
    whole = sum(map(bool, found))
    return f"{whole} of {SCRAPES} complete; a scrape beyond the limit would get 503; threads: {before}, then {most}"


def nobody_reads(plant: Plant) -> str:
    """They ask and never take the answer."""
    with ExitStack() as stack:
        for _ in range(50):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", plant.metrics), 10.0))
            connection.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        answered = plant.scrape()
    plant.over()
    return f"a scrape at the same time returns {len(answered)} numbers"


def port_taken(plant: Plant) -> None:
    with socket.create_server(("127.0.0.1", plant.metrics)):
        plant.start_drives()
        plant.start_run()
        plant.run.heard("metrics is down")
    plant.over()
    plant.run.heard("metrics is up again", plant.fault_at)
    plant.scrape()


FAULTS = {
    "half-open-scrapes": Fault(name="1,000 half-open connections to the metrics", make=half_open),
    "scrapes": Fault(name="200 scrapes at once", make=at_once),
    "silent-scrapes": Fault(name="50 scrapers that never read the reply", make=nobody_reads),
    "metrics-taken": Fault(
        name="the port of the metrics is in use at startup", make=port_taken, site=Site(starts=False)
    ),
}
