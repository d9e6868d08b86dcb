"""Old names: nothing answers to one, and the error says the new one."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

import busmaster
from busmaster import InvalidCommand, ReplyTiming
from busmaster.app.config import load
from busmaster.contract.renames import ROOT, STATISTICS, TIMES, now_called, refuse_old_arguments
from busmaster.statistics import LineStatistics

PAGE = Path(__file__).parents[2] / "docs" / "upgrading.md"
GOOD = {"late_after": 0.05, "window": 0.1, "max_reply_delay": 0.2, "inter_byte_timeout": 0.02}


@pytest.mark.parametrize("old", TIMES)
def test_an_old_argument_is_an_error_that_names_the_new_one(old: str) -> None:
    named = {name: value for name, value in GOOD.items() if name != TIMES[old]}
    with pytest.raises(TypeError, match=rf"no argument '{old}': it is now '{TIMES[old]}'"):
        ReplyTiming(**named, **{old: 0.1})


def test_another_wrong_argument_is_an_error_as_it_is_everywhere() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'windows'"):
        ReplyTiming(**GOOD, windows=1)  # type: ignore[call-arg]


@pytest.mark.parametrize("table", ["nodes.winder.timing", "protocols.hcp2.timing", "nodes.winder.timing.write"])
@pytest.mark.parametrize("old", TIMES)
def test_an_old_key_is_an_error_that_names_the_new_one_and_the_command(old: str, table: str, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    node = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
    path.write_text(f'port = "/dev/none?baudrate=57600"\n{node}[{table}]\n{old} = 0.01\n')
    with pytest.raises(InvalidCommand) as refused:
        load(path)
    assert str(refused.value).endswith(
        f"{table}.{old}: no such key; renamed to {TIMES[old]!r}; "
        f"`busmaster migrate {path} --write` changes all old names of the file"
    )


def test_the_page_lists_every_name() -> None:
    text = PAGE.read_text()
    for old in (*TIMES, *STATISTICS):
        assert f"| `{old}` | `{(TIMES | STATISTICS)[old]}`" in text
    rows = [line for line in text.splitlines() if line.startswith("| `busmaster.")]
    for old, (where, new) in ROOT.items():
        [row] = [row for row in rows if re.search(rf"[`.]{old}`", row.split(" | ")[0])]
        assert where in row
        assert old == new or f"{new}`" in row
    assert all(hasattr(LineStatistics, new) for new in STATISTICS.values())


def test_the_old_name_of_the_configuration_names_the_new_ones() -> None:
    with pytest.raises(ImportError, match=r"ConfiguredLine and check are in busmaster\.app\.line"):
        importlib.import_module("busmaster.config")


def test_the_old_name_of_the_frames_names_the_new_one() -> None:
    with pytest.raises(ImportError, match=r"has moved to busmaster\.contract\.frames"):
        importlib.import_module("busmaster.capture.frames")


def test_an_old_key_has_a_new_name_only_where_that_is_a_key() -> None:
    assert now_called("nominal", ["window", "late_after"]) == "late_after"
    assert now_called("nominal", ["window"]) is None
    assert now_called("late_after", ["late_after"]) is None


def test_each_argument_is_looked_at() -> None:
    refuse_old_arguments(["window", "late_after"], "ReplyTiming")
    with pytest.raises(
        TypeError, match="Timing takes no argument 'byte_gap': it is now 'inter_byte_timeout'; see docs"
    ):
        refuse_old_arguments(["window", "byte_gap"], "Timing")


def test_a_moved_name_of_the_package_is_an_error_with_its_new_place() -> None:
    with pytest.raises(
        ImportError, match=r"busmaster\.LatenessRaised has moved: from busmaster\.events import Max"
    ) as err:
        busmaster.LatenessRaised  # noqa: B018  looking it up is the point
    assert err.value.name == "busmaster"
    with pytest.raises(AttributeError, match="module 'busmaster' has no attribute 'Nothing'"):
        busmaster.Nothing  # noqa: B018  likewise
