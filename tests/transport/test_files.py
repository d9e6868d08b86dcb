"""Files that are made: by one function, for their owner and group."""

from __future__ import annotations

import ast
import errno
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.app.outputs.growing_file import GrowingFile
from busmaster.app.outputs.spool import Spool
from busmaster.capture.files import CaptureFiles
from busmaster.transport.files import FOLDER_MODE, check_regular, open_file, read_file

PACKAGE = Path(__file__).parents[2] / "busmaster"
FOR_ALL_TO_READ = {"app/service/folder.py"}
"""Say who owns a line, to whoever wants to know."""


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o002)
    yield
    os.umask(before)


def mode_of(path: Path) -> str:
    return oct(stat.S_IMODE(path.stat().st_mode))


@pytest.mark.usefixtures("umask")
def test_files_are_for_their_owner_and_group(tmp_path: Path) -> None:
    capture = CaptureFiles(tmp_path / "line.pcapng")
    capture.begin_next()
    capture.close()
    GrowingFile(str(tmp_path / "line.csv")).append(b"1\n")
    Spool(str(tmp_path / "spool"), 10, "csv").close()
    Spool(str(tmp_path / "secret"), 10, "csv", mode=0o600).close()
    found = {path.name: mode_of(path) for path in tmp_path.iterdir()}
    assert found.pop("secret") == "0o600"
    assert found == dict.fromkeys(("line.pcapng", "line-2.pcapng", "line.csv", "spool"), "0o640")


def test_the_umask_narrows_the_mode(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        os.close(open_file(str(tmp_path / "new"), os.O_WRONLY))
    finally:
        os.umask(before)
    assert mode_of(tmp_path / "new") == "0o600"


def makes_files(source: str) -> list[int]:
    """The lines that make a file in another way than by `open_file`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and node.attr in ("O_CREAT", "write_text", "write_bytes", "touch", "mknod"):
            found.append(node.lineno)
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("open", "io.open", "io.FileIO", "os.fdopen"):
            [first, *rest] = node.args
            by_name = not (isinstance(first, ast.Call) or ast.unparse(first) in ("os.devnull", "descriptor"))
            modes = [*rest[:1], *(keyword.value for keyword in node.keywords if keyword.arg == "mode")]
            if by_name and any(set(ast.unparse(mode).strip("\"'")) & set("wax") for mode in modes):
                found.append(node.lineno)
    return found


def test_the_check_sees_each_way_of_making_a_file() -> None:
    assert makes_files('open(path, "w")\nopen(path, mode="ab")\nio.FileIO(path, "xb")\nos.open(path, os.O_CREAT)') == [
        *(1, 2, 3, 4)
    ]
    assert makes_files('open(path)\nopen(path, "r+b")\nopen(open_file(path, flags), "w")') == []


def test_no_file_is_made_in_another_way() -> None:
    found = {str(path.relative_to(PACKAGE)): makes_files(path.read_text()) for path in PACKAGE.rglob("*.py")}
    assert {name for name, lines in found.items() if lines} == {"transport/files.py"} | FOR_ALL_TO_READ


def test_a_file_of_the_largest_size_is_read_and_a_larger_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "list"
    path.write_bytes(b"12345")
    assert read_file(path, 5) == read_file(str(path)) == b"12345"
    with pytest.raises(OSError, match="it has more than 4 bytes, which is the bound for such a file") as refused:
        read_file(path, 4)
    assert (refused.value.errno, refused.value.filename) == (errno.EFBIG, str(path))


def test_what_is_not_a_regular_file_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    descriptors = os.listdir("/proc/self/fd")
    for path, number in (
        (tmp_path / "fifo", errno.EINVAL),
        (Path("/dev/zero"), errno.EINVAL),
        (tmp_path, errno.EISDIR),
    ):
        with pytest.raises(OSError, match=re.escape(str(path))) as refused:
            read_file(path)
        assert (refused.value.errno, refused.value.filename) == (number, str(path))
    assert os.listdir("/proc/self/fd") == descriptors
    with pytest.raises(IsADirectoryError):
        check_regular(tmp_path.stat(), "folder")
    with pytest.raises(FileNotFoundError):
        read_file(tmp_path / "none")


def test_a_descriptor_of_a_file_is_not_inherited_and_no_content_is_lost_by_opening(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    path.write_bytes(b"old")
    descriptor = open_file(str(path), os.O_WRONLY | os.O_APPEND)
    try:
        assert not os.get_inheritable(descriptor)
        os.write(descriptor, b" and new")
    finally:
        os.close(descriptor)
    assert path.read_bytes() == b"old and new"
    assert oct(FOLDER_MODE) == "0o750"
