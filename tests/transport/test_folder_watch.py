"""A port that comes back is noticed by what happens in its folder, and by the clock where nothing tells that."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable, Hashable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from busmaster.transport import folder_watch, reconnect
from busmaster.transport.alarm import call_system
from busmaster.transport.identity import folders_to
from busmaster.transport.reconnect import Connection
from busmaster.transport.serial_port import SerialPort
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder
from tests.transport.test_same_device import Attempts, Causes
from tests.transport.usb import UsbTree

NEVER = 1000.0
"""Seconds until the clock would do it."""


@pytest.fixture
def ends() -> Iterator[list[PtyMaster]]:
    made = [PtyMaster() for _ in range(2)]
    yield made
    for end in made:
        end.forget()


@pytest.fixture
def no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is looked for or tried by the clock, but for one attempt right after the loss."""
    for every in ("LOOK_EVERY", "LOOK_ANYWAY"):
        monkeypatch.setattr(reconnect, every, NEVER)


def watches() -> int:
    """How many descriptors of this process are inotify's."""
    links = []
    for number in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{number}"))
        except FileNotFoundError:  # that by which it was listed
            continue
    return links.count("anon_inode:inotify")


async def becomes(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110  # the kernel tells nobody
            await asyncio.sleep(0.001)


class Waits(Connection):
    """Says when it waits for the device, between two attempts."""

    waiting: asyncio.Event

    async def _wait(self, delay: float) -> bool:
        self.waiting.set()
        try:
            return await super()._wait(delay)
        finally:
            self.waiting.clear()


class Looked(SerialPort):
    """Counts the looks at it."""

    looks: list[None] = []  # noqa: RUF012  # cleared by each test

    def presence(self) -> Hashable | None:
        self.looks.append(None)
        return super().presence()

    def folders(self) -> tuple[str, ...]:
        """Return them without that of the pseudoterminals, in which tests that run at the same time make theirs."""
        return tuple(folder for folder in super().folders() if folder != "/dev/pts")


@asynccontextmanager
async def gone(
    port: SerialPort, unplug: Callable[[], None], **options: Any
) -> AsyncIterator[tuple[Connection, Recorder]]:
    """A connection that was open and is lost: what it waits for is the device."""
    recorder = Recorder()
    connection = Waits(port, recorder, first_delay=NEVER, **options)
    connection.waiting = asyncio.Event()
    await connection.open()
    running = asyncio.ensure_future(connection.run())
    try:
        unplug()
        await recorder.lost()
        await connection.waiting.wait()
        yield connection, recorder
    finally:
        await connection.close()
        async with asyncio.timeout(PATIENCE):
            await running
    await becomes(lambda: watches() == 0)  # given back in a thread


# -- where folders are watched ---------------------------------------------------------------------------------------


@pytest.mark.asyncio
@pytest.mark.usefixtures("no_clock")
async def test_an_adapter_that_comes_back_is_opened_by_its_serial_number_as_soon_as_it_has_a_node(
    usb_dev: UsbTree, ends: list[PtyMaster]
) -> None:
    ours, back = ends
    usb_dev.plug(ours.path, "A500ABC", node="ttyUSB0")
    usb_dev.make_node("ttyUSB0", ours.path)
    port = Attempts("usb:A500ABC", baudrate=57600)

    def unplug() -> None:
        usb_dev.unplug(ours.path)
        ours.unplug()

    async with gone(port, unplug) as (_, recorder):
        usb_dev.plug(back.path, "A500ABC", place="1-3", node="ttyUSB7")
        assert usb_dev.dev is not None
        (usb_dev.dev / "something else").touch()
        await port.is_tried(1)  # the kernel describes it, and there is nothing to open yet
        usb_dev.make_node("ttyUSB7", back.path)
        await recorder.connected(2)
        back.write(b"ours")
        await recorder.heard(b"ours")
        await becomes(lambda: watches() == 0)


@pytest.mark.asyncio
@pytest.mark.usefixtures("no_clock")
async def test_a_change_of_its_rights_is_worth_an_attempt_too(usb_dev: UsbTree, ends: list[PtyMaster]) -> None:
    """The group that may open a node is given to it by udev, when it exists already."""
    ours = ends[0]
    usb_dev.plug(ours.path, "A500ABC", node="ttyUSB0")
    usb_dev.make_node("ttyUSB0", ours.path)
    assert usb_dev.dev is not None
    node = usb_dev.dev / "ttyUSB0"
    port = Attempts("usb:A500ABC", baudrate=57600)

    def unplug() -> None:
        usb_dev.unplug(ours.path)
        ours.unplug()
        node.unlink()

    async with gone(port, unplug):
        (usb_dev.root / "class/tty/ttyUSB0").mkdir()  # of whatever kind: it is tried all the same
        node.touch(0o600)
        await port.is_tried(1)
        await asyncio.sleep(2 * reconnect.LOOK_PAUSE)
        for rights in (0o660, 0o666):
            node.chmod(rights)
            await port.is_tried(1)


@pytest.mark.asyncio
@pytest.mark.usefixtures("no_clock")
async def test_a_link_is_followed_into_a_folder_that_went_with_it_and_came_back(
    tmp_path: Path, ends: list[PtyMaster]
) -> None:
    ours, back = ends
    folder = tmp_path / "serial/by-id"
    folder.mkdir(parents=True)
    (folder / "it").symlink_to(ours.path)

    def unplug() -> None:
        (folder / "it").unlink()
        folder.rmdir()
        folder.parent.rmdir()
        ours.unplug()

    async with gone(SerialPort(str(folder / "it"), baudrate=57600), unplug) as (_, recorder):
        folder.parent.mkdir()
        await asyncio.sleep(2 * reconnect.LOOK_PAUSE)  # each step is seen for itself
        folder.mkdir()
        await asyncio.sleep(2 * reconnect.LOOK_PAUSE)
        (folder / "it").symlink_to(back.path)
        await recorder.connected(2)


@pytest.mark.asyncio
async def test_while_nothing_comes_into_the_folder_nobody_looks(
    tmp_path: Path, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    for constant, seconds in (("LOOK_EVERY", 0.001), ("LOOK_PAUSE", 0.001), ("LOOK_ANYWAY", NEVER)):
        monkeypatch.setattr(reconnect, constant, seconds)
    port = Looked(str(tmp_path / "line"), baudrate=57600)
    looks = port.looks
    looks.clear()
    (tmp_path / "line").symlink_to(ends[0].path)
    async with gone(port, ends[0].unplug):
        looks.clear()
        (tmp_path / "something else").touch()
        await becomes(lambda: looks != [])
        await asyncio.sleep(0.1)
        assert len(looks) <= 2, "IN_CREATE and IN_ATTRIB may come apart"


@pytest.mark.asyncio
async def test_however_much_happens_in_the_folder_the_looks_keep_their_pause(
    tmp_path: Path, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconnect, "LOOK_PAUSE", 0.05)
    port = Looked(str(tmp_path / "line"), baudrate=57600)
    (tmp_path / "line").symlink_to(ends[0].path)
    async with gone(port, ends[0].unplug):
        loop = asyncio.get_running_loop()
        port.looks.clear()
        begun = loop.time()
        for number in range(100):
            (tmp_path / f"{number}").touch()
            await asyncio.sleep(0.001)
        # Without a pause there are as many as changes. Attempts to open the port look at it too.
        assert 1 <= len(port.looks) <= (loop.time() - begun) / 0.05 + 6


@pytest.mark.asyncio
async def test_a_folder_that_is_made_while_the_watch_begins_is_watched_too(tmp_path: Path) -> None:
    changed = asyncio.Event()
    told: list[None] = []

    def folders() -> tuple[str, ...]:
        told.append(None)
        return (str(tmp_path),) if len(told) == 1 else (str(tmp_path), str(tmp_path / "inner"))

    (tmp_path / "inner").mkdir()
    watch = folder_watch.watch_folders(None, folders, changed.set)
    assert watch is not None
    (tmp_path / "inner/node").touch()
    await asyncio.wait_for(changed.wait(), PATIENCE)
    watch.close()
    await becomes(lambda: watches() == 0)


@pytest.mark.parametrize("way", ["made", "moved into it", "permitted", "link replaced", "folder moved"])
@pytest.mark.asyncio
async def test_each_way_in_which_a_device_can_appear_in_a_folder_is_noticed(tmp_path: Path, way: str) -> None:
    """udev makes a link beside its place, and renames it."""
    folder, changed = tmp_path / "by-id", asyncio.Event()
    folder.mkdir()
    (folder / "node").touch(0o600)
    (folder / "it").symlink_to("node")
    (tmp_path / "new").symlink_to("node")
    watch = folder_watch.watch_folders(None, lambda: (str(folder),), changed.set)
    assert watch is not None
    match way:
        case "made":
            (folder / "other").symlink_to("node")
        case "moved into it":
            (tmp_path / "new").rename(folder / "other")
        case "permitted":
            (folder / "node").chmod(0o660)
        case "link replaced":
            (tmp_path / "new").replace(folder / "it")
        case "folder moved":
            folder.rename(tmp_path / "by-path")
    async with asyncio.timeout(PATIENCE / 10):
        await changed.wait()
    watch.close()
    await becomes(lambda: watches() == 0)


def test_the_folders_to_a_device_are_those_of_each_link_on_the_way(tmp_path: Path) -> None:
    for folder in ("a", "b", "c"):
        (tmp_path / folder).mkdir()
    (tmp_path / "a/one").symlink_to("../b/two")
    (tmp_path / "b/two").symlink_to(tmp_path / "c/gone/three")
    assert folders_to(str(tmp_path / "a/one")) == tuple(str(tmp_path / folder) for folder in "abc")
    (tmp_path / "c/gone").symlink_to(tmp_path / "c/gone")
    (tmp_path / "a/loop").symlink_to("loop")
    assert folders_to(str(tmp_path / "a/loop")) == (str(tmp_path / "a"),)


@pytest.mark.asyncio
@pytest.mark.usefixtures("no_clock")
async def test_another_device_that_is_accepted_is_opened_without_anything_happening(
    usb: UsbTree, tmp_path: Path, ends: list[PtyMaster]
) -> None:
    ours, other = ends
    name = tmp_path / "line"
    name.symlink_to(ours.path)
    usb.plug(ours.path, "A500ABC", place="1-1")
    usb.plug(other.path, "A500XYZ", place="1-2")
    causes = Causes()
    async with gone(SerialPort(str(name), baudrate=57600), ours.unplug, on_failed=causes.hear) as (
        connection,
        recorder,
    ):
        name.unlink()
        name.symlink_to(other.path)
        await causes.until("is now FTDI A500XYZ")
        connection.accept_device()
        await recorder.connected(2)


# -- where they are not ----------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_where_no_folder_can_be_watched_the_clock_serves_and_the_log_says_so_once(
    usb_dev: UsbTree, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(name: str, *_: object) -> int:
        raise OSError(24, f"{name}: too many watches")

    monkeypatch.setattr(folder_watch, "call_system", refuse)
    monkeypatch.setattr(reconnect, "LOOK_EVERY", 0.01)
    monkeypatch.setattr(reconnect, "LOOK_ANYWAY", NEVER)
    folder_watch.warn_once.cache_clear()
    caplog.set_level(logging.INFO, "busmaster")
    ours, back = ends
    usb_dev.plug(ours.path, "A500ABC", node="ttyUSB0")
    usb_dev.make_node("ttyUSB0", ours.path)

    def unplug() -> None:
        usb_dev.unplug(ours.path)
        ours.unplug()

    async with gone(SerialPort("usb:A500ABC", baudrate=57600), unplug) as (_, recorder):
        usb_dev.plug(back.path, "A500ABC", place="1-3", node="ttyUSB0")
        usb_dev.make_node("ttyUSB0", back.path)
        await recorder.connected(2)
    said = [record.message for record in caplog.records if "polling for ports that come back" in record.message]
    assert len(said) == 1
    assert "too many watches" in said[0]


@pytest.mark.parametrize("limit", ["watches", "loop"])
@pytest.mark.asyncio
async def test_a_watch_that_cannot_begin_keeps_no_descriptor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    def call(name: str, *arguments: Any) -> int:
        if name == "inotify_add_watch":
            raise OSError(28, "No space left on device")
        return call_system(name, *arguments)

    def refuse(*_: object) -> None:
        raise NotImplementedError

    if limit == "loop":
        monkeypatch.setattr(asyncio.get_running_loop(), "add_reader", refuse)
    else:
        monkeypatch.setattr(folder_watch, "call_system", call)
    assert folder_watch.watch_folders(None, lambda: (str(tmp_path),), lambda: None) is None
    async with asyncio.timeout(PATIENCE / 10):
        await becomes(lambda: watches() == 0)


@pytest.mark.asyncio
async def test_what_no_folder_tells_is_seen_by_the_clock_all_the_same(
    usb_dev: UsbTree, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a container the node may stay while the adapter is away."""
    monkeypatch.setattr(reconnect, "LOOK_ANYWAY", 0.01)
    ours, back = ends
    usb_dev.plug(ours.path, "A500ABC", node="ttyUSB0")
    usb_dev.make_node("ttyUSB0", ours.path)
    usb_dev.make_node("ttyUSB1", back.path)

    def unplug() -> None:
        usb_dev.unplug(ours.path)
        ours.unplug()

    async with gone(SerialPort("usb:A500ABC", baudrate=57600), unplug) as (_, recorder):
        usb_dev.plug(back.path, "A500ABC", place="1-3", node="ttyUSB1")
        await recorder.connected(2)
