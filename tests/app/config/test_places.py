"""Where each value of a TOML file stands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from busmaster.app.config.source import FileError, Key, Source, places

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))

TEXT = '''# a comment with [brackets] and key = "value"
title = "a # in a text" # and one after it
[port]
path = '/dev/tty[0]'
"quoted = key" = 1
[nodes.winder]
points.position = { item = "axis0.position", scale = { factor = 0.001 } }
[groups]
axes.points = [   # a list over several lines
    "a/1", "a/2",

    [ "deeper",
      "list" ],
]
text = """
several
[lines] = 1"""
after = 1.5
[[array]]
first = 1
[[array]]
second = [{ one = 1 }, { two = 2 }]
[array.inner]
third = 2024-01-01 10:00:00
'''


@pytest.mark.parametrize(
    ("key", "line"),
    [
        (("title",), 2),
        (("port",), 3),
        (("port", "path"), 4),
        (("port", "quoted = key"), 5),
        (("nodes", "winder"), 6),
        (("nodes", "winder", "points", "position"), 7),
        (("nodes", "winder", "points", "position", "scale", "factor"), 7),
        (("groups", "axes", "points"), 9),
        (("groups", "axes", "points", 0), 10),
        (("groups", "axes", "points", 1), 10),
        (("groups", "axes", "points", 2), 12),
        (("groups", "axes", "points", 2, 1), 13),
        (("groups", "text"), 15),
        (("groups", "after"), 18),
        (("array", 0, "first"), 20),
        (("array", 1), 21),
        (("array", 1, "second", 1, "two"), 22),
        (("array", 1, "inner", "third"), 24),
    ],
)
def test_each_value_is_found_on_its_line(key: Key, line: int) -> None:
    assert places(TEXT)[key] == line
    assert Source("line.toml", TEXT).line(key) == line


def test_what_is_not_there_is_looked_for_where_it_would_be() -> None:
    assert Source("line.toml", TEXT).line(("port", "baudrate")) == 3
    assert Source("line.toml", TEXT).line(("none", "such")) == 1


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_every_value_of_the_examples_has_a_place_on_a_line_that_names_it(path: Path) -> None:
    source = Source.read(path)
    lines = path.read_text().splitlines()
    found = places(path.read_text())

    def look(key: Key, value: Any) -> None:
        if key:
            name = str(value) if isinstance(key[-1], int) else str(key[-1])
            assert name in lines[found[key] - 1]
        for inner, below in value.items() if isinstance(value, dict) else ():
            look((*key, inner), below)
        for number, below in enumerate(value) if isinstance(value, list) and isinstance(value[0], str) else ():
            look((*key, number), below)

    look((), source.data)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a = 1\nb 2\n", "x.toml:2: not valid TOML: expected '=' after a key"),
        ("a = 1\na = 2\n", "x.toml:2: not valid TOML: cannot overwrite a value"),
        ('a = 1\n\nb = "no end', "x.toml:3: not valid TOML: unterminated string"),
        ("a = 1\r\n\r\nb = [1,\r\n", "x.toml:3: not valid TOML: invalid value"),
        ("a = [", "x.toml:1: not valid TOML: invalid value"),
        ('a = "1\u2028\x85" # \u2029\nb = "no end', "x.toml:2: not valid TOML: unterminated string"),
    ],
)
def test_what_is_no_toml_is_said_with_its_line(text: str, complaint: str) -> None:
    with pytest.raises(FileError) as caught:
        Source("x.toml", text)
    assert str(caught.value).startswith(complaint)


def test_a_file_that_is_not_utf_8_is_said_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_bytes(b"a = 1\nb = '\xff'\n")
    with pytest.raises(FileError, match=r"line\.toml:2: .*UTF-8"):
        Source.read(path)
