"""Tables from a file: `busmaster write ITEM=@FILE`; what is wrong with one is named before anything is sent."""

from __future__ import annotations

from pathlib import Path

import pytest

from busmaster.app.cli.parsing import numbers_of_file
from busmaster.errors import InvalidCommand
from tests.app.cli.conftest import Command, serve

NOBODY = "socket://127.0.0.1:1"
CAM = [value * value % 1000 - 500 for value in range(100)]
FILE = """
port = "PORT"
[nodes.press]
protocol = "msc"
address = 3
address_step = 4
timing = { window = 1.0 }
points.cam = { item = "3000:100", unit = "mm", factor = 0.1 }
"""


@pytest.mark.slow
def test_a_cam_table_is_written_verified_and_read_back(busmaster: Command, tmp_path: Path) -> None:
    cam = tmp_path / "cam.csv"
    cam.write_text("# position\n" + "".join(f"{value}\n" for value in CAM))
    with serve("msc", 3) as server:
        msc = (server.path, "--protocol", "msc", "--node", "3", "--address-step", "4", "--timeout", "1000")
        ran = busmaster("write", *msc, f"3000:100=@{cam}", "--verify")
        assert (ran.status, ran.out, ran.err) == (0, "3000:100 ok\n", "")
        read = busmaster("read", *msc, "3000:100")
        assert [int(line.split()[1]) for line in read.lines] == CAM


@pytest.mark.slow
def test_a_table_of_a_point_is_in_its_unit(busmaster: Command, tmp_path: Path) -> None:
    (tmp_path / "cam.csv").write_text(" ".join(f"{value / 10:g}" for value in CAM))
    with serve("msc", 3) as server:
        path = tmp_path / "line.toml"
        path.write_text(FILE.replace("PORT", server.path))
        ran = busmaster("write", str(path), f"press/cam=@{tmp_path}/cam.csv")
        assert (ran.status, ran.out, ran.err) == (0, "press/cam ok\n", "")
        msc = (server.path, "--protocol", "msc", "--node", "3", "--address-step", "4", "--timeout", "1000")
        assert [int(line.split()[1]) for line in busmaster("read", *msc, "3000:100").lines] == CAM


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("1\n2\n\n3\n", (1, 2, 3)),
        ("\ufeff1, 2,3\r\n-4.5,1e3\r\n", (1, 2, 3, -4.5, 1000.0)),
        ("1;2;3", (1, 2, 3)),
        ("  # angle\tmm\n1\t2 3\n", (1, 2, 3)),
        ("0x10", (16,)),
    ],
)
def test_numbers_are_read_line_by_line(tmp_path: Path, text: str, numbers: tuple[float, ...]) -> None:
    path = tmp_path / "cam.csv"
    path.write_text(text, encoding="utf-8")
    assert numbers_of_file(str(path)) == numbers


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"1\nposition\n", r"cam\.csv:2: 'position' is not a number"),
        (b"1,2\n3,,4\n", r"cam\.csv:2: '' is not a number"),
        (b"1,2,\n", r"cam\.csv:1: '' is not a number"),
        (b"1,5;2,5\n", r"cam\.csv:1: it has commas and semicolons"),
        (b"1\n2\nnan\n", r"cam\.csv:3: nan is not a finite number"),
        (b"# nothing\n\n", r"cam\.csv: there is no number in it"),
        (b"\xff\xfe1\x00", r"cam\.csv: it is not a text file in UTF-8"),
    ],
)
def test_what_is_no_number_is_named_with_its_line(tmp_path: Path, data: bytes, complaint: str) -> None:
    path = tmp_path / "cam.csv"
    path.write_bytes(data)
    with pytest.raises(InvalidCommand, match=complaint):
        numbers_of_file(str(path))


@pytest.mark.parametrize(
    ("protocol", "assignment", "complaint"),
    [
        ("msc", "3000:4=@FOLDER/three", "3000:4 takes 4 values; FOLDER/three has 3"),
        ("msc", "3000:2=@FOLDER/three", "3000:2 takes 2 values; FOLDER/three has 3"),
        ("msc", "3000:3=@FOLDER/none", "FOLDER/none: No such file or directory"),
        ("msc", "3000:3=@FOLDER", "FOLDER: Is a directory"),
        ("msc", "3000:3=@", "No such file or directory"),
        ("msc", "3000:3=@FOLDER/half", "0.5"),
        ("mentor", "1.17:2=@FOLDER/three", "1.17:2 takes 2 values; FOLDER/three has 3"),
        ("mentor", "1.17:2=1,2,3", "1.17:2 takes 2 values, not 3"),
        ("modbus", "holding:10:4=@FOLDER/three", "holding:10:4 takes 4 values; FOLDER/three has 3"),
    ],
)
def test_a_table_that_does_not_fit_is_refused_and_nothing_is_sent(
    busmaster: Command, tmp_path: Path, protocol: str, assignment: str, complaint: str
) -> None:
    """Even what stands before it on the command line: nobody listens on this port."""
    (tmp_path / "three").write_text("1\n2\n3\n")
    (tmp_path / "half").write_text("1\n2\n0.5\n")
    said = assignment.replace("FOLDER", str(tmp_path))
    good = {"msc": "2008=1", "mentor": "1.10=1", "modbus": "holding:1=1"}[protocol]
    step = ("--address-step", "4") * (protocol == "msc")
    ran = busmaster("write", NOBODY, "--protocol", protocol, "--node", "12", *step, good, said)
    assert (ran.status, ran.out) == (2, "")
    assert complaint.replace("FOLDER", str(tmp_path)) in ran.err


def test_a_table_that_does_not_fit_a_point_is_refused(busmaster: Command, tmp_path: Path) -> None:
    (tmp_path / "three").write_text("1\n2\n3\n")
    path = tmp_path / "line.toml"
    path.write_text(FILE.replace("PORT", NOBODY))
    ran = busmaster("write", str(path), f"press/cam=@{tmp_path}/three")
    assert (ran.status, ran.out) == (2, "")
    assert f"press/cam takes 100 values; {tmp_path}/three has 3" in ran.err
