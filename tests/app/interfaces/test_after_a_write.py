"""A value after a write: until it has been read again, no interface reports the old one as good."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from busmaster import Hcp2Controller, connect
from busmaster.app.interfaces import following
from busmaster.app.service.picture import Picture
from tests.app.interfaces.lines import ONE, Page, page, shows
from tests.app.service.lines import Served, served, until

TWIN = "/api/points/axes/5/twin"
OTHER = "/api/points/axes/5/11"
SLOW = 1000.0
"""Seconds of a period in which no poll comes by itself while a test runs."""


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)


def poll_slowly(line: Served) -> None:
    """Poll element 10, by two names, and element 11."""
    controller = Hcp2Controller(line.bus, 5)
    point = controller.point("10")
    twin = replace(point, item="twin", decode=lambda raw: raw * 10, encode=None)
    line.bus.poll_group("axes", period=SLOW, points=[point, twin, controller.point("11")])


async def shown(of: Page, path: str) -> tuple[object, str]:
    said = (await of.client.get(path)).json()
    return said["value"], said["quality"]


@pytest.mark.slow
@pytest.mark.asyncio
async def test_none_of_60_reads_after_60_writes_reports_the_old_value_as_good(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll_slowly(line)
        await shows(of.line)
        for number in range(1, 61):
            assert (await of.client.put(ONE, json={"value": number})).status_code == 200
            assert await shown(of, ONE) == (0, "stale")
            assert (await of.client.get(ONE)).json()["details"]["sample"][1] == "stale"
        assert await shown(of, TWIN) == (0, "stale")
        assert await shown(of, OTHER) == (0, "good")  # of another register
        line.bus.groups[0].demand()
        await until(lambda: of.line.picture.rows[0].value == 60)
        assert await shown(of, ONE) == (60, "good")
        assert await shown(of, TWIN) == (600, "good")


@pytest.mark.slow
@pytest.mark.asyncio
async def test_with_read_after_write_none_of_60_reads_reports_an_old_value_as_good_and_the_new_one_comes_by_itself(
    tmp_path: Path,
) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        point = replace(Hcp2Controller(line.bus, 5).point("10"), read_after_write=True)
        line.bus.poll_group("axes", period=SLOW, points=[point])
        await shows(of.line)
        seen = []
        for number in range(1, 61):
            assert (await of.client.put(ONE, json={"value": number})).status_code == 200
            value, quality = await shown(of, ONE)
            assert quality in ("good", "late", "stale")
            assert quality == "stale" or value == number
            if number % 20 == 0:
                await until(lambda: of.line.picture.rows[0].quality in ("good", "late"))
                seen.append((await shown(of, ONE))[0])
        assert seen == [20, 40, 60]
        assert line.bus.groups[0].statistics().cycles == 1


@pytest.mark.asyncio
async def test_a_write_of_another_program_makes_values_stale_and_an_interface_that_comes_then_is_told(
    tmp_path: Path,
) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll_slowly(line)
        await shows(of.line)
        async with connect(line.address) as remote:
            await Hcp2Controller(remote, 5).point("10").write(3.0)  # a command, not a point of the owner's
        await until(lambda: of.line.picture.rows[0].quality == "stale")
        async with page(tmp_path) as late:
            await shows(late.line)
            assert await shown(late, ONE) == (0, "stale")


@pytest.mark.asyncio
async def test_a_lost_line_makes_every_value_bad_and_every_node_offline_before_the_next_poll(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll_slowly(line)
        await shows(of.line)
        line.bus._pump.connection_lost(OSError("unplugged"))
        await until(lambda: of.line.picture.frame is not None and of.line.picture.frame.state == "offline")
        said = (await of.client.get("/api/line")).json()
        assert "unplugged" in said["why"]
        assert said["since"] is not None
        await until(lambda: all(row.quality == "bad" for row in of.line.picture.rows))
        point = (await of.client.get(ONE)).json()
        assert (point["value"], point["quality"]) == (0, "bad")
        assert "unplugged" in point["error"]
        await until(lambda: {node.health for node in of.line.picture.nodes.values()} == {"offline"})


@pytest.mark.parametrize("quality", ["late", "overheard", "bad"])
def test_a_late_value_is_stale_after_a_write_and_one_that_was_not_current_stays_what_it_was(quality: str) -> None:
    picture = Picture()
    row = {"group": "g", "key": "5/10", "node": "n", "protocol": "hcp2", "address": 5, "item": "10"}
    picture.receive("rows", {"set": 1, "first": 0, "rows": [row]})
    picture.receive("values", {"set": 1, "first": 0, "values": [[1.0, quality, 4.0, "", ""]]})
    picture.receive("touched", {"protocol": "hcp2", "address": 5, "when": 5.0, "items": ["10"], "all": False})
    assert picture.rows[0].quality == ("stale" if quality == "late" else quality)


def test_a_value_that_was_read_before_a_write_and_comes_after_it_is_stale() -> None:
    picture = Picture()
    row = {"group": "g", "key": "5/10", "node": "n", "protocol": "hcp2", "address": 5, "item": "10"}
    picture.receive("rows", {"set": 1, "first": 0, "rows": [row]})
    picture.receive("touched", {"protocol": "hcp2", "address": 5, "when": 5.0, "items": ["10"], "all": False})
    for asked, quality in ((4.0, "stale"), (5.0, "good"), (6.0, "good")):
        picture.receive("values", {"set": 1, "first": 0, "values": [[1.0, "good", asked, "", ""]]})
        assert picture.rows[0].quality == quality
    picture.receive("touched", {"protocol": "hcp2", "address": 5, "when": 7.0, "items": ["11"], "all": False})
    assert picture.rows[0].quality == "good"
    picture.receive("touched", {"protocol": "hcp2", "address": 5, "when": 7.0, "items": None, "all": False})
    assert picture.rows[0].quality == "stale"
    picture.receive("values", {"set": 1, "first": 0, "values": [[1.0, "good", 8.0, "", ""]]})
    picture.receive("touched", {"protocol": "hcp2", "address": 0, "when": 9.0, "items": None, "all": True})
    assert picture.rows[0].quality == "stale"
