"""The screen, drawn in a terminal of given size: what stands on it, and what its keys do to the line."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest
from rich.cells import cell_len
from textual.pilot import Pilot

from busmaster.app.cli import live
from busmaster.app.cli.live import Screen, keys_line
from busmaster.app.cli.terminal import made_printable
from busmaster.app.service.picture import Picture
from busmaster.errors import InvalidCommand, LineDown, WriteUnconfirmed
from tests.app.service.pictures import GROUP, node, row, tell, three_drives
from tests.patience import PATIENCE

SIZES = [(60, 20), (80, 24), (120, 40)]
sizes = pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")


class Wishes:
    """A line that only records the commands, and fails if it has an error."""

    def __init__(self) -> None:
        self.said: list[tuple[Any, ...]] = []
        self.asked: set[tuple[str, str]] = set()
        """The points whose details were requested."""
        self.error: Exception | None = None

    async def pause(self, group: str, paused: bool, /) -> None:
        self.said.append(("pause", group, paused))
        if self.error is not None:
            raise self.error

    async def demand(self, group: str, /) -> None:
        self.said.append(("demand", group))
        if self.error is not None:
            raise self.error

    async def suspend(self, protocol: str, address: int, for_: float, /) -> None:
        self.said.append(("suspend", protocol, address, for_))
        if self.error is not None:
            raise self.error

    async def details(self, group: str, key: str, /) -> Mapping[str, Any]:
        self.asked.add((group, key))
        timeline = {"queued": 1.0, "started": 1.004, "first_byte": 1.009, "last_byte": 1.012, "attempts": 1}
        limit = {"name": "outputs", "minimum": 0, "maximum": 7, "max_step": None, "writable": True}
        told = {"command": "read element 10", "hint": "", "low": None, "high": 5.5, "limits": [limit]}
        return told | {"timeline": timeline | {"exchanges_ahead": 2, "quiet_time_ahead": 0.0}}

    async def write(self, group: str, key: str, value: Any, /) -> None:
        self.said.append(("write", group, key, value))
        if self.error is not None:
            raise self.error


@asynccontextmanager
async def drawn(
    picture: Picture, size: tuple[int, int] = (80, 24), *, read_only: bool = False, leave: str = "leave"
) -> AsyncIterator[tuple[Screen, Wishes, Pilot[int]]]:
    line = Wishes()
    screen = Screen(picture, line, read_only=read_only, leave=leave)
    async with screen.run_test(size=size) as pilot:
        await pilot.pause()
        yield screen, line, pilot


def lines(screen: Screen) -> list[str]:
    return ["".join(segment.text for segment in strip) for strip in screen.screen._compositor.render_strips()]


def table(screen: Screen) -> list[list[str]]:
    """The words of the rows."""
    return [line.split() for line in lines(screen) if line.startswith("node ")]


@sizes
@pytest.mark.asyncio
async def test_the_picture_fits_and_says_what_the_owner_says(size: tuple[int, int]) -> None:
    nodes = (node(1), node(2), node(9, "down"))
    async with drawn(tell(Picture(), *three_drives(), nodes=nodes), size) as (screen, _, _):
        shown = lines(screen)
        rows = table(screen)
    width, height = size
    assert len(shown) == height
    assert {cell_len(line) for line in shown} == {width}
    assert "busmaster poll  /dev/ttyUSB0  57600 8N1" in shown[0]
    assert "0:01:01" in shown[0]
    assert "53% busy  ready  2 queued" in shown[1]
    assert shown[2].startswith(" axes every 200 ms  missed 1  cycle 61")
    assert [words[:3] for words in rows] == [
        ["node", "1", "axis0.position"],
        ["node", "2", "axis0.position"],
        ["node", "9", "axis0.position"],
    ]
    assert [words[-1] for words in rows] == ["up", "up", "down"]
    assert rows[0][3:5] == ["1.5", "mm"]
    assert rows[2][3:5] == ["!", "-"]
    assert "node 9 is down, was suspect" in "\n".join(shown)
    assert "quit" in shown[-1] or "leave" in shown[-1]


@pytest.mark.asyncio
async def test_the_whole_of_a_wide_terminal_is_used_and_columns_stay_aligned() -> None:
    picture = tell(Picture(), *three_drives())
    async with drawn(picture) as (screen, _, pilot):
        await pilot.resize_terminal(120, 40)
        await pilot.pause()
        shown = lines(screen)
    header = next(line for line in shown if "VALUE" in line)
    drawn_row = next(line for line in shown if "1.5" in line)
    assert header.index("HEALTH") == 120 - 9, "the last column ends at the edge"
    assert header.index("VALUE") + len("VALUE") == drawn_row.index("1.5") + len("1.5")
    assert header.index("HEALTH") == drawn_row.index("up")
    assert {cell_len(line) for line in shown} == {120}


@pytest.mark.asyncio
async def test_no_colour_gives_a_picture_in_the_terminals_own_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands out does so by its words, marks and weight."""
    monkeypatch.setenv("NO_COLOR", "1")
    nodes = (node(1), node(2), node(9, "down"))
    async with drawn(tell(Picture(), *three_drives(), nodes=nodes)) as (screen, _, pilot):
        for keys in ((), ("w",), ("escape", "question_mark")):
            await pilot.press(*keys)
            await pilot.pause()
            segments = [segment for strip in screen.screen._compositor.render_strips() for segment in strip]
            colours = {part for one in segments if one.style for part in (one.style.color, one.style.bgcolor) if part}
            assert {colour.name for colour in colours} <= {"default"}
            assert "node 9" in "".join(lines(screen)) or keys


@pytest.mark.asyncio
async def test_only_colours_that_light_and_dark_grounds_both_show_are_used() -> None:
    rows = (*three_drives(), row(3, quality="late"), row(4, quality="stale"))
    nodes = (node(1), node(2, "suspect"), node(3, "suspended"), node(4, "unknown"), node(9, "down"))
    async with drawn(tell(Picture(), *rows, nodes=nodes, utilisation=0.99, state="offline")) as (screen, _, _):
        segments = [segment for strip in screen.screen._compositor.render_strips() for segment in strip]
    colours = {part for one in segments if one.style for part in (one.style.color, one.style.bgcolor) if part}
    assert {colour.name for colour in colours} <= {"default", "red", "magenta", "color(1)", "color(5)"}


@pytest.mark.slow
@pytest.mark.asyncio
async def test_the_selection_stays_on_its_row_through_every_change() -> None:
    picture = tell(Picture(), *three_drives())
    async with drawn(picture) as (screen, _, pilot):
        await pilot.press("down")
        before = screen.table.selected
        assert before is not None
        assert before.name == "node 2 axis0.position"
        changes: list[dict[str, Any]] = [{"set": 2}, {"set": 3}]
        for number, change in enumerate(changes):
            tell(picture, row(number + 3, "inputs", 1), row(number + 5, "inputs", 1), *three_drives(), **change)
            screen.take_picture()
            await pilot.pause()
            now = screen.table.selected
            assert now is not None
            assert now.identity == before.identity
        await pilot.press("o")
        await pilot.resize_terminal(60, 20)
        await pilot.press("slash", *"axis0", "enter")
        await pilot.pause()
        now = screen.table.selected
        assert now is not None
        assert now.identity == before.identity
        assert len(table(screen)) == 3


@pytest.mark.asyncio
async def test_a_click_selects_the_row_under_it_wherever_the_table_is_scrolled_to() -> None:
    async with drawn(tell(Picture(), *(row(number) for number in range(1, 41))), (60, 20)) as (screen, _, pilot):
        for keys in ((), ("end",), ("home",)):
            await pilot.press(*keys)
            await pilot.pause()
            second = table(screen)[1]
            await pilot.click(screen.table, offset=(0, 1))
            await pilot.pause()
            assert screen.table.selected is not None
            assert screen.table.selected.name.split() == second[:3]


@pytest.mark.asyncio
async def test_the_selected_row_stays_in_sight_when_the_terminal_becomes_smaller() -> None:
    async with drawn(tell(Picture(), *(row(number) for number in range(1, 31))), (80, 40)) as (screen, _, pilot):
        await pilot.press("end")
        await pilot.resize_terminal(60, 20)
        await pilot.pause()
        assert table(screen)[-1][1] == "30"


@pytest.mark.slow
@pytest.mark.asyncio
async def test_keys_move_the_selection_by_a_row_a_page_or_to_an_end() -> None:
    async with drawn(tell(Picture(), *(row(number) for number in range(1, 41))), (60, 20)) as (screen, _, pilot):

        async def selected(*keys: str) -> int:
            await pilot.press(*keys)
            await pilot.pause()
            found = screen.table.selected
            assert found is not None
            words = found.name.split()
            assert words[:3] in [shown[:3] for shown in table(screen)], "it is in sight"
            return int(words[1])

        page = screen.table.size.height - 1
        assert page > 3
        assert await selected("up") == 1
        assert await selected("down", "down") == 3
        assert await selected("up") == 2
        assert await selected("pagedown") == 2 + page
        assert await selected("pageup") == 2
        assert await selected("pageup") == 1
        assert await selected("end") == 40
        assert await selected("down") == 40
        assert await selected("pageup") == 40 - page
        assert await selected("home") == 1


@pytest.mark.asyncio
async def test_the_row_in_its_place_is_selected_where_the_selected_one_is_gone() -> None:
    picture = tell(Picture(), *(row(number) for number in range(1, 31)))
    async with drawn(picture, (60, 20)) as (screen, _, pilot):

        async def after(number: int, *numbers: int) -> str:
            tell(picture, *(row(one) for one in numbers), set=number)
            screen.take_picture()
            await pilot.pause()
            found = screen.table.selected
            return "" if found is None else found.name.split()[1]

        await pilot.press(*["down"] * 4)
        assert await after(2, *(number for number in range(1, 31) if number != 5)) == "6"
        assert await after(3, 20, *range(1, 11)) == "6"  # it has moved
        assert [words[1] for words in table(screen)] == ["20", *map(str, range(1, 11))]
        assert await after(4, 1, 2, 3) == "3"
        assert await after(5) == ""
        assert await after(6, 1, 2, 3) == "3"  # it is back
        assert await after(7) == ""
        assert table(screen) == []
        await pilot.press("down", "pagedown")
        assert await after(8, 7, 8, 9) == "7"
        assert await after(9, *range(20, 60), 7) == "7"
        assert table(screen)[-1][1] == "7", "it is in sight"


@pytest.mark.slow
@pytest.mark.asyncio
async def test_rows_are_filtered_by_words_and_ordered_by_trouble() -> None:
    nodes = (node(1), node(2), node(9, "down"))
    async with drawn(tell(Picture(), *three_drives(), nodes=nodes)) as (screen, _, pilot):
        await pilot.press("slash", *"down axis0", "enter")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["9"]
        assert "filter: down axis0" in lines(screen)[-1]
        await pilot.press("slash", *(["backspace"] * 10), "enter")
        tell(screen.picture, *three_drives(), row(10, "inputs", alarm="high"), nodes=(*nodes, node(10)), set=2)
        await pilot.press("o", "o", "o")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["9", "10", "1", "2"]
        assert "trouble" in lines(screen)[-1]


@pytest.mark.slow
@pytest.mark.asyncio
async def test_an_empty_filter_shows_all_rows_again_and_escape_keeps_the_filter() -> None:
    async with drawn(tell(Picture(), *three_drives())) as (screen, _, pilot):
        screen.words = "9"
        await pilot.press("slash", "enter")  # the dialog begins with the present words
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["9"]
        await pilot.press("slash", "backspace", "escape")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["9"]
        await pilot.press("slash", "backspace", "space", "enter")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["1", "2", "9"]
        assert "filter:" not in lines(screen)[-1]


ORDERED = (
    row(3, "b", asked=1050.0, alarm="low"),
    row(4, "a", asked=1060.0, quality="stale"),
    row(1, "d", None, asked=1055.0, error="no reply"),
    row(2, "c", asked=1040.0, quality="late"),
    row(6, "e", asked=1059.0),
)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("presses", "shown", "word"),
    [
        (0, ["1", "2", "3", "4", "6"], ""),
        (1, ["4", "3", "2", "1", "6"], "item"),
        (2, ["1", "2", "3", "6", "4"], "oldest"),
        (3, ["1", "2", "3", "4", "6"], "trouble"),
        (4, ["1", "2", "3", "4", "6"], ""),
    ],
)
async def test_o_orders_rows_by_node_item_age_and_trouble_in_turn(presses: int, shown: list[str], word: str) -> None:
    nodes = tuple(node(number, "suspect" if number == 2 else "up") for number in (1, 2, 3, 4, 6))
    async with drawn(tell(Picture(), *ORDERED, nodes=nodes)) as (screen, _, pilot):
        await pilot.press(*["o"] * presses)
        await pilot.pause()
        assert [words[1] for words in table(screen)] == shown
        assert lines(screen)[-1].startswith(f" {word} " if word else " ? keys")


@pytest.mark.asyncio
async def test_a_point_that_was_never_requested_counts_as_the_oldest() -> None:
    async with drawn(tell(Picture(), row(1), row(2, asked=None), row(3, asked=1040.0))) as (screen, _, pilot):
        await pilot.press("o", "o")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["2", "3", "1"]


@pytest.mark.asyncio
async def test_trouble_is_first_an_error_then_a_node_that_is_not_up_then_an_alarm_then_a_quality() -> None:
    rows = (
        row(1),
        row(2, quality="late"),
        row(3, alarm="low"),
        row(4),
        row(5, error="no reply"),
        row(6, quality="stale"),
    )
    nodes = tuple(node(number, "suspect" if number == 4 else "up") for number in range(1, 7))
    async with drawn(tell(Picture(), *rows, nodes=nodes)) as (screen, _, pilot):
        screen.order = "item"
        await pilot.press("o", "o")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["5", "4", "3", "2", "6", "1"]


@pytest.mark.asyncio
async def test_rows_of_nodes_that_are_not_known_yet_are_the_last_and_count_as_trouble() -> None:
    async with drawn(tell(Picture(), row(7), row(1), row(2), nodes=(node(1), node(2)))) as (screen, _, pilot):
        assert [words[1] for words in table(screen)] == ["1", "2", "7"]
        screen.order = "oldest"
        await pilot.press("o")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["7", "1", "2"]


@pytest.mark.asyncio
async def test_a_filter_begins_with_the_present_words_and_stands_beside_the_order() -> None:
    async with drawn(tell(Picture(), row(1), row(8), row(9))) as (screen, _, pilot):
        await pilot.press("slash", "9", "enter", "slash", "enter", "o")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["9"]
        assert lines(screen)[-1].startswith(" filter: 9, item ")
        await pilot.press("slash", "backspace", "space", "enter")
        await pilot.pause()
        assert [words[1] for words in table(screen)] == ["1", "8", "9"]
        assert lines(screen)[-1].startswith(" item ")


@pytest.mark.asyncio
async def test_the_selection_moves_by_a_page_of_the_table_and_back() -> None:
    async with drawn(tell(Picture(), *(row(number) for number in range(1, 41))), (60, 20)) as (screen, _, pilot):
        page = screen.table.size.height - 1
        for key, number in (("pagedown", 1 + page), ("down", 2 + page), ("pageup", 2), ("pageup", 1)):
            await pilot.press(key)
            assert screen.table.selected is not None
            assert screen.table.selected.name == f"node {number} outputs"


@pytest.mark.asyncio
async def test_the_foot_has_the_error_of_the_selected_row_and_the_last_events_since_the_start() -> None:
    events = [[1000.0 + number, f"event {number}"] for number in (4, 1, 3, 2)]
    async with drawn(tell(Picture(), *three_drives(), events=events)) as (screen, _, pilot):
        assert "no reply within 100 ms" not in "".join(lines(screen))
        await pilot.press("end")
        screen.take_picture()
        await pilot.pause()
        assert [line.strip() for line in lines(screen)[-5:-1]] == [
            "node 9 axis0.position: no reply within 100 ms",
            *(f"{number}.0 s  event {number}" for number in (2, 3, 4)),
        ]
        screen._show_message("written")
        await pilot.pause()
        assert [line.strip() for line in lines(screen)[-3:-1]] == ["4.0 s  event 4", "61.0 s  written"]
        await pilot.resize_terminal(80, 20)
        await pilot.pause()
        assert "event 4" not in "".join(lines(screen)), "a small terminal has room for the last one"
        assert "written" in "".join(lines(screen))


@pytest.mark.asyncio
async def test_points_beyond_those_that_are_shown_are_counted() -> None:
    async with drawn(tell(Picture(), *three_drives(), left_out=7)) as (screen, _, _):
        assert " 7 points more than are shown" in "\n".join(lines(screen))


@pytest.mark.asyncio
async def test_q_closes_the_help_and_not_the_view() -> None:
    async with drawn(tell(Picture(), row()), leave="end the run") as (screen, _, pilot):
        await pilot.press("question_mark")
        await pilot.pause()
        assert "q       end the run" in "\n".join(lines(screen))
        await pilot.press("q")
        await pilot.pause()
        assert len(screen.screen_stack) == 1
        assert screen.is_running
    assert screen.return_value is None


@pytest.mark.slow
@pytest.mark.asyncio
async def test_help_shows_what_q_does_here_and_each_of_its_keys_opens_and_closes_it() -> None:
    async with drawn(tell(Picture(), row()), leave="end the run") as (screen, _, pilot):
        assert "q end the run" in lines(screen)[-1]
        for key, close in (("question_mark", "q"), ("h", "enter"), ("f1", "space"), ("h", "question_mark")):
            await pilot.press(key)
            await pilot.pause()
            assert "q       end the run" in "\n".join(lines(screen))
            await pilot.press(close)
            await pilot.pause()
            assert len(screen.screen_stack) == 1
    assert screen.return_value is None


@pytest.mark.asyncio
async def test_a_text_longer_than_the_terminal_is_scrolled() -> None:
    async with drawn(tell(Picture(), row()), (80, 10)) as (screen, _, pilot):
        await pilot.press("question_mark")
        await pilot.pause()
        first = next(number for number, line in enumerate(lines(screen)) if "another row" in line)
        await pilot.press("down")
        await pilot.pause()
        assert next(number for number, line in enumerate(lines(screen)) if "another row" in line) == first - 1
        await pilot.press("up")
        await pilot.pause()
        assert next(number for number, line in enumerate(lines(screen)) if "another row" in line) == first


@pytest.mark.asyncio
async def test_an_offline_line_is_not_up() -> None:
    async with drawn(tell(Picture(), *three_drives(), state="offline", losses=1)) as (screen, _, _):
        shown = "\n".join(lines(screen))
        assert [words[-1] for words in table(screen)] == ["offline"] * 3
    assert "offline  2 queued  1 disconnect" in shown


@pytest.mark.asyncio
async def test_a_paused_group_rests_and_is_not_late() -> None:
    paused = {**GROUP, "paused": True}
    async with drawn(tell(Picture(), *three_drives(), groups=(paused,), now=5000.0)) as (screen, _, _):
        shown = lines(screen)
    assert shown[2].startswith(" axes  paused  every 200 ms")
    assert "rests up" in " ".join(next(line for line in shown if line.startswith("node 1")).split()).replace("3.1 ", "")


@pytest.mark.asyncio
async def test_a_value_that_could_not_be_read_came_late_or_left_its_limits_has_a_mark() -> None:
    rows = (row(1, error="no reply"), row(2, quality="late"), row(3, alarm="high"), row(4, alarm="low"))
    async with drawn(tell(Picture(), *rows, row(5, quality="stale"), row(6))) as (screen, _, _):
        assert [words[3] for words in table(screen)] == ["!", "~", "↑", "↓", "?", "0"]


@pytest.mark.asyncio
async def test_many_groups_leave_room_for_the_points_and_that_of_the_row_is_shown() -> None:
    groups = tuple({**GROUP, "name": f"group{number}"} for number in range(30))
    async with drawn(tell(Picture(), row(group="group17"), groups=groups), (60, 20)) as (screen, _, _):
        shown = lines(screen)
    assert shown[2].startswith(" group17 every")
    assert shown[3].startswith(" and 29 more groups")
    assert any(line.startswith("node 5") for line in shown)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("height", "shown"), [(40, ["group1", "group0", "group2", "group3", "and"]), (10, ["group1", "and"])]
)
async def test_an_eighth_of_the_screen_is_for_groups_the_first_of_which_is_that_of_the_row(
    height: int, shown: list[str]
) -> None:
    groups = tuple({**GROUP, "name": f"group{number}"} for number in range(30))
    async with drawn(tell(Picture(), row(group="group1"), groups=groups), (60, height)) as (screen, _, _):
        head = lines(screen)[2 : 3 + len(shown)]
    assert [line.split()[0] for line in head] == [*shown, "NODE"]
    assert head[-2].startswith(f" and {31 - len(shown)} more groups")


@pytest.mark.asyncio
async def test_groups_that_fit_are_shown_all() -> None:
    groups = tuple({**GROUP, "name": f"group{number}"} for number in range(3))
    async with drawn(tell(Picture(), row(group="group2"), groups=groups), (80, 24)) as (screen, _, _):
        shown = lines(screen)
    assert [line.split()[0] for line in shown[2:5]] == ["group0", "group1", "group2"]
    assert "more groups" not in "".join(shown)


@pytest.mark.asyncio
async def test_keys_pause_poll_and_suspend_what_is_selected_or_all() -> None:
    groups = (GROUP, {**GROUP, "name": "slow", "paused": True})
    nodes = (node(5), node(6, "suspended"))
    rows = (row(5), row(6, "inputs", group="slow"))
    async with drawn(tell(Picture(), *rows, nodes=nodes, groups=groups)) as (_, line, pilot):
        await pilot.press("p", "d", "D", "P", "s", "n", "s", "y", "down", "p", "s", "y")
        await pilot.pause()
    assert line.said == [
        ("pause", "axes", True),
        ("demand", "axes"),
        ("demand", "axes"),
        ("demand", "slow"),
        ("pause", "axes", True),
        ("pause", "slow", True),
        ("suspend", "hcp2", 5, 60.0),
        ("pause", "slow", False),
        ("suspend", "hcp2", 6, 0.0),
    ]


@pytest.mark.asyncio
async def test_all_groups_are_paused_unless_all_are_and_only_then_resumed() -> None:
    paused = {**GROUP, "name": "slow", "paused": True}
    for groups, wanted in (((GROUP, paused), True), (({**GROUP, "paused": True}, paused), False)):
        async with drawn(tell(Picture(), row(), groups=groups)) as (_, line, pilot):
            await pilot.press("P")
            await pilot.pause()
        assert line.said == [("pause", "axes", wanted), ("pause", "slow", wanted)]


@pytest.mark.asyncio
async def test_a_command_that_fails_is_named_with_its_group_and_why() -> None:
    groups = (GROUP, {**GROUP, "name": "slow", "paused": True})
    async with drawn(tell(Picture(), row(), row(6, group="slow"), groups=groups), (80, 24)) as (screen, line, pilot):
        line.error = InvalidCommand("this role may only read")
        for keys, what in ((("p",), "pause axes"), (("d",), "poll axes"), (("down", "p"), "resume slow")):
            await pilot.press(*keys)
            await pilot.pause()
            assert f" {what}: this role may only read" in "\n".join(lines(screen))
        await pilot.press("s", "y")
        await pilot.pause()
        assert " suspend node 6 for 60 s, all its polls: this role may only read" in "\n".join(lines(screen))


@pytest.mark.asyncio
async def test_a_pause_that_succeeded_is_no_event_and_an_error_has_no_advice_in_its_line() -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):
        await pilot.press("p")
        await pilot.pause()
        assert line.said == [("pause", "axes", True)]
        assert screen.last_message is None
        line.error = LineDown("port lost", hint="plug it in")
        await pilot.press("p")
        await pilot.pause()
        assert lines(screen)[-2].rstrip().endswith(" s  pause axes: port lost")


@pytest.mark.asyncio
async def test_the_question_names_what_is_done_to_which_node() -> None:
    nodes = (node(5), node(6, "suspended"))
    async with drawn(tell(Picture(), row(5), row(6), nodes=nodes)) as (screen, line, pilot):
        await pilot.press("s")
        await pilot.pause()
        assert "suspend node 5 for 60 s, all its polls?  y or n" in "\n".join(lines(screen))
        await pilot.press("n", "down", "s")
        await pilot.pause()
        assert "resume node 6?  y or n" in "\n".join(lines(screen))
        await pilot.press("n")
        await pilot.pause()
        assert len(screen.screen_stack) == 1
    assert line.said == []


@pytest.mark.asyncio
@pytest.mark.parametrize(("key", "status"), [("q", 0), ("ctrl+c", 130)])
async def test_ctrl_c_is_told_from_leaving(key: str, status: int) -> None:
    async with drawn(tell(Picture(), row())) as (screen, _, pilot):
        await pilot.press(key)
        await pilot.pause()
    assert screen.return_value == status


@pytest.mark.asyncio
@pytest.mark.parametrize("keys", [("w",), ("s",), ("slash",), ("question_mark",)])
async def test_ctrl_c_ends_the_view_from_each_dialog(keys: tuple[str, ...]) -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):
        await pilot.press(*keys)
        await pilot.pause()
        assert len(screen.screen_stack) == 2
        await pilot.press("ctrl+c")
        await pilot.pause()
    assert screen.return_value == 130
    assert line.said == []


@pytest.mark.asyncio
@pytest.mark.parametrize("keys", [("w", "5", "enter", "n"), ("s", "n")])
async def test_no_closes_a_question(keys: tuple[str, ...]) -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):
        await pilot.press(*keys)
        await pilot.pause()
        assert len(screen.screen_stack) == 1
    assert line.said == []


async def pressed(*keys: str, point: Any, read_only: bool = False) -> list[tuple[Any, ...]]:
    """The commands to the line when these keys are pressed on that row."""
    async with drawn(tell(Picture(), point), read_only=read_only) as (_, line, pilot):
        await pilot.press(*keys)
        await pilot.pause()
    return line.said


@pytest.mark.asyncio
async def test_a_value_is_written_once_it_was_asked_whether_it_is_meant() -> None:
    written = await pressed("w", *"1", "full_stop", "5", "enter", "y", point=row())
    assert written == [("write", "axes", "5/outputs", 1.5)]


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
    assert await pressed(*keys, point=row()) == []


@pytest.mark.asyncio
async def test_what_is_read_only_asks_for_no_value() -> None:
    assert await pressed("w", "5", "enter", "y", point=row(), read_only=True) == []
    assert await pressed("w", "5", "enter", "y", point=row(writable=False)) == []


@pytest.mark.asyncio
async def test_it_is_said_what_became_of_a_write() -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):
        await pilot.press("w", "1", "enter", "y")
        await pilot.pause()
        assert "node 5 outputs = 1 written" in "\n".join(lines(screen))
        line.error = WriteUnconfirmed("no reply within 100 ms")
        await pilot.press("w", "2", "enter", "y")
        await pilot.pause()
        assert "node 5 outputs = 2: no reply within 100 ms" in "\n".join(lines(screen))


@pytest.mark.asyncio
async def test_the_dialog_of_a_write_names_the_point_its_unit_and_the_value() -> None:
    async with drawn(tell(Picture(), row(unit="mm"))) as (screen, line, pilot):
        await pilot.press("w", "space", "enter")  # nothing is not a value
        await pilot.pause()
        assert "write node 5 outputs in mm  (Enter; Esc cancels)" in "\n".join(lines(screen))
        await pilot.press("backspace", "x", "enter")
        await pilot.pause()
        assert "write node 5 outputs: 'x' is not a number  (Enter" in "\n".join(lines(screen))
        await pilot.press("backspace", "7", "space", "enter")
        await pilot.pause()
        assert "write node 5 outputs = 7 mm?  y or n" in "\n".join(lines(screen))
    assert line.said == []


@pytest.mark.slow
@pytest.mark.asyncio
async def test_the_dialog_of_a_write_shows_the_unit_and_why_a_value_is_none() -> None:
    async with drawn(tell(Picture(), row(unit="mm"))) as (screen, line, pilot):
        await pilot.press("w", "enter")  # nothing is not a value
        await pilot.pause()
        assert "write node 5 outputs in mm  (Enter; Esc cancels)" in "\n".join(lines(screen))
        await pilot.press("x", "enter")
        await pilot.pause()
        assert "write node 5 outputs: 'x' is not a number  (Enter" in "\n".join(lines(screen))
        await pilot.press("backspace", "7", "enter")
        await pilot.pause()
        assert "write node 5 outputs = 7 mm?  y or n" in "\n".join(lines(screen))
        assert line.said == []
        await pilot.press("y")
        await pilot.pause()
    assert line.said == [("write", "axes", "5/outputs", 7)]


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("writable", "view", "line_", "message"),
    [
        (False, False, False, "node 5 outputs is read-only"),
        (True, True, False, "this view is read-only"),
        (True, False, True, "this view is read-only"),
    ],
)
async def test_why_a_point_is_not_written_is_shown(writable: bool, view: bool, line_: bool, message: str) -> None:
    picture = tell(Picture(), row(writable=writable), read_only=line_)
    async with drawn(picture, read_only=view) as (screen, line, pilot):
        await pilot.press("w")
        await pilot.pause()
        assert len(screen.screen_stack) == 1
        assert message in "\n".join(lines(screen))
    assert line.said == []


@pytest.mark.asyncio
async def test_a_write_that_is_refused_shows_why() -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):
        line.error = InvalidCommand("9 is above the maximum of 7")
        await pilot.press("w", "9", "enter", "y")
        await pilot.pause()
        assert "node 5 outputs = 9: 9 is above the maximum of 7" in "\n".join(lines(screen))


@pytest.mark.asyncio
@pytest.mark.parametrize("error", [InvalidCommand("no point 5/outputs"), LineDown("no point 5/outputs")])
async def test_details_follow_the_value_and_say_that_a_point_is_gone(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(live, "ASKED_EVERY", 0.0)
    again = asyncio.Event()
    async with drawn(tell(Picture(), row(value=3))) as (screen, line, pilot):

        async def gone(group: str, key: str, /) -> Mapping[str, Any]:
            if screen.picture.rows[0].value == 4:
                again.set()
                await asyncio.Event().wait()
            tell(screen.picture, row(value=4))
            raise error

        monkeypatch.setattr(line, "details", gone)
        await pilot.press("enter")
        await asyncio.wait_for(again.wait(), PATIENCE)
        await pilot.pause()
        shown = "\n".join(lines(screen))
        assert "no point 5/outputs" in shown
        assert "value    4" in shown
        assert "limits" not in shown


@pytest.mark.asyncio
async def test_details_are_requested_only_while_they_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "ASKED_EVERY", 0.0)
    second, closed = asyncio.Event(), asyncio.Event()
    asked: list[str] = []
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):

        async def details(group: str, key: str, /) -> Mapping[str, Any]:
            asked.append(key)
            if len(asked) > 1:
                second.set()
                await closed.wait()
            assert len(asked) < 3, "it is closed"
            return {}

        monkeypatch.setattr(line, "details", details)
        await pilot.press("enter")
        await asyncio.wait_for(second.wait(), PATIENCE)
        [worker] = screen.workers
        await pilot.press("escape")
        await pilot.pause()
        closed.set()
        await worker.wait()
    assert asked == ["5/outputs"] * 2


@pytest.mark.asyncio
async def test_the_trend_of_a_point_is_one_line_of_its_details() -> None:
    picture = tell(Picture(), row())
    picture.rows[0].past.extend((1000.0 + second, float(second)) for second in range(60))
    async with drawn(picture, (40, 30)) as (screen, _, pilot):
        await pilot.press("enter")
        await pilot.pause()
        trend = [line for line in lines(screen) if {"▄", "█"} & set(line)]
    assert [len(line.strip("│ ")) for line in trend] == [36]


@pytest.mark.asyncio
async def test_details_of_a_point_that_has_left_the_picture_are_those_known_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with drawn(tell(Picture(), row(value=3))) as (screen, line, pilot):

        async def gone(group: str, key: str, /) -> Mapping[str, Any]:
            tell(screen.picture, row(6), set=2)
            raise InvalidCommand("no point 5/outputs")

        monkeypatch.setattr(line, "details", gone)
        await pilot.press("enter")
        shown = ""
        while "no point 5/outputs" not in shown:
            assert any(worker.is_running for worker in screen.workers)
            await pilot.pause()
            shown = "\n".join(lines(screen))
        assert "value    3" in shown


@pytest.mark.asyncio
async def test_details_longer_than_the_terminal_stay_where_they_were_scrolled_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "ASKED_EVERY", 0.0)
    asked, ahead = asyncio.Queue[str](), asyncio.Queue[int]()
    async with drawn(tell(Picture(), row(value=3)), (80, 8)) as (screen, line, pilot):
        known = line.details

        async def details(group: str, key: str, /) -> Mapping[str, Any]:
            asked.put_nowait(key)
            told = await known(group, key)
            return {**told, "timeline": {**told["timeline"], "exchanges_ahead": await ahead.get()}}

        async def refreshed(exchanges: int) -> str:
            """The screen after details with so many exchanges ahead, when they are requested again."""
            ahead.put_nowait(exchanges)
            await asyncio.wait_for(asked.get(), PATIENCE)
            await pilot.pause()
            return "\n".join(lines(screen))

        monkeypatch.setattr(line, "details", details)
        screen.animation_level = "none"
        await pilot.press("enter")
        await asyncio.wait_for(asked.get(), PATIENCE)
        shown = await refreshed(3)
        assert "(5/outputs)" in shown
        assert "behind 3" not in shown
        await pilot.press("end")
        async with asyncio.timeout(PATIENCE):
            while "1 values" not in "\n".join(lines(screen)):
                await pilot.pause()
        shown = await refreshed(4)
        assert "behind 4" in shown
        assert "(5/outputs)" not in shown


@sizes
@pytest.mark.asyncio
async def test_details_show_limits_and_the_last_exchange_of_a_point(size: tuple[int, int]) -> None:
    async with drawn(tell(Picture(), row(value=3, unit="V")), size) as (screen, line, pilot):
        await pilot.press("enter")
        shown = ""
        while "exchange" not in shown:
            await pilot.pause()
            shown = " ".join(" ".join(line.strip("│ ") for line in lines(screen)).split())
        await pilot.press("escape")
        assert len(screen.screen_stack) == 1
    assert "node 5 outputs (5/outputs) value 3 V, requested 0.1s ago" in shown
    assert line.asked == {("axes", "5/outputs")}
    assert "node hcp2 5, up: 10 requests, 0 failed" in shown
    assert "group axes, every 200 ms" in shown
    assert "limits written from 0 to 7; alarm high 5.5" in shown
    assert "exchange waited 4.0 ms behind 2, reply after 5.0 ms, whole after 8.0 ms" in shown


@pytest.mark.asyncio
@pytest.mark.parametrize("keys", [("w",), ("s",), ("slash",), ("enter",), ("question_mark",)])
async def test_the_terminal_may_change_its_size_while_something_is_asked(keys: tuple[str, ...]) -> None:
    async with drawn(tell(Picture(), *three_drives(), row()), (120, 40)) as (screen, line, pilot):
        await pilot.press("end", *keys)
        for size in ((60, 20), (80, 24), (40, 10), (120, 40)):
            await pilot.resize_terminal(*size)
            await pilot.pause()
            assert {cell_len(shown) for shown in lines(screen)} == {size[0]}
        await pilot.press("escape")
        await pilot.pause()
        assert len(screen.screen_stack) == 1
        assert [words[1] for words in table(screen)] == ["1", "2", "9", "5"]
    assert line.said == []


@pytest.mark.asyncio
async def test_silence_of_the_owner_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async with drawn(tell(Picture(), row())) as (screen, _, pilot):
        screen.heard -= 10
        screen.draw()
        await pilot.pause()
        assert "no data for 1" in lines(screen)[0]
        screen.take_picture()
        await pilot.pause()
        assert "no data" not in lines(screen)[0]


@pytest.mark.asyncio
async def test_silence_of_the_owner_is_shown_without_a_key_or_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "SILENT_AFTER", 0.2)
    async with drawn(tell(Picture(), row())) as (screen, _, pilot):
        screen.heard = time.monotonic()
        screen.draw()
        await pilot.pause()
        async with asyncio.timeout(PATIENCE):
            while "no data for " not in lines(screen)[0]:
                await pilot.pause(0.02)


@pytest.mark.asyncio
async def test_while_the_owner_is_away_what_was_known_last_is_shown_with_why() -> None:
    async with drawn(tell(Picture(), row())) as (screen, _, pilot):
        screen.away = "no program serves /run/line.sock"
        screen.heard -= 10
        screen.draw()
        await pilot.pause()
        assert "its owner is not running" in lines(screen)[0]
        assert any("no program serves /run/line.sock" in line for line in lines(screen))
        assert len(table(screen)) == 1
        screen.away = ""
        screen.take_picture()
        await pilot.pause()
        assert not any("away" in line or "no program" in line for line in lines(screen))


@pytest.mark.asyncio
async def test_rows_stay_until_an_owner_that_is_back_has_told_its_own() -> None:
    async with drawn(tell(Picture(), *three_drives())) as (screen, _, pilot):
        screen.picture = Picture()
        screen.take_picture()
        await pilot.resize_terminal(90, 24)  # all rows are drawn again
        await pilot.pause()
        assert "waiting for the program that owns the line" in lines(screen)[0]
        assert len(table(screen)) == 3
        tell(screen.picture, *three_drives()[:2])
        screen.take_picture()
        await pilot.pause()
        assert len(table(screen)) == 2


@pytest.mark.asyncio
async def test_a_command_that_fails_because_its_owner_ended_is_shown_with_the_next_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with drawn(tell(Picture(), row())) as (screen, line, pilot):

        async def pause(group: str, paused: bool, /) -> None:
            screen.picture = Picture()
            raise LineDown("the connection is lost")

        monkeypatch.setattr(line, "pause", pause)
        await pilot.press("p")
        await pilot.pause()
        tell(screen.picture, row(), events=[])
        screen.take_picture()
        await pilot.pause()
        assert "pause axes: the connection is lost" in lines(screen)[-2]


@pytest.mark.asyncio
async def test_keys_do_nothing_before_there_is_a_picture() -> None:
    async with drawn(Picture()) as (screen, line, pilot):
        assert "waiting for the program that owns the line" in lines(screen)[0]
        await pilot.press("p", "P", "d", "s", "w", "enter", "o", "up", "down", "end")
        await pilot.pause()
        assert len(screen.screen_stack) == 1
    assert line.said == []


@pytest.mark.asyncio
async def test_nothing_that_the_owner_says_is_obeyed_by_a_terminal() -> None:
    """A title, an error or a device's text with escape sequences in it is shown as text."""
    evil = "\x1b[2J\x9b31m\x07"
    point, held = row(5, evil, evil, unit=evil, error=evil, group=evil)
    point["node"] = evil
    nodes = (node(5, evil, label=evil),)
    said = {"title": evil, "state": evil, "line": evil, "settings": evil, "events": [[1.0, evil]]}
    groups = ({**GROUP, "name": evil},)
    async with drawn(tell(Picture(made_printable), (point, held), nodes=nodes, groups=groups, **said)) as (
        screen,
        _,
        pilot,
    ):
        for key in ("up", "enter"):
            await pilot.press(key)
            await pilot.pause()
            shown = "".join(lines(screen))
            assert shown.isprintable()
            assert r"\u001b[2J" in shown


def test_the_line_of_keys_has_as_many_as_there_is_room_for() -> None:
    every = (
        " ? keys  q leave  Enter details  / filter  o order  p pause  s suspend  w write  d poll now  ",
        " trouble ? keys  q leave  Enter details  ",
    )
    assert keys_line(len(every[0]), "leave", "").plain == every[0]
    assert keys_line(len(every[0]) - 1, "leave", "").plain == every[0].partition("d poll")[0]
    assert keys_line(45, "leave", "trouble").plain == every[1]


@pytest.mark.parametrize("leave", ["leave", "end the run"])
def test_the_line_of_keys_shows_what_leaving_does_here(leave: str) -> None:
    shown = keys_line(200, leave, "").plain
    assert f"q {leave}  " in shown
    assert shown.count(leave) == 1
