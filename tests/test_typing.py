"""What a user's type checker knows: these are checked by the type checker itself, which runs over the tests."""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any, assert_type

import pytest

from busmaster import (
    Bus,
    BusLike,
    Dc104Drive,
    Hcp2Controller,
    InvalidCommand,
    MentorDrive,
    MicroFlexDrive,
    MscController,
    Node,
    Point,
    PollGroup,
    RemoteBus,
    Sample,
    open_line,
)
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.bus.bus_like import GroupLike
from busmaster.bus.handle import Handle
from busmaster.bus.requester import NodeSource, Requester
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.events import BusEvent, Stream
from busmaster.protocols.hcp2 import StatusWord
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.protocols.msc import ProgramStatus
from busmaster.statistics import LineStatistics
from tests.handles.fake_bus import FakeBus
from tests.stories import on_a_bus


def test_the_value_of_a_sample_has_the_type_of_its_point() -> None:
    async def story(bus: Bus) -> None:
        drive = MicroFlexDrive(bus, 7)
        text: Point[str] = Point(drive.node, "text", hcp2.Read(239), decode=str)
        points: list[Point[Any]] = [drive.speed_measured, drive.status_word, text]
        group = bus.poll_group("g", period=0.1, points=points)
        async for snapshot in group:
            assert_type(snapshot[drive.speed_measured].value, float)
            assert_type(snapshot[drive.status_word], Sample[StatusWord])
            assert_type(snapshot[text].value, str)
            found = [type(snapshot[point].value) for point in points]
            assert found == [float, StatusWord, str]
            break
        assert_type(bus.latest(drive.status_word), Sample[StatusWord] | None)
        assert_type(await drive.status_word.read(max_age=1.0), StatusWord)

    on_a_bus(story, EmulatedMicroFlex(7))


async def every_handles_values(bus: NodeSource) -> None:
    """Never run."""
    assert_type(await Hcp2Controller(bus, 5).read(1, priority=None), float)
    assert_type(await Dc104Drive(bus).read(1, finish_within=1), int)
    assert_type(await MentorDrive(bus, 14).read("1.17", 2), tuple[float, ...])
    assert_type(await MscController(bus, 3).status(), ProgramStatus)
    assert_type(await Hcp2Controller(bus, 5).node.request(hcp2.Read(1)), float)


async def program(bus: BusLike) -> None:
    """Never run."""
    drive = MicroFlexDrive(bus, 7)
    group = bus.poll_group("g", period=0.1, points=[drive.status_word])
    assert_type(group, GroupLike)
    assert_type(bus.group("g"), GroupLike)
    async for snapshot in group:
        assert_type(snapshot[drive.status_word], Sample[StatusWord])
    assert_type(bus.latest(drive.status_word), Sample[StatusWord] | None)
    assert_type(await bus.statistics(), LineStatistics)
    assert_type(bus.events(), Stream[BusEvent])
    async with drive.exclusive() as held:
        assert_type(await held.status(), StatusWord)


async def either(near: Bus, far: RemoteBus) -> None:
    """Never run: a type checker accepts both, and knows of each more than of a `BusLike`."""
    await program(near)
    await program(far)
    assert_type(near.groups, tuple[PollGroup, ...])
    assert_type(far.group("g"), RemoteGroup)
    both: list[GroupLike] = [*near.groups, *far.groups]
    nodes: list[Requester] = [*near.nodes, *far.nodes]
    assert both
    assert nodes


def test_what_both_kinds_of_bus_have_has_the_same_signature() -> None:
    for shared, kinds in ((BusLike, (Bus, RemoteBus)), (GroupLike, (PollGroup, RemoteGroup))):
        for name in [name for name in vars(shared) if name[0] != "_"]:
            for kind in kinds:
                of_protocol, own = inspect.getattr_static(shared, name), inspect.getattr_static(kind, name, None)
                if isinstance(of_protocol, property):
                    assert own is None or isinstance(own, property), f"{kind.__name__}.{name}"
                    continue
                assert inspect.iscoroutinefunction(own) == inspect.iscoroutinefunction(of_protocol), name
                asked = inspect.signature(of_protocol).parameters
                assert list(asked) == list(inspect.signature(own).parameters)[: len(asked)], f"{kind.__name__}.{name}"


async def as_open_line_is_documented() -> None:
    """Never run: the code of `open_line`'s docstring."""
    async with open_line("line.toml") as line:
        await line.nodes["winder"].write(1, 123.456)
        async for snapshot in line.groups["axes"]:  # noqa: B007  # as it is shown
            ...


def test_the_code_of_open_lines_docstring_is_code_that_is_type_checked() -> None:
    documented = (open_line.__doc__ or "").split("\n\n")[1]
    [checked] = ast.parse(textwrap.dedent(inspect.getsource(as_open_line_is_documented))).body
    assert isinstance(checked, ast.AsyncFunctionDef)
    shown = ast.parse("async def shown() -> None:\n" + documented).body[0]
    assert isinstance(shown, ast.AsyncFunctionDef)
    assert [ast.unparse(line) for line in checked.body[1:]] == [ast.unparse(line) for line in shown.body]


def test_handles_need_only_what_has_nodes_and_a_bus_is_one() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line)))
    fake = FakeBus(lambda _: 1.0)
    near: Requester = bus.node(hcp2.PROFILE, 5)
    far: Requester = fake.node(hcp2.PROFILE, 5)
    assert Node.of(Hcp2Controller(bus, 5)) is near
    assert Hcp2Controller(fake, 5).node is far
    with pytest.raises(InvalidCommand, match="node 5 is not a node of a bus in this process"):
        Node.of(Hcp2Controller(fake, 5))


def test_a_handle_that_cannot_name_its_items_cannot_be_made() -> None:
    class Half(Handle):
        profile = hcp2.PROFILE

        def point(self, item: str) -> Point[Any]:
            raise NotImplementedError

    assert Half.__abstractmethods__ == {"items"}
    with pytest.raises(TypeError, match="abstract"):
        Half(FakeBus(lambda _: 1.0), 5)  # type: ignore[abstract]  # that is what is tried
