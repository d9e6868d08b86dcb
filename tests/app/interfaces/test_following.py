"""A line of another program is followed for good: by a real socket, whoever of the two comes and goes."""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from busmaster.app.interfaces import following
from busmaster.app.interfaces.following import Connected, Following, Lost
from busmaster.app.service.permission import Access
from busmaster.app.service.picture import Frame, Group, Row
from busmaster.bus.polling import PollGroup
from busmaster.errors import InvalidCommand, LineDown, NotStarted
from tests.app.interfaces.lines import READS, assert_goes_on_alone, followed, poll, shows
from tests.app.service.lines import served, until
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits between two tries."""
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)


@pytest.mark.asyncio
async def test_a_line_is_followed_again_however_often_its_owner_comes_and_goes(tmp_path: Path) -> None:
    async with followed(tmp_path) as interface:
        for _ in range(3):
            async with served(tmp_path) as line:
                poll(line)
                await shows(interface)
                assert isinstance(interface.state, Connected)
            await until(lambda: isinstance(interface.state, Lost))
            assert [row.key for row in interface.picture.rows] == ["5/10", "5/outputs"]  # what was known last


@pytest.mark.asyncio
async def test_while_the_owner_is_away_a_write_says_so_and_is_not_sent_later(tmp_path: Path) -> None:
    async with followed(tmp_path) as interface:
        await until(lambda: "no program serves" in getattr(interface.state, "why", ""))
        with pytest.raises(NotStarted, match=r"is not there: .*no program serves"):
            await interface.write("axes", "5/10", 1)
        with pytest.raises(LineDown, match="is not there"):
            await interface.details("axes", "5/10")
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            assert line.records == []


@pytest.mark.asyncio
async def test_a_write_passes_the_owners_authorisation(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        await interface.write("axes", "5/10", 7)
        assert line.audit() == [("5/10", "written")]
        await until(lambda: interface.picture.rows[0].value == 7)


@pytest.mark.asyncio
async def test_groups_and_nodes_rest_as_an_interface_wishes_while_the_owner_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demanded: list[str] = []
    monkeypatch.setattr(PollGroup, "demand", lambda group: demanded.append(group.name))
    async with followed(tmp_path) as interface:
        async with served(tmp_path) as line:
            poll(line)
            [group] = line.bus.groups
            await shows(interface)
            for paused in (True, False):
                await interface.pause("axes", paused)
                assert group.paused is paused
            await interface.demand("axes")
            assert demanded == ["axes"]
            await interface.suspend("hcp2", 5, 60.0)
            assert [node.label for node in line.bus.nodes if node.suspended] == ["node 5"]
        await until(lambda: isinstance(interface.state, Lost))
        for wish in (interface.pause("axes", True), interface.demand("axes"), interface.suspend("hcp2", 5, 0.0)):
            with pytest.raises(LineDown, match="is not there"):
                await wish


@pytest.mark.asyncio
async def test_who_has_no_patience_is_told_why_there_is_no_first_connection_and_follows_for_good_after_it(
    tmp_path: Path,
) -> None:
    interface = Following(lambda: f"unix:{tmp_path}/line.sock")
    with pytest.raises(LineDown, match="no program serves"):
        await interface.follow(patient=False)
    async with asyncio.timeout(PATIENCE):
        async with served(tmp_path) as line:
            poll(line)
            task = asyncio.ensure_future(interface.follow(patient=False))
            await shows(interface)
        await until(lambda: isinstance(interface.state, Lost))
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()


@pytest.mark.asyncio
async def test_a_line_whose_address_is_rejected_is_looked_for_again(tmp_path: Path) -> None:
    addresses = ["", f"unix:{tmp_path}/line.sock"]

    def address() -> str:
        if not (found := addresses[0]):
            raise InvalidCommand("two running lines are named 'slitter'")
        return found

    interface = Following(address)
    async with asyncio.timeout(PATIENCE), served(tmp_path) as line:
        poll(line)
        task = asyncio.ensure_future(interface.follow())
        await until(lambda: "named 'slitter'" in getattr(interface.state, "why", "") or task.done())
        del addresses[0]
        await until(lambda: interface.is_connected or task.done())
        assert not task.done()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.asyncio
async def test_an_address_is_looked_up_in_another_thread(tmp_path: Path) -> None:
    threads: list[int] = []

    def address() -> str:
        threads.append(threading.get_ident())
        raise LineDown("no line is found")

    interface = Following(address)
    with pytest.raises(LineDown, match="no line is found"):
        await interface.follow(patient=False)
    assert threads != [threading.get_ident()]


@pytest.mark.asyncio
async def test_an_interface_that_is_called_finds_what_it_is_called_for(tmp_path: Path) -> None:
    """The picture has each message already, and the line can be used once it is connected."""
    async with followed(tmp_path) as interface:
        rows: list[int] = []
        qualities: list[str] = []
        lines: list[str] = []
        interface.on_picture(lambda method, _: rows.append(len(interface.picture.rows)) if method == "rows" else None)
        interface.on_touched(lambda _: qualities.append(interface.picture.rows[0].quality))
        interface.on_state(lambda: lines.append(interface.remote.line) if interface.is_connected else None)
        async with served(tmp_path) as line:
            poll(line, period=60)
            line.bus.groups[0].demand()
            await shows(interface)
            await interface.write("axes", "5/10", 7)
            await until(lambda: qualities)
        assert lines == ["the emulated line"]
        assert 0 not in rows
        assert qualities == ["stale"]


@pytest.mark.asyncio
async def test_an_interface_that_is_read_only_writes_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path, read_only=True) as interface:
        poll(line)
        await shows(interface)
        assert interface.read_only
        with pytest.raises(InvalidCommand, match="this interface is read-only"):
            await interface.write("axes", "5/10", 7)
        assert line.records == []


@pytest.mark.asyncio
async def test_an_interface_is_told_when_its_role_is_changed_and_goes_on_with_its_picture(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        told: list[bool] = []
        interface.on_state(lambda: told.append(interface.read_only))
        picture = interface.picture
        line.authorisation.access = READS
        await until(lambda: told == [True])
        with pytest.raises(InvalidCommand, match="may read this line"):
            await interface.write("axes", "5/10", 7)
        line.authorisation.access = Access()
        await until(lambda: told == [True, False])
        await interface.write("axes", "5/10", 7)
        assert interface.picture is picture


@pytest.mark.asyncio
async def test_interfaces_that_come_and_go_leave_nothing_with_the_line(tmp_path: Path) -> None:
    async with served(tmp_path) as line:
        poll(line)
        for _ in range(20):
            async with followed(tmp_path) as interface:
                await shows(interface)
        await assert_goes_on_alone(line)


@pytest.mark.asyncio
async def test_an_interface_is_told_of_each_picture_and_of_each_change_until_it_no_longer_wants_to_be(
    tmp_path: Path,
) -> None:
    told: list[str] = []
    async with followed(tmp_path) as interface:
        leave = interface.on_picture(lambda method, said: told.append(method))
        leave_state = interface.on_state(lambda: told.append(type(interface.state).__name__))
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            await until(lambda: "frame" in told)
        await until(lambda: "Lost" in told)
        assert {"rows", "values", "groups", "nodes", "frame", "Connected"} <= set(told)
        leave()
        leave_state()
        told.clear()
        async with served(tmp_path):
            await until(lambda: interface.is_connected)
        assert told == []


@pytest.mark.asyncio
async def test_times_of_the_line_are_times_of_day(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        assert abs(interface.wall_time(line.bus.now() - 3600) - interface.wall_time(line.bus.now()) + 3600) < PATIENCE


# without an owner


def row(**given: Any) -> Row:
    """One row of a picture."""
    fields: dict[str, Any] = {"group": "axes", "node": "winder", "protocol": "hcp2", "address": 5, "item": "10"}
    fields |= {"key": f"winder/{given.get('item', '10')}", "quality": "good", "asked": 100.0, **given}
    return Row(**fields)


def shown_frame(**given: Any) -> Frame:
    """The frame of a picture."""
    texts: dict[str, Any] = {"title": "", "line": "slitter", "settings": "", "state": "ready", "events": ()}
    counts = {"backlog": 3, "losses": 2, "groups": 9, "nodes": 9, "points": 1, "left_out": 0}
    times = {"now": 100.0, "elapsed": 60.0, "utilisation": 0.5, "read_only": False}
    return Frame(**{**texts, **counts, **times, **given})


class Remote:
    """The bus of an owner, as far as its clock."""

    def __init__(self, now: float = 100.0) -> None:
        self.time = now

    def now(self) -> float:
        return self.time


def connected(remote: Any, **about: Any) -> Following:
    """A line whose owner is there."""
    line = Following(lambda: "")
    line._remote = remote
    line.state = Connected({"read_only": False, **about})
    return line


def test_a_group_is_old_after_three_of_its_periods_as_configured_or_as_seen_and_a_second_at_least() -> None:
    line = connected(Remote())
    line.picture.frame = shown_frame()
    line.picture._groups[0] = [Group("fast", 0.02), Group("slow", 10.0), Group("overloaded", 0.02, achieved=2.0)]
    names = ("fast", "slow", "overloaded", "unknown")

    def old(age: float) -> set[str]:
        return line.old_groups(dict.fromkeys(names, 100.0), 100.0 + age)

    assert old(0.9) == set()
    assert old(1.1) == {"fast", "unknown"}
    assert old(5.9) == {"fast", "unknown"}
    assert old(6.1) == {"fast", "overloaded", "unknown"}
    assert old(29.9) == {"fast", "overloaded", "unknown"}
    assert old(30.1) == set(names)


def test_a_time_of_day_is_calculated_by_the_clock_of_the_line() -> None:
    line, before = connected(Remote(now=1_000_000.0)), time.time()
    assert before <= line.wall_time(1_000_000.0) <= time.time()
    assert line.wall_time(1_000_000.0 - 3600.0) <= time.time() - 3600.0


def test_a_value_is_current_while_its_owner_is_there_and_its_group_goes_on() -> None:
    remote = Remote(100.5)
    line = connected(remote)
    line.picture.frame = shown_frame()
    line.picture._groups[0] = [Group("axes", 0.02)]
    assert line.is_current(row())
    assert line.is_current(row(quality="late"))
    assert not line.is_current(row(quality="stale"))
    assert not line.is_current(row(quality="bad"))
    assert not line.is_current(row(asked=None))
    remote.time = 102.0
    assert not line.is_current(row())
    remote.time = 100.5
    line._remote = None
    assert not line.is_current(row())


@pytest.mark.parametrize(
    ("of_interface", "of_role", "of_owner"),
    [(False, False, None), (True, False, False), (False, True, None), (False, False, True), (False, False, False)],
)
def test_an_interface_writes_nothing_if_it_or_its_role_or_its_owner_is_read_only(
    of_interface: bool, of_role: bool, of_owner: bool | None
) -> None:
    line = Following(lambda: "", read_only=of_interface)
    line.state = Connected({"read_only": of_role})
    line.picture.frame = None if of_owner is None else shown_frame(read_only=of_owner)
    assert line.read_only is (of_interface or of_role or bool(of_owner))


def test_of_one_loss_the_first_time_and_the_latest_reason_are_known_and_each_change_is_told_once() -> None:
    line = connected(Remote())
    line.picture._rows[0] = [row()]
    told: list[object] = []

    def once() -> None:
        told.append("once")
        leave()

    leave = line.on_state(once)
    line.on_state(lambda: told.append(line.state))
    line._change(Lost("closed", since=1.0))
    line._change(Lost("no program serves it", since=2.0))
    line._change(Lost("no program serves it", since=3.0))
    assert told == ["once", Lost("closed"), Lost("no program serves it")]
    assert cast("Lost", line.state).since == 1.0
    assert (line.picture.rows[0].quality, line.picture.rows[0].error) == ("bad", "no program serves it")
    line._change(Connected({}))
    line._change(Lost("closed", since=4.0))
    assert cast("Lost", line.state).since == 4.0


def test_all_who_want_a_message_get_it_until_they_leave_also_while_it_is_sent() -> None:
    line = connected(Remote())
    told: list[str] = []

    def once(*_: object) -> None:
        told.append("once")
        leave()
        leave_touched()

    leave, leave_touched = line.on_picture(once), line.on_touched(once)
    line.on_picture(lambda method, _: told.append(method))
    line.on_touched(lambda params: told.append(params["protocol"]))
    touched = {"protocol": "hcp2", "address": 5, "when": 101.0, "items": None, "all": False}
    leave_again = line.on_touched(once)
    leave_again()
    line._receive("groups", {"first": 0, "groups": []})
    assert told == ["once", "groups"]
    told.clear()
    leave_touched = line.on_touched(once)
    leave = line.on_picture(once)
    line.picture._rows[0] = [row()]
    line._receive_touched(touched)
    line._receive_touched(touched)
    assert told == ["hcp2", "once", "hcp2"]
    assert line.picture.rows[0].quality == "stale"


@pytest.mark.asyncio
async def test_pauses_between_tries_to_connect_are_doubled_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.25)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 2.0)
    pauses: list[float] = []
    tokens: list[str | None] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 7:
            raise asyncio.CancelledError

    class Gone:
        """A connection that ends at once; the first four tries fail."""

        def __init__(self, _address: str, *, token: str | None) -> None:
            tokens.append(token)

        async def __aenter__(self) -> Any:
            if len(tokens) < 5:
                raise LineDown("no program serves it")
            return SimpleNamespace(about={"read_only": False}, on_access=[], on_touched=[], overview=self._overview)

        async def __aexit__(self, *_: object) -> None:
            pass

        async def _overview(self, _receive: object) -> Any:
            raise LineDown("closed")

    monkeypatch.setattr(following, "connect", Gone)
    monkeypatch.setattr(following, "asyncio", SimpleNamespace(sleep=sleep, to_thread=asyncio.to_thread))
    line = Following(lambda: "unix:x", token="secret")
    with pytest.raises(asyncio.CancelledError):
        await line.follow()
    assert pauses == [0.25, 0.5, 1.0, 2.0, 0.25, 0.25, 0.25]
    assert set(tokens) == {"secret"}


class StubOwner:
    """Replaces the connection to an owner. A subclass has the `_overview`."""

    _overview: Any

    def __init__(self, *_: object, **__: object) -> None:
        pass

    async def __aenter__(self) -> Any:
        return SimpleNamespace(about={"read_only": False}, on_access=[], on_touched=[], overview=self._overview)

    async def __aexit__(self, *_: object) -> None:
        pass


@pytest.mark.asyncio
async def test_while_a_line_is_being_connected_nothing_is_written_and_its_values_are_prepared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entered = asyncio.Event()

    class Slow(StubOwner):
        async def _overview(self, receive: Any) -> Any:
            described = {"group": "g", "key": "5/1", "node": "n", "protocol": "hcp2", "address": 5, "item": "1"}
            receive("rows", {"set": 1, "first": 0, "rows": [described]})
            receive("values", {"set": 1, "first": 0, "values": [["x", "good", 4.0, "", ""]]})
            entered.set()
            await asyncio.Event().wait()

    monkeypatch.setattr(following, "connect", Slow)
    cleaned: list[Any] = []

    def clean(decoded: Any) -> Any:
        cleaned.append(decoded)
        return dict(decoded)

    line = Following(lambda: "unix:x", clean=clean)
    before = time.time()
    following_it = asyncio.ensure_future(line.follow())
    await entered.wait()
    assert line.is_connected
    assert line.picture.rows[0].value == "x"
    assert [sorted(decoded) for decoded in cleaned] == [["first", "rows", "set"], ["first", "set", "values"]]
    with pytest.raises(NotStarted, match="is not there: its program is being connected"):
        await line.write("g", "5/1", 1)
    with pytest.raises(LineDown, match="its program is being connected"):
        await line.details("g", "5/1")
    following_it.cancel()
    await asyncio.gather(following_it, return_exceptions=True)
    with pytest.raises(LineDown):
        _ = line.remote
    assert before <= Lost("x").since <= time.time()


@pytest.mark.asyncio
async def test_the_picture_is_that_of_the_owner_that_came_last_however_it_numbers_its_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    owners = iter([(7, "5/1"), (1, "5/2")])
    entered = asyncio.Event()

    class Connection(StubOwner):
        async def _overview(self, receive: Any) -> Any:
            number, key = next(owners)
            described = {"group": "g", "key": key, "node": "n", "protocol": "hcp2", "address": 5, "item": key[2:]}
            receive("rows", {"set": number, "first": 0, "rows": [described]})
            if number == 7:
                raise LineDown("restarted")
            entered.set()
            await asyncio.Event().wait()

    monkeypatch.setattr(following, "connect", Connection)
    line = Following(lambda: "unix:x", clean=dict)
    following_it = asyncio.ensure_future(line.follow())
    async with asyncio.timeout(PATIENCE):
        await entered.wait()
    assert [row.key for row in line.picture.rows] == ["5/2"]
    following_it.cancel()
    await asyncio.gather(following_it, return_exceptions=True)
