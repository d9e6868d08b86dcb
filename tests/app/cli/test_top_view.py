"""`busmaster top` in this process: its rows on a screen that draws nothing, and its end."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli import top
from busmaster.app.interfaces.following import Following
from busmaster.errors import LineDown
from tests.app.cli.conftest import Command, owner_here
from tests.patience import PATIENCE


class FakeScreen:
    """A screen without a terminal, which a test ends."""

    shown: list[FakeScreen]
    story: Callable[[FakeScreen], Any]

    def __init__(self, picture: Any, line: Any, *, leave: str) -> None:
        self.picture, self.line, self.leave = picture, line, leave
        self.read_only: bool | None = None
        self.away = ""
        self.taken = 0
        self._status: int | None = None
        self._left = asyncio.Event()
        FakeScreen.shown.append(self)

    def take_picture(self) -> None:
        self.taken += 1

    def exit(self, status: int | None) -> None:
        if not self._left.is_set():  # the first reason counts
            self._status = status
        self._left.set()

    async def until(self, fact: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not fact():  # noqa: ASYNC110  another thread makes it true
                await asyncio.sleep(0.005)

    async def run_async(self) -> int | None:
        playing = asyncio.ensure_future(FakeScreen.story(self))
        left = asyncio.ensure_future(self._left.wait())
        async with asyncio.timeout(PATIENCE):
            await asyncio.wait([playing, left], return_when=asyncio.FIRST_EXCEPTION)
        if playing.done():
            playing.result()
        playing.cancel()
        return self._status


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Whether standard input and output are a terminal, and whether that is still open."""
    there = {"stdin": True, "stdout": True, "open": True}
    usual = os.isatty
    stdin = SimpleNamespace(isatty=lambda: there["stdin"], fileno=lambda: -7)
    stdout = SimpleNamespace(isatty=lambda: there["stdout"])
    monkeypatch.setattr(top, "sys", SimpleNamespace(stdin=stdin, stdout=stdout))
    monkeypatch.setattr(os, "isatty", lambda number: there["open"] if number == -7 else usual(number))
    monkeypatch.setattr(top, "TERMINAL_LOOKED_AT", 0.01)
    monkeypatch.setattr("busmaster.app.cli.live.Screen", FakeScreen)
    FakeScreen.shown = []
    return there


def plays(story: Callable[[FakeScreen], Any]) -> None:
    FakeScreen.story = staticmethod(story)


async def leaves(screen: FakeScreen) -> None:
    """A user who leaves once some pictures were drawn."""
    await screen.until(lambda: screen.taken > 3 and bool(screen.picture.rows))
    screen.exit(0)


@pytest.mark.parametrize(
    ("options", "read_only", "leave"),
    [((), False, "leave"), (("--read-only",), True, "leave"), (("--of-owner",), False, "end the run")],
)
def test_the_screen_shows_the_line_as_the_options_require(
    busmaster: Command,
    file: Path,
    terminal: dict[str, bool],
    options: tuple[str, ...],
    read_only: bool,
    leave: str,
) -> None:
    plays(leaves)
    with owner_here(file):
        ran = busmaster("top", *options)
    assert (ran.status, ran.out, ran.err) == (0, "", "")
    [screen] = FakeScreen.shown
    assert (screen.read_only, screen.leave, screen.away) == (read_only, leave, "")


@pytest.mark.parametrize(("status", "ends"), [(0, 0), (130, 130), (None, 1)])
def test_the_status_is_that_of_the_screen(
    busmaster: Command, file: Path, terminal: dict[str, bool], status: int | None, ends: int
) -> None:
    async def story(screen: FakeScreen) -> None:
        screen.exit(status)

    plays(story)
    with owner_here(file):
        assert busmaster("top").status == ends


def test_a_terminal_that_is_closed_ends_it(busmaster: Command, file: Path, terminal: dict[str, bool]) -> None:
    async def story(screen: FakeScreen) -> None:
        terminal["open"] = False

    plays(story)
    with owner_here(file):
        ran = busmaster("top")
    assert (ran.status, ran.err) == (1, "")


def test_an_internal_error_ends_the_screen_and_is_reported(
    busmaster: Command, file: Path, terminal: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, broken, left = Following.follow, asyncio.Event(), list[bool]()

    async def follow(self: Following, *, patient: bool = True) -> None:
        following = asyncio.ensure_future(usual(self, patient=patient))
        await broken.wait()
        following.cancel()
        raise ZeroDivisionError("a wrong picture")

    async def story(screen: FakeScreen) -> None:
        await screen.until(lambda: screen.taken > 1)
        broken.set()
        for _ in range(5):
            await asyncio.sleep(0)
        left.append(screen._left.is_set())
        screen.exit(0)

    monkeypatch.setattr(Following, "follow", follow)
    plays(story)
    with owner_here(file):
        ran = busmaster("top")
    assert left == [True]
    assert ran.status == 1
    assert "internal error: ZeroDivisionError: a wrong picture" in ran.err


@pytest.mark.parametrize("stream", ["stdin", "stdout"])
def test_without_a_terminal_it_is_wrong_usage(
    busmaster: Command, file: Path, terminal: dict[str, bool], stream: str
) -> None:
    terminal[stream] = False
    with owner_here(file):
        ran = busmaster("top", "slitter")
    assert (ran.status, FakeScreen.shown) == (2, [])
    assert "top needs a terminal; for values in a file or a pipe use busmaster poll or read" in ran.err


@pytest.mark.parametrize("named", ["nobody", "unix:/nobody"])
def test_a_line_that_does_not_run_is_reported_before_the_missing_terminal(
    busmaster: Command, terminal: dict[str, bool], named: str
) -> None:
    terminal["stdin"] = False
    ran = busmaster("top", named)
    assert ran.status == 1
    assert "nobody" in ran.err


@pytest.mark.parametrize(
    ("missing", "extras"),
    [
        (("textual", "msgspec", "websockets"), "tui,service"),
        (("textual",), "tui"),
        (("msgspec",), "service"),
        (("websockets",), "service"),
    ],
)
def test_what_is_missing_is_named_once_and_ends_it(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...], extras: str
) -> None:
    monkeypatch.setattr(top, "find_spec", lambda name: None if name in missing else name)
    ran = busmaster("top", "nobody")
    assert ran.status == 2
    assert f"the live view needs an extra: pip install 'busmaster[{extras}]'" in ran.err


@pytest.mark.parametrize("of_owner", [False, True])
def test_the_end_of_the_owner_is_shown_and_ends_only_its_own_view(
    busmaster: Command, file: Path, terminal: dict[str, bool], of_owner: bool
) -> None:
    serving = owner_here(file)
    serving.__enter__()

    async def story(screen: FakeScreen) -> None:
        await screen.until(lambda: screen.taken > 1)
        await asyncio.to_thread(serving.__exit__, None, None, None)
        await screen.until(lambda: bool(screen.away))
        if not of_owner:
            screen.exit(0)

    plays(story)
    ran = busmaster("top", "slitter", *(("--of-owner",) * of_owner))
    [screen] = FakeScreen.shown
    assert screen.away
    if of_owner:
        assert ran.status == 1
        assert "the program that owns the line has ended" in ran.err
    else:
        assert (ran.status, ran.err) == (0, "")


def test_the_screen_shows_the_line_again_when_its_owner_returns(
    busmaster: Command, file: Path, terminal: dict[str, bool]
) -> None:
    first, second = owner_here(file), owner_here(file)
    first.__enter__()

    async def story(screen: FakeScreen) -> None:
        await screen.until(lambda: screen.taken > 1)
        await asyncio.to_thread(first.__exit__, None, None, None)
        await screen.until(lambda: bool(screen.away))
        await asyncio.to_thread(second.__enter__)
        await screen.until(lambda: not screen.away and bool(screen.picture.rows))
        screen.exit(0)

    plays(story)
    try:
        ran = busmaster("top", "slitter")
    finally:
        second.__exit__(None, None, None)
    assert (ran.status, ran.err) == (0, "")


def test_control_characters_of_the_line_do_not_reach_the_screen(
    busmaster: Command, file: Path, terminal: dict[str, bool]
) -> None:
    file.write_text(file.read_text().replace('title = "Slitter"', 'title = "Slit\\u001b[2Jter"'))
    plays(leaves)
    with owner_here(file):
        assert busmaster("top").status == 0
    [screen] = FakeScreen.shown
    assert "\x1b" not in screen.picture.frame.title
    assert "Slit" in screen.picture.frame.title


@pytest.mark.parametrize("read_only", [False, True])
def test_a_line_by_tcp_is_followed_with_the_token_of_the_environment(
    monkeypatch: pytest.MonkeyPatch, busmaster: Command, read_only: bool
) -> None:
    followed: dict[str, Any] = {}

    def following(address: Callable[[], str], **options: Any) -> None:
        followed.update(address=address(), **options)
        raise LineDown("that is enough", hint="")

    monkeypatch.setenv("BUSMASTER_TOKEN", "secret")
    monkeypatch.setattr(top, "Following", following)
    ran = busmaster("top", "tcp://plant:7420", *(("--read-only",) * read_only))
    assert ran.status == 1
    assert (followed["address"], followed["token"], followed["read_only"]) == ("tcp://plant:7420", "secret", read_only)
