"""What `busmaster plan` prints and returns of a plan."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import LineSettings, Priority, Rfc2217Port, SerialPort, TcpPort
from busmaster.app.cli import plan
from tests.app.cli.conftest import Command

LOSSES = SimpleNamespace(share=0.01, documented=0.5, learned=0.25, windows=(0.02, 0.1))
MERGED = SimpleNamespace(node="winder", command="read 10", serves=3, saved=2)
GROUP: dict[str, Any] = {
    "name": "fast",
    "period": 0.02,
    "values": 3,
    "exchanges": 2,
    "utilisation": 0.4,
    "line_time": 0.008,
    "cycle": 0.011,
    "longest_cycle": 0.013,
    "worst_wait": 0.5,
    "worst_cycle": 0.7,
    "missed": 0.05,
    "achieved": 0.021,
    "fitting_period": 0.03,
    "merged": (MERGED,),
}


def group(**different: Any) -> Any:
    return SimpleNamespace(**{**GROUP, **different})


def planned(*groups: Any, **different: Any) -> Any:
    return SimpleNamespace(
        **{
            "fits": True,
            "advice": (),
            "groups": groups,
            "utilisation": 0.42,
            "line": LineSettings(57600),
            "typical_wait": 0.004,
            "dead_wait": 0.15,
            "worst_waits": dict(zip(Priority, (0.1, 0.2, 0.3, inf), strict=True)),
            "fitting_baudrate": 115200,
            "losses": LOSSES,
            **different,
        }
    )


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 ms"),
        (0.0025, "2.5 ms"),
        (0.9994, "999 ms"),
        (0.9996, "1 s"),
        (1.254, "1.25 s"),
        (999.4, "999 s"),
        (999.6, "1000 s"),
        (86400.0, "86400 s"),
        (inf, "never"),
    ],
)
def test_a_time_has_three_digits_or_whole_seconds(seconds: float, text: str) -> None:
    assert plan.time_text(seconds) == text


def test_only_a_port_whose_framing_is_set_here_is_printed_with_it() -> None:
    line = LineSettings(57600)
    assert (
        plan.port_text(SerialPort("/dev/ttyUSB0", baudrate=57600), line) == f"/dev/ttyUSB0, 57600 baud {line.framing}"
    )
    assert plan.port_text(Rfc2217Port("plant", 4001, baudrate=57600), line).endswith(f", 57600 baud {line.framing}")
    assert plan.port_text(TcpPort("plant", 4001, baudrate=57600), line) == "plant:4001, 57600 baud"


def test_a_row_has_the_cells_of_its_head() -> None:
    cells = ("fast", "20 ms", "3", "2", "40%", "11 ms", "13 ms", "5%")
    assert plan.row(group()) == cells
    assert len(cells) == len(plan.HEAD)


@pytest.mark.parametrize(
    ("fits", "advice", "lines"),
    [
        (True, (), ["it fits: the schedule needs 42% of the line"]),
        (True, ("one", "two"), ["it barely fits:", "one", "two"]),
        (False, ("one", "two"), ["it does not fit:", "one", "two"]),
    ],
)
def test_the_verdict_has_all_of_the_advice(fits: bool, advice: tuple[str, ...], lines: list[str]) -> None:
    page = plan.page("head", planned(group(), fits=fits, advice=advice), [])
    assert page[0] == "head"
    assert page[3 : 3 + len(lines)] == lines
    waits, worst, losses = page[3 + len(lines) :]
    assert waits == (
        "a command waits up to 4 ms on a healthy line; while a dead node is probed all waits are about 150 ms longer"
    )
    assert worst.endswith("takes its longest possible time: urgent 100 ms, command 200 ms, poll 300 ms")
    assert losses == (
        'if 1% of all frames are lost, the schedule needs 50% of the line, and 25% with timing = "learned" '
        "(windows of 20 ms to 100 ms)"
    )


def test_a_plan_without_groups_has_no_waits_and_no_losses() -> None:
    page = plan.page("head", planned(), ["winder"], shared=True)
    assert page[:3] == ["head", "no poll groups", "it fits: the schedule needs 42% of the line"]
    assert len(page) == 4
    assert page[3].startswith("reply times are assumed (half of late_after) for winder; ")


def test_one_window_is_printed_once() -> None:
    losses: Any = SimpleNamespace(share=0.01, documented=0.5, learned=0.25, windows=(0.02, 0.02))
    assert plan.losses_text(losses).endswith("(a window of 20 ms)")


def test_json_has_each_figure_under_its_name_and_null_for_what_never_comes() -> None:
    found = plan.fields(planned(group(), group(cycle=inf, longest_cycle=inf, achieved=inf), advice=("one", "two")))
    first, second = found["groups"]
    assert first == {
        **{key: value for key, value in GROUP.items() if key not in ("name", "merged")},
        "group": "fast",
        "merged": [{"node": "winder", "command": "read 10", "serves": 3, "saved": 2}],
    }
    assert [second[key] for key in ("cycle", "longest_cycle", "achieved", "worst_wait")] == [None, None, None, 0.5]
    never = plan.fields(planned(group(worst_wait=inf, worst_cycle=inf)))["groups"][0]
    assert (never["worst_wait"], never["worst_cycle"], never["cycle"]) == (None, None, 0.011)
    assert found["line"] == {"baudrate": 57600, "framing": LineSettings(57600).framing}
    assert (found["typical_wait"], found["dead_wait"]) == (0.004, 0.15)
    assert found["worst_waits"] == {"urgent": 0.1, "command": 0.2, "poll": 0.3, "background": None}
    assert found["losses"] == {
        "share": 0.01,
        "utilisation": 0.5,
        "learned_utilisation": 0.25,
        "learned_windows": (0.02, 0.1),
    }
    assert (found["fits"], found["utilisation"], found["fitting_baudrate"]) == (True, 0.42, 115200)
    assert found["advice"] == ["one", "two"]
    waits = planned(group(), worst_waits={Priority.URGENT: inf})
    assert set(plan.fields(waits)["program_waits"].values()) == {None}


@pytest.mark.parametrize(
    ("section", "shared"),
    [
        ("", False),
        ("[service]\n", False),
        ('[service.users.root]\nrole = "read"\n', True),
        ('[service]\nmode = "0660"\ngroup = "root"\n[service.groups.root]\nrole = "read"\n', True),
        ('[service]\nlisten = "127.0.0.1:0"\n', True),
    ],
)
def test_the_shares_of_programs_are_printed_where_the_file_provides_for_them(
    busmaster: Command, file: Path, section: str, shared: bool
) -> None:
    file.write_text(file.read_text() + section)
    ran = busmaster("plan", str(file))
    assert ran.status in (0, 1), ran.err
    assert ("programs of a role" in ran.out) is shared


def test_only_nodes_without_a_reply_time_have_an_assumed_one(busmaster: Command, file: Path) -> None:
    other = '[nodes.other]\nprotocol = "hcp2"\naddress = 2\nreply_time = 0.003\n'
    file.write_text(file.read_text().replace("[groups.fast]", f"{other}[groups.fast]"))
    ran = busmaster("plan", str(file), "--json")
    assert json.loads(ran.out)["assumed_reply_times"] == ["winder"], ran.err
