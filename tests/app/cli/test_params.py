"""`busmaster params`: saved, compared, loaded and undone on a pty that loses replies."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.line.parameter_sets import read_set
from busmaster.emulator.device import Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, serve_pty
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.hcp2 import microflex
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import find, make_device
from tests.app.cli.conftest import Command

WINDOW = ("--timeout", "1000")
"""For a busy machine: the emulated drives answer from a thread of the test's own process."""


@dataclass(frozen=True)
class Case:
    """A kind of drive: which parameters are saved, and values of some of them on two drives."""

    protocol: str
    address: int
    options: tuple[str, ...]
    items: tuple[str, ...]
    one: Mapping[str, float]
    other: Mapping[str, float]
    held: Callable[[Any, str], float]
    count: int

    @property
    def node(self) -> str:
        return str(self.address) if find(self.protocol).profile.addressed else ""

    @property
    def changed(self) -> list[str]:
        return [item for item in self.one if self.one[item] != self.other[item]]


def of_mentor(device: EmulatedMentor, item: str) -> float:
    menu, number = item.split(".")
    return device.value(int(menu) * 100 + int(number), 0.0)


def of_dc104(device: EmulatedDc104, item: str) -> float:
    return device.registers[int(item)]


def of_msc(device: EmulatedMsc, item: str) -> float:
    return device.value(int(item))


CASES = {
    "dc104": Case(
        *("dc104", 0, (), ()),
        {str(number): number * 257 for number in range(1, 256)},
        {str(number): number * 257 if number % 5 else 65535 - number for number in range(1, 256)},
        *(of_dc104, 255),
    ),
    "msc": Case(
        *("msc", 3, ("--address-step", "4"), ("2008:100",)),
        {str(2008 + 4 * number): number * number * 1000 for number in range(100)},
        {str(2008 + 4 * number): number * 1000 - 50_000 for number in range(100)},
        *(of_msc, 100),
    ),
    "microflex": Case(
        *("microflex", 7, (), ()),
        {"torque_reference": 0.0, "speed_reference": 25.5},
        {"torque_reference": 0.0, "speed_reference": -12.25},
        *(getattr, len(microflex.ELEMENTS)),
    ),
    "mentor": Case(
        *("mentor", 12, (), ("1.17:20", "4.26", "13.14", "15.60:4")),
        {"1.18": 500, "1.36": -1000, "4.26": 1, "13.14": 40_000, "15.60": 65_535, "15.63": 7},
        {"1.18": -7, "1.36": -1000, "4.26": 0, "13.14": 3, "15.60": 65_535, "15.63": 50_000},
        *(of_mentor, 26),
    ),
}


def preset(device: Any, values: Mapping[str, float]) -> None:
    """Have a device hold values."""
    for item, value in values.items():
        device.preset(str(microflex.ELEMENTS[item].number) if item in microflex.ELEMENTS else item, value)


@contextmanager
def served(case: Case, device: Device, link: Path, *, paced: bool = False) -> Iterator[PtyServer]:
    line = Line(find(case.protocol).profile.line, [device], chance=random.Random(1), paced=paced)
    with serve_pty(line, link) as server:
        yield server


def round_trip(busmaster: Command, case: Case, folder: Path, *window: str) -> None:
    """Save, change, compare, load, compare, undo: with every fiftieth reply lost."""
    device: Any = make_device(case.protocol, case.address)
    device.faults = Faults(lost=0.02)
    preset(device, case.one)
    if case.protocol == "msc":
        device.preset("status", 0)  # a load is refused while the program runs
    link, file, undo = folder / "line", folder / "one.toml", folder / "undo.toml"
    options = ("--protocol", case.protocol, *(window or WINDOW), *case.options)
    node = f"{case.node}@{link}"
    items = ("--items", ",".join(case.items)) if case.items else ()
    with served(case, device, link) as server:
        where = (str(link), case.node) if case.node else (str(link),)
        saved = busmaster("params", "save", *where, "-o", str(file), *options, *items)
        assert saved.status == 0, saved.err
        entries = read_set(str(file)).set.entries
        assert len(entries) == case.count
        assert {item: entries[item].value for item in case.one} == case.one
        assert not file.with_name("one.toml.part").exists()

        server.call(lambda line, now: preset(device, case.other))
        compared = busmaster("params", "diff", str(file), node, *options, "--json")
        assert compared.status == 1, compared.err
        found = {said["item"]: (said["one"], said["other"]) for said in map(json.loads, compared.lines)}
        assert found == {item: (case.one[item], case.other[item]) for item in case.changed}

        dry = busmaster("params", "load", str(file), node, "--dry-run", *options)
        assert dry.status == 0, dry.err
        assert server.call(lambda line, now: {item: case.held(device, item) for item in case.other}) == case.other

        loaded = busmaster("params", "load", str(file), node, "--yes", "--undo", str(undo), *options)
        assert loaded.status == 0, loaded.err
        written = [line for line in loaded.lines if line.endswith(" ok")]
        assert written == [f"{item} ok" for item in in_order(case, entries)]
        assert server.call(lambda line, now: {item: case.held(device, item) for item in case.one}) == case.one
        assert busmaster("params", "diff", str(file), node, *options).status == 0

        undone = busmaster("params", "load", str(undo), node, "--yes", *options)
        assert undone.status == 0, undone.err
        assert server.call(lambda line, now: {item: case.held(device, item) for item in case.other}) == case.other


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_set_is_saved_compared_loaded_and_undone_with_lost_replies(
    busmaster: Command, tmp_path: Path, name: str
) -> None:
    round_trip(busmaster, CASES[name], tmp_path)


def in_order(case: Case, entries: Mapping[str, Any]) -> list[str]:
    """The changed items in the order of the document."""
    return [item for item in entries if item in case.changed]


# all menus of a Mentor II

MENUS, NUMBERS = range(17), range(100)
GAPS = {f"{menu}.{99 - menu:02d}" for menu in MENUS}
"""Each costs some 0.4 s, the maximum reply delay: one in each menu."""
STILL = {"1.17", "3.02", "11.11"}
"""The speed reference, the speed that follows it, and the address: they are left as they are."""


class FullMentor(EmulatedMentor):
    """A Mentor II that has a parameter at every number but those in GAPS."""

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.hold(0)

    def hold(self, start: int) -> None:
        for number, item in enumerate(every_number()):
            if item not in STILL:
                self.preset(item, (number + start) % 2 if item == "4.26" else (number + start) % 1000)

    @property
    def values(self) -> dict[str, int]:
        return {item: self.value(int(item.replace(".", "")), 0.0) for item in every_number()}


def every_number() -> list[str]:
    found = (f"{menu}.{number:02d}" for menu in MENUS for number in NUMBERS)
    return [item for item in found if item not in GAPS]


@pytest.mark.parametrize(
    "lost", [pytest.param(0.0, marks=pytest.mark.slow), pytest.param(0.02, marks=pytest.mark.exhaustive)]
)
def test_all_menus_of_a_mentor_are_saved_compared_loaded_and_undone(
    busmaster: Command, tmp_path: Path, lost: float
) -> None:
    drive = FullMentor(12)
    link, file, undo = tmp_path / "line", tmp_path / "one.toml", tmp_path / "undo.toml"
    node, options = f"12@{link}", ("--protocol", "mentor", *WINDOW)
    drive.faults = Faults(lost=lost)
    menu_0 = [item for item in every_number() if item.endswith(".00")]
    with serve_pty(Line(find("mentor").profile.line, [drive], chance=random.Random(1), paced=False), link) as server:
        one = server.call(lambda line, now: drive.values)
        saved = busmaster("params", "save", str(link), "12", "-o", str(file), *options)
        assert saved.status == 0, saved.err
        assert f"{len(one)} parameters of node 12; without {len(GAPS)} that the node does not have" in saved.err
        assert {item: entry.value for item, entry in read_set(str(file)).set.entries.items()} == one
        assert list(read_set(str(file)).set.entries) == every_number()

        server.call(lambda line, now: drive.hold(1))
        other = server.call(lambda line, now: drive.values)
        changed = [item for item in every_number() if one[item] != other[item]]
        compared = busmaster("params", "diff", str(file), node, *options, "--json")
        assert compared.status == 1, compared.err
        assert [json.loads(line)["item"] for line in compared.lines] == changed

        loaded = busmaster("params", "load", str(file), node, "--yes", "--undo", str(undo), *options)
        assert loaded.status == 0, loaded.err
        held = server.call(lambda line, now: drive.values)
        written = [line.removesuffix(" ok") for line in loaded.lines if line.endswith(" ok")]
        assert held == one | {item: other[item] for item in changed if item not in written}
        assert written[-len(menu_0) :] == menu_0  # the commands that store
        assert written[: -len(menu_0)] == [item for item in changed if item in written and item not in menu_0]
        assert set(changed) - set(written) == {"11.13"}  # a setting of the port
        assert "11.13 (" in loaded.err

        undone = busmaster("params", "load", str(undo), node, "--yes", *options)
        assert undone.status == 0, undone.err
        assert server.call(lambda line, now: drive.values) == other
