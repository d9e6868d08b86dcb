"""What happens to files, folders and disks under the outputs."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from tests.disks import small_disk
from tests.verification.plant.plant import Plant, Site
from tests.verification.plant.programs import until
from tests.verification.plant.trial import Fault

ENOUGH = 30
"""Cycles that are polled while the fault lasts."""
LOCKED = 10.0
"""Seconds for which somebody else keeps the database."""


def moved(kind: str) -> Callable[[Plant], None]:
    def make(plant: Plant) -> None:
        path = plant.paths[kind]
        aside = path.with_name(f"{path.name}.1")
        for ending in ("", "-wal", "-shm") if kind == "sqlite" else ("",):
            os.replace(f"{path}{ending}", f"{aside}{ending}")
        plant.old.setdefault(kind, []).append(aside)
        plant.over()
        until(path.exists, "another file is begun")

    return make


def removed(kind: str) -> Callable[[Plant], None]:
    def make(plant: Plant) -> None:
        plant.remove(kind)
        plant.over()
        until(plant.paths[kind].exists, "another file is begun")

    return make


def emptied(plant: Plant) -> None:
    """As logrotate's copytruncate does: what is written between copy and cut is lost, and nobody can count it."""
    path = plant.paths["csv"]
    plant.run.stop()
    plant.removed["csv"] = [path.read_text()]
    os.truncate(path, 0)
    plant.run.go_on()
    plant.over()


def folder_removed(plant: Plant) -> None:
    folder = plant.paths["csv"].parent
    plant.remove("csv")
    shutil.rmtree(folder)
    plant.run.heard("csv is down", plant.fault_at)
    folder.mkdir()
    plant.over()
    plant.run.heard("csv is up again", plant.fault_at)


def full(*kinds: str) -> Callable[[Plant], None]:
    def make(plant: Plant) -> None:
        plant.disk.fill()
        for kind in kinds:
            plant.run.heard(f"{kind} is down", plant.fault_at)
        plant.wait_for_cycles(ENOUGH)
        plant.disk.clear()
        plant.over()
        for kind in kinds:
            plant.run.heard(f"{kind} is up again", plant.fault_at)

    return make


def read_only(plant: Plant) -> None:
    """A read-only disk takes the place of the folder; then the folder returns."""
    folder = plant.paths["csv"].parent
    aside = folder.with_name(f"{folder.name}.aside")
    with small_disk(64, read_only=True) as disk:
        folder.rename(aside)
        folder.symlink_to(disk.folder)
        plant.run.heard("csv is down", plant.fault_at)
        plant.run.heard("jsonl is down", plant.fault_at)
        folder.unlink()
        aside.rename(folder)
    plant.over()
    plant.run.heard("csv is up again", plant.fault_at)
    plant.run.heard("jsonl is up again", plant.fault_at)


def locked(plant: Plant) -> None:
    other = subprocess.Popen(["sqlite3", str(plant.paths["sqlite"])], stdin=subprocess.PIPE, text=True)
    assert other.stdin is not None
    other.stdin.write(".timeout 5000\nbegin immediate;\n")
    other.stdin.flush()
    plant.run.heard("sqlite is down", plant.fault_at)
    time.sleep(max(0.0, LOCKED - (time.monotonic() - plant.fault_at)))  # this is what is tried
    other.stdin.close()
    other.wait()
    plant.over()
    plant.run.heard("sqlite is up again", plant.fault_at)


def read_for_long(plant: Plant) -> None:
    """A reader that keeps its snapshot holds up no writer."""
    other = subprocess.Popen(
        ["sqlite3", str(plant.paths["sqlite"])], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    assert other.stdin is not None
    other.stdin.write("begin; select count(*) from history;\n")
    other.stdin.flush()
    plant.wait_for_cycles(ENOUGH)
    other.stdin.close()
    other.wait()
    plant.over()


def no_database(plant: Plant) -> None:
    """Somebody copies something else over it, and removes it when he sees it."""
    path = plant.paths["sqlite"]
    moved("sqlite")(plant)
    plant.flows(time.monotonic(), ("sqlite",))
    other = Path(f"{path}.2")
    for ending in ("", "-wal", "-shm"):
        os.replace(f"{path}{ending}", f"{other}{ending}")
    path.write_text("this is no database at all, but a page of text\n" * 100)
    plant.old["sqlite"].append(other)
    plant.run.heard("sqlite is down", plant.fault_at)
    path.unlink()
    plant.over()
    plant.run.heard("sqlite is up again", plant.fault_at)


def half_a_line(plant: Plant) -> None:
    """Power was lost in the midst of a line."""
    plant.run.send(signal.SIGTERM)
    plant.run.wait()
    path = plant.paths["csv"]
    with path.open("a") as file:
        file.write("2026-01-01T00:00:00.000Z,fast,1,win")
    plant.start_run()
    plant.over()
    plant.run.heard("incomplete line", plant.fault_at)


ON_DISK = Site(disk=256, on_disk=("csv", "jsonl"))
FAULTS = {
    "csv-moved": Fault(name="the CSV file is moved away (rotation)", make=moved("csv")),
    "csv-removed": Fault(name="the CSV file is removed", make=removed("csv")),
    "csv-emptied": Fault(name="the CSV file is emptied (copytruncate)", make=emptied),
    "jsonl-moved": Fault(name="the JSON lines file is moved away", make=moved("jsonl")),
    "folder-removed": Fault(
        name="the folder is removed and created again",
        make=folder_removed,
        site=Site(folder="logs", in_folder=("csv",)),
    ),
    "disk-full": Fault(name="the disk of CSV and JSON lines is full", make=full("csv", "jsonl"), site=ON_DISK),
    "sqlite-full": Fault(
        name="the disk of SQLite is full", make=full("sqlite"), site=Site(disk=1024, on_disk=("sqlite",))
    ),
    "read-only": Fault(
        name="the disk becomes read-only",
        make=read_only,
        site=Site(folder="logs", in_folder=("csv", "jsonl")),
    ),
    "sqlite-locked": Fault(name="another process locks the database for 10 s", make=locked),
    "sqlite-read": Fault(name="another process reads the database in one long transaction", make=read_for_long),
    "sqlite-moved": Fault(name="the database is moved away", make=moved("sqlite")),
    "sqlite-other": Fault(name="another file replaces the database and is then removed", make=no_database),
    "half-line": Fault(name="the CSV file ends with half a line after a crash", make=half_a_line),
}
