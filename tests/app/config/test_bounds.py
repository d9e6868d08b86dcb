"""What a file may say at most: refused with its line before it costs time or memory."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from busmaster.app import bounds
from busmaster.app.config import LineFile
from busmaster.app.config.names import expanded
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.app.config.table import Table
from busmaster.app.line import ConfiguredLine
from busmaster.errors import InvalidCommand
from busmaster.transport.files import read_file

TEXT = """port = "socket://127.0.0.1:9"
[nodes.d1-9]
protocol = "hcp2"
address = "1-9"
[groups.g]
period = 1
points = ["d1-9/1"]
"""


def test_a_number_may_be_either_of_its_limits_and_none_beyond() -> None:
    table = Table(Source("line.toml", "low = 2\nhigh = 5\nbelow = 1\nabove = 6\n"))
    for read_number in (table.whole, table.seconds):
        assert [read_number(key, least=2, most=5) for key in ("low", "high")] == [2, 5]
        for key in ("below", "above"):
            with pytest.raises(FileError, match=f"{key}: must be .*2 to 5, not {table.data[key]}"):
                read_number(key, least=2, most=5)


def parsed(text: str) -> LineFile:
    return read(Source("line.toml", text))


DEEP = bounds.MOST_NESTED + 1


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"a = {'[' * 100_000}", "line.toml:1: nested more than 16 levels deep"),
        (f"\na = {'[' * DEEP}{']' * DEEP}", "line.toml:2: nested more than 16 levels deep"),
        (f"a = {'{a = ' * DEEP}1{'}' * DEEP}", "line.toml:1: nested"),
        (f"\n\n{'a.' * 200_000}a = 1", "line.toml:3: nested"),
        (f"[{'a.' * DEEP}a]", "line.toml:1: nested"),
        (f"a = {{ {' . '.join('a' * DEEP)} = 1 }}", "line.toml:1: nested"),
        (f"a = {'9' * 100_000}", "line.toml:1: a number or a key must have at most 200 characters, not 100000"),
        (f"a = 0x{'f' * 100_000}", "line.toml:1: a number or a key must have at most 200 characters"),
        (f"{'a' * 201} = 1", "line.toml:1: a number or a key must have at most 200 characters"),
        (f"a = '''{'x' * 100_000}'''", "line.toml:1: a text must have at most 32768 characters, not 100006"),
    ],
)
def test_what_is_too_deep_or_too_long_is_refused_with_its_line(text: str, complaint: str) -> None:
    with pytest.raises(FileError) as caught:
        Source("line.toml", text)
    assert str(caught.value).startswith(complaint)


def test_the_line_of_what_is_too_long_counts_those_of_texts_before_it() -> None:
    with pytest.raises(FileError, match=r"^line\.toml:5: a number or a key must have at most"):
        Source("line.toml", f'a = """\n\n"""\n\n{(bounds.LONGEST_WORD + 1) * "x"} = 1\n')


def test_what_is_just_within_the_bounds_is_read_even_from_a_deep_stack() -> None:
    deep, names = "[" * bounds.MOST_NESTED + "]" * bounds.MOST_NESTED, ".".join("a" * bounds.MOST_NESTED)
    text = f'a = {deep}\nb.{names[2:]} = 1\nc = "{"x" * (bounds.LONGEST_TEXT - 2)}"\nd = 1{"0" * 199}\n# {"[" * 999}\n'

    def read_at(depth: int) -> Source:
        return Source("line.toml", text) if depth == 0 else read_at(depth - 1)

    depth = 0  # where this test stands: the reader gets half of the stack
    frame = sys._getframe()
    while frame.f_back is not None:
        frame, depth = frame.f_back, depth + 1
    source = read_at(sys.getrecursionlimit() // 2 - depth)
    assert source.line(("b", *"a" * (bounds.MOST_NESTED - 1))) == 2
    assert source.data["d"] == 10**199


def test_brackets_in_texts_and_comments_do_not_count() -> None:
    text = (
        f'a = "{"[" * 99}"\nb = \'{"{" * 99}\'\n# {"[" * 99}\nc = """{"[" * 99}"""\nd = [1, 2]\n' + "e = [[1], [2]]\n"
    )
    assert Source("line.toml", text).data["e"] == [[1], [2]]


def test_ranges_multiply_and_stand_for_a_thousand_names_at_most() -> None:
    assert len(list(expanded("a1-10b1-10c1-10"))) == 1000
    assert list(expanded("a08-10b3-2c".replace("3-2", "2-3"))) == [
        *("a08b2c", "a08b3c", "a09b2c", "a09b3c", "a10b2c", "a10b3c"),
    ]
    for name in ("a1-99b1-99c1-99", "a1-10b1-10c1-11", "a1-1001", f"a{'1-1b' * 8000}1-1001"):
        with pytest.raises(InvalidCommand, match=r"too many|more than 1000 names"):
            next(expanded(name))
    assert list(expanded(f"a{10**19}-{10**19 + 1}")) == [f"a{10**19}", f"a{10**19 + 1}"]
    with pytest.raises(InvalidCommand, match="at most 20 digits"):
        next(expanded(f"a1-{'9' * 5000}"))
    assert len(next(expanded("1-1b" * 8000))) == 2 * 8000


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("period = 1\n", "period = 1e308\n", "groups.g.period: must be a number of seconds, 0 to 86400"),
        ("period = 1\n", "period = 86401\n", "groups.g.period: must be a number of seconds, 0 to 86400"),
        ("period = 1\n", "period = 1\nphase = 1e308\n", "groups.g.phase: must be a number of seconds, 0 to 86400"),
        ("[nodes.d1-9]\n", "[nodes.d1-9]\nreply_time = 1e308\n", "reply_time: must be a number of seconds, 0 to 10"),
        ("port", f'title = "{"x" * 201}"\nport', "title: must have at most 200 characters, not 201"),
    ],
)
def test_times_and_titles_are_bounded(old: str, new: str, complaint: str) -> None:
    parsed(TEXT)
    with pytest.raises(FileError) as caught:
        parsed(TEXT.replace(old, new))
    assert complaint in str(caught.value)


def test_a_line_has_twenty_thousand_points_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.line.configured_line.MOST_MEMBERS", 20)
    text = TEXT.replace('"d1-9/1"]', '"d1-9/1", "d1-9/2"]')
    ConfiguredLine(parsed(text), outputs=False)
    ConfiguredLine(parsed(text.replace('"d1-9/2"]', '"d1-9/2", "d1-2/3"]')), outputs=False)
    for more in (
        text.replace('"d1-9/2"]', '"d1-9/2", "d1-3/3"]'),
        f'{text}[groups.h]\nperiod = 1\npoints = "d1-3/3"\n',
    ):
        with pytest.raises(FileError, match=r"groups\.[gh]\.points: the groups have more than 20 points"):
            ConfiguredLine(parsed(more), outputs=False)
    with pytest.raises(FileError, match=r"groups\.g\.points\[1\]: 'd1-9/1,2,3' expands to more than 20 points"):
        ConfiguredLine(parsed(TEXT.replace("d1-9/1", "d1-9/1,2,3")), outputs=False)
    assert len(ConfiguredLine(parsed(TEXT.replace("d1-9/1", "d1-2/1-10")), outputs=False).members("g")) == 20


def test_only_regular_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"1234")
    assert read_file(path, 4) == b"1234"
    with pytest.raises(OSError, match="it has more than 3 bytes"):
        read_file(path, 3)
    os.mkfifo(tmp_path / "fifo")
    for name in (tmp_path / "fifo", "/dev/zero"):
        with pytest.raises(OSError, match="it is a FIFO, a socket or a device"):
            read_file(name)
    with pytest.raises(IsADirectoryError):
        read_file(tmp_path)
