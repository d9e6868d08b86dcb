"""The screen, drawn in a terminal of given size: what stands on it, and what its keys send."""

from __future__ import annotations

import socket

import msgspec
import pytest
from rich.cells import cell_len

from busmaster.cli.live import COLUMNS, Screen, age_text, clock_text, column_widths, sparkline
from busmaster.cli.messages import Action, Frame, GroupRow, NodeRow, Row, decode_action, decode_frame, encode

OUTPUTS = Row("node 5", "outputs", 0, writable=True)


def frame(rows: int = 3, *, now: float = 61.0, paused: bool = False) -> Frame:
    points = [Row(f"node {n}", "axis0.position", n + 0.5, "mm", 0.1) for n in range(1, rows)]
    return Frame(
        title="busmaster poll",
        port="/dev/ttyUSB0  57600 8N1",
        now=now,
        line="ready",
        utilisation=0.53,
        backlog=2,
        rows=(*points, Row("node 9", "axis0.position", None, "mm", 12.3, False, "no reply within 100 ms")),
        nodes=(*(NodeRow(f"node {n}", "up", 10, 0, 0.0031, 0.004) for n in range(1, rows)), NodeRow("node 9", "down")),
        groups=(GroupRow("axes", 0.2, 0.2, 0.2011, 61, 1, paused),),
        events=("   3.1 s  node 9 is down, was suspect",),
    )


def picture(screen: Screen) -> list[str]:
    return ["".join(segment.text for segment in strip) for strip in screen.screen._compositor.render_strips()]


@pytest.mark.asyncio
async def test_the_picture_fits_80_by_24_and_says_what_the_frame_says() -> None:
    screen = Screen(None)
    async with screen.run_test(size=(80, 24)) as pilot:
        screen.take_frame(frame())
        await pilot.pause()
        lines = picture(screen)
    assert len(lines) == 24
    assert {cell_len(line) for line in lines} == {80}
    text = "\n".join(lines)
    assert "busmaster poll  /dev/ttyUSB0  57600 8N1" in lines[0]
    assert "0:01:01" in lines[0]
    assert "53% busy  ready  2 waiting" in lines[1]
    assert "axes every 200 ms, achieved 200.0 (p99 201.1)  cycle 61  missed 1" in lines[2]
    assert "node 1    axis0.position" in text
    assert "node 9 is down, was suspect" in text
    assert "quit" in lines[-1]
    dead = next(line for line in lines if line.strip().startswith("node 9") and "axis0" in line)
    assert dead.split()[3:] == ["-", "mm", "12s", "down"]


@pytest.mark.asyncio
async def test_a_number_is_shown_with_as_many_digits_as_its_point_has() -> None:
    screen = Screen(None)
    async with screen.run_test(size=(80, 24)) as pilot:
        rows = (Row("node 1", "speed", 12.3456, precision=1), Row("node 1", "pull", 12.3456))
        screen.take_frame(msgspec.structs.replace(frame(), rows=rows))
        await pilot.pause()
        lines = [line.split() for line in picture(screen)]
    assert [line[2:4] for line in lines if line[:2] == ["node", "1"]] == [["speed", "12.3"]]
    assert [line[:2] for line in lines if line[:1] == ["pull"]] == [["pull", "12.3456"]]


@pytest.mark.asyncio
async def test_two_groups_may_hold_the_same_point_and_the_rows_may_change() -> None:
    screen = Screen(None)
    async with screen.run_test(size=(80, 24)) as pilot:
        for rows in ((OUTPUTS, OUTPUTS), (OUTPUTS,), (Row("node 6", "inputs", 7), OUTPUTS)):
            screen.take_frame(msgspec.structs.replace(frame(), rows=rows))
        await pilot.pause()
        lines = picture(screen)
    assert [line.split()[2:4] for line in lines if line.startswith(" node ")] == [
        ["inputs", "7"],
        ["outputs", "0"],
    ]


@pytest.mark.asyncio
async def test_columns_stay_aligned_when_values_change_and_the_terminal_grows() -> None:
    screen = Screen(None)
    async with screen.run_test(size=(80, 24)) as pilot:
        screen.take_frame(frame())
        await pilot.resize_terminal(120, 40)
        for now in range(5):
            screen.take_frame(frame(now=now))
        await pilot.pause()
        lines = picture(screen)
    header = next(line for line in lines if "VALUE" in line)
    row = next(line for line in lines if "1.5" in line)
    assert header.index("VALUE") + len("VALUE") == row.index("1.5") + len("1.5")
    assert header.index("HEALTH") == row.index("up")
    assert {cell_len(line) for line in lines} == {120}


@pytest.mark.asyncio
async def test_keys_send_actions_and_ctrl_c_is_told_from_quit() -> None:
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    screen = Screen(theirs)
    with ours:
        async with screen.run_test(size=(80, 24)) as pilot:
            ours.sendall(encode(frame()))
            while screen.frame is None:
                await pilot.pause()
            await pilot.press("p", "d", "ctrl+c")
            await pilot.pause()
        received = ours.recv(4096).splitlines()
    assert list(map(decode_action, received)) == [
        Action("pause"),
        Action("demand"),
        Action("interrupt"),
    ]


class Recording(Screen):
    """Keeps what would go through the socket."""

    def __init__(self, connection: socket.socket | None) -> None:
        super().__init__(connection)
        self.sent: list[Action] = []

    def send(self, action: Action) -> None:
        self.sent.append(action)


async def pressed(*keys: str, row: Row, read_only: bool = False) -> list[Action]:
    """What the screen sends when these keys are pressed on that row."""
    screen = Recording(None)
    async with screen.run_test(size=(80, 24)) as pilot:
        screen.take_frame(msgspec.structs.replace(frame(), rows=(row,), read_only=read_only))
        await pilot.pause()
        await pilot.press(*keys)
        await pilot.pause()
    return screen.sent


@pytest.mark.asyncio
async def test_a_value_is_written_once_it_was_asked_whether_it_is_meant() -> None:
    assert await pressed("w", *"1", "full_stop", "5", "enter", "y", row=OUTPUTS) == [
        Action("write", "node 5", "outputs", "1.5")
    ]


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "keys",
    [
        ("w", "5", "enter", "n"),
        ("w", "5", "escape"),
        ("w", "5", "enter", "escape"),
        ("w", "5"),
        ("w", *"abc", "enter", "y"),
    ],
)
async def test_a_value_that_was_not_confirmed_is_not_written(keys: tuple[str, ...]) -> None:
    assert await pressed(*keys, row=OUTPUTS) == []


@pytest.mark.asyncio
async def test_what_is_read_only_asks_for_no_value() -> None:
    assert await pressed("w", "5", "enter", "y", row=OUTPUTS, read_only=True) == []
    assert await pressed("w", "5", "enter", "y", row=Row("node 5", "inputs", 0)) == []


@pytest.mark.asyncio
async def test_the_node_of_the_selected_row_is_suspended() -> None:
    assert await pressed("s", row=OUTPUTS) == [Action("suspend", "node 5")]


def test_messages_come_back_as_they_were_sent() -> None:
    assert decode_frame(encode(frame())) == frame()
    assert decode_action(encode(Action("write", "node 5", "1", "2.5"))) == Action("write", "node 5", "1", "2.5")
    assert encode(frame()).count(b"\n") == 1


def test_the_narrowest_terminal_is_80_columns_and_wider_ones_are_used() -> None:
    assert sum(COLUMNS.values()) + 2 * len(COLUMNS) == 80
    for width in range(80, 114):
        assert sum(column_widths(width).values()) + 2 * len(COLUMNS) == width


def test_a_trend_spans_its_own_lowest_and_highest_and_shows_gaps() -> None:
    assert sparkline([0.0, None, 1.0]) == "▁ █"
    assert sparkline([5.0, 5.0]) == "▁▁"
    assert sparkline([None, None]) == ""


def test_ages_and_clocks_fit_their_columns() -> None:
    assert [age_text(age) for age in (None, 0.04, 9.94, 12.3, 599, 6000)] == [
        "-",
        "0.0s",
        "9.9s",
        "12s",
        "599s",
        "100m",
    ]
    assert clock_text(3661.9) == "1:01:01"


def test_nothing_that_a_frame_says_is_obeyed_by_a_terminal() -> None:
    """A title, an error or a device's text with escape sequences in it is shown as text."""
    evil = "\x1b[2J\x9b31m\x07"
    told = msgspec.structs.replace(
        frame(), title=evil, line=evil, events=(evil,), rows=(Row(evil, evil, evil, evil, error=evil),)
    )
    drawn = decode_frame(encode(told))
    shown = [drawn.title, drawn.line, *drawn.events, *(text for row in drawn.rows for text in (row.node, row.item))]
    assert set(shown) == {r"\u001b[2J\u009b31m\u0007"}
    assert all(str(field).isprintable() for row in drawn.rows for field in msgspec.structs.astuple(row))
