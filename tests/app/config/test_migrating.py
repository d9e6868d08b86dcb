"""`migrated` gives keys their new names, and changes nothing else of a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from busmaster.app.config import FileError, load
from busmaster.app.config.migrating import migrated
from busmaster.app.config.source import Source

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))
HEAD = 'port = "/dev/none?baudrate=57600"\n[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
TIMED = (
    "timing = { nominal = 0.05, window = 0.1, lateness = 0.15, byte_gap = 0.02, turnaround = 0.0 }  # lateness: slow\n",
    "timing.lateness = 0.2  # was 0.15\ntiming.write.turnaround = 0.001\n",
    '[nodes.winder.timing]\n"lateness" = 0.2\n\n# by a scope\nread = { nominal=0.01,lateness =0.3 }\n',
    "[protocols.hcp2.timing]\nlateness = 0.2\n[protocols.hcp2.timing.read]\nbyte_gap = 0.02\n",
)


def renamed(text: str) -> str:
    return migrated(Source("line.toml", text))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_a_file_of_today_stays_as_it_is(path: Path) -> None:
    assert renamed(path.read_text()) == path.read_text()


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("timed", TIMED)
def test_keys_get_their_new_names_wherever_reply_times_stand(timed: str, end: str, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    new = renamed((HEAD + timed).replace("\n", end))
    assert [line.partition("#")[2] for line in new.splitlines()] == [
        line.partition("#")[2] for line in (HEAD + timed).splitlines()
    ]
    path.write_bytes(new.encode())
    load(path)  # which refuses an old name


def test_nothing_else_of_that_name_is_touched() -> None:
    text = (
        HEAD
        + '[nodes.winder.points]\nlateness = { item = "1" }\nturnaround = { item = "2", unit = "lateness" }\n'
        + '[nodes.timing]\nprotocol = "hcp2"\naddress = 6\npoints.lateness = { item = "1" }\n'
        + "[groups.nominal]\nperiod = 1\npoints = ['winder/lateness']\n"
    )
    assert renamed(text) == text


def test_a_key_under_both_names_is_an_error_with_its_line() -> None:
    with pytest.raises(FileError, match=r"line.toml:6: nodes.winder.timing.lateness: is also there under its new name"):
        renamed(f"{HEAD}timing.max_reply_delay = 0.2\ntiming.lateness = 0.3\n")
