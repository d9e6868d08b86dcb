"""The items of each protocol, written to and read from an emulated drive."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator

import pytest

from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import Command, Outcome, serve, without_time

Ask = Callable[..., Outcome]
"""`ask("read", ITEM...)` of one drive."""


@pytest.fixture(scope="module")
def mscs() -> Iterator[TcpServer]:
    with serve("msc", 3) as server:
        yield server


@pytest.fixture(scope="module")
def mentors() -> Iterator[TcpServer]:
    with serve("mentor", 12, 13) as server:
        yield server


@pytest.fixture
def msc(busmaster: Command, mscs: TcpServer) -> Ask:
    return lambda verb, *rest: busmaster(verb, mscs.path, "--protocol", "msc", "--node", "3", *rest)


@pytest.fixture
def mentor(busmaster: Command, mentors: TcpServer) -> Ask:
    return lambda verb, *rest: busmaster(verb, mentors.path, "--protocol", "mentor", "--node", "12", *rest)


@pytest.mark.slow
def test_msc_data_flags_and_status(msc: Ask) -> None:
    assert msc("write", "2008=1234", "flag:40=1", "--verify").lines == ["2008 ok", "flag:40 ok"]
    assert msc("read", "2008", "flag:40", "flag:41", "status").lines == [
        "2008 1234",
        "flag:40 1",
        "flag:41 0",
        "status 65 PROGRAM_RUNNING|AUTO_START_ENABLED",
    ]
    assert "40" in msc("read", "flags").out.split()[1].split(",")
    assert 40 in json.loads(msc("read", "flags", "--json").out)["value"]


@pytest.mark.slow
def test_msc_values_in_a_row_need_the_address_step(msc: Ask) -> None:
    refused = msc("write", "3000=1,2,3")
    assert (refused.status, refused.out) == (2, "")
    assert "address step" in refused.err
    assert msc("write", "3000=1,-2,3", "--address-step", "4", "--verify").out == "3000 ok\n3004 ok\n3008 ok\n"
    assert msc("write", "3012:1=4", "--verify").out == "3012:1 ok\n"
    assert msc("read", "3000:3", "--address-step", "4").lines == ["3000 1", "3004 -2", "3008 3"]
    assert without_time(msc("read", "3000:3", "--json").out) == {"node": 3, "item": "3000:3", "value": [1, -2, 3]}


def test_msc_refuses_before_anything_is_sent(msc: Ask) -> None:
    cases = [
        ("status=1", "status is read-only"),
        ("flags=1", "flags is read-only"),
        ("flag:5=2", "flag"),
        ("2008=1.5", "whole number"),
        ("2008=4294967296", "2147483647"),
        ("3000:2=1,2,3", "3000:2 takes 2 values, not 3"),
        ("3000:2=1", "3000:2 takes 2 values, not 1"),
        ("flag:5=1,0", "no such item 'flag'"),
        ("speed=1", "no such item 'speed'"),
    ]
    for assignment, complaint in cases:
        outcome = msc("write", "2000=77", assignment)
        assert (outcome.status, outcome.out) == (2, ""), assignment
        assert complaint in outcome.err
    assert msc("read", "2000").out == "2000 0\n"


@pytest.mark.slow
def test_mentor_parameters_wide_integers_and_runs(mentor: Ask) -> None:
    assert mentor("write", "1.17=-476", "15.60:wide=54321", "--verify").lines == ["1.17 ok", "15.60:wide ok"]
    assert mentor("write", "1.18=1,2").out == "1.18 ok\n1.19 ok\n"
    assert mentor("read", "1.17", "01.17", "1.17:hires", "15.60:wide").lines == [
        "1.17 -476",
        "01.17 -476",
        "1.17:hires -4760",
        "15.60:wide 54321",
    ]
    run = ["1.17 -476", "1.18 1", "1.19 2"]
    assert mentor("read", "1.17:3").lines == run
    assert mentor("read", "1.17:3", "--chain").lines == run
    assert without_time(mentor("read", "1.17:3", "--json").out) == {"node": 12, "item": "1.17:3", "value": [-476, 1, 2]}


def test_mentor_node_0_writes_to_all_and_reads_from_none(busmaster: Command, mentors: TcpServer) -> None:
    everyone = ("--protocol", "mentor", "--node", "0")
    assert busmaster("write", mentors.path, *everyone, "1.20=7").out == "1.20 ok\n"
    for node in ("12", "13"):
        assert busmaster("read", mentors.path, "--protocol", "mentor", "--node", node, "1.20").out == "1.20 7\n"
    for arguments in (
        ("read", mentors.path, *everyone, "1.20"),
        ("write", mentors.path, *everyone, "1.20=8", "--verify"),
    ):
        outcome = busmaster(*arguments)
        assert (outcome.status, outcome.out) == (2, "")
    assert busmaster("read", mentors.path, "--protocol", "mentor", "--node", "13", "1.20").out == "1.20 7\n"


def test_mentor_says_that_a_parameter_does_not_exist(mentor: Ask) -> None:
    outcome = mentor("read", "1.22", "17.23")
    assert outcome.status == 1
    assert outcome.lines == ["1.22 0"]
    assert "read 17.23" in outcome.err


@pytest.mark.slow
def test_dc104_takes_no_node_and_raw_16_bit_values(busmaster: Command) -> None:
    with serve("dc104", 0) as server:
        dc104 = ("--protocol", "dc104")
        assert busmaster("write", server.path, *dc104, "1=65535", "5=1,2", "--verify").lines == ["1 ok", "5 ok", "6 ok"]
        assert busmaster("read", server.path, *dc104, "1", "5", "6").lines == ["1 65535", "5 1", "6 2"]
        assert json.loads(busmaster("read", server.path, *dc104, "1", "--json").out)["node"] is None
        for wrong in ("1=-1", "1=65536", "1=1.5", "0=1", "256=1"):
            assert busmaster("write", server.path, *dc104, wrong).status == 2
        assert busmaster("scan", server.path, *dc104).lines == ["0 read parameter 1: 65535"]
        brief = busmaster("poll", server.path, *dc104, "--items", "1", "--period", "0.1", "--seconds", "0.05")
        assert "no request was sent: a new line first waits" in brief.err
        assert brief.lines == []


def test_hcp_elements_end_at_99(busmaster: Command) -> None:
    with serve("hcp", 15) as server:
        hcp = ("--protocol", "hcp", "--node", "15")
        assert busmaster("write", server.path, *hcp, "98=.5,-1", "--verify").out == "98 ok\n99 ok\n"
        assert busmaster("read", server.path, *hcp, "98", "99").lines == ["98 0.5", "99 -1"]
        assert busmaster("read", server.path, *hcp, "100").status == 2
        assert busmaster("write", server.path, *hcp, "99=1,2").status == 2


@pytest.mark.parametrize("arguments", [("read", "status"), ("scan", "--nodes", "3")])
def test_a_rate_that_no_device_has_is_said_once_and_the_command_goes_on(
    busmaster: Command, mscs: TcpServer, arguments: tuple[str, ...]
) -> None:
    verb, *rest = arguments
    node = ("--node", "3") if verb == "read" else ()
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        done = busmaster(verb, f"{mscs.path}?baudrate=19200", "--protocol", "msc", *node, *rest)
    assert done.status == 0
    assert done.out
    told = done.err.splitlines()
    assert [line for line in told if "warning" in line] == [
        f"busmaster: warning: {mscs.path.removeprefix('socket://')}: MSC nodes support only 9600 baud, not 19200"
    ]


@pytest.mark.slow
def test_decimals_of_a_write_are_said_with_it(mentor: Command) -> None:
    assert mentor("write", "1.17=-47.6", "--decimals", "1").out == "1.17 ok\n"
    assert mentor("read", "1.17").out == "1.17 -476\n"
    assert mentor("write", "1.17=1.5,-2.5", "--decimals", "1").out == "1.17 ok\n1.18 ok\n"
    assert mentor("read", "1.17:2").lines == ["1.17 15", "1.18 -25"]


def test_decimals_are_refused_where_the_line_carries_the_point(msc: Command) -> None:
    done = msc("write", "2008=1.5", "--decimals", "1")
    assert done.status == 2
    assert "leave out --decimals" in done.err
