"""The measures count what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.verification.measures import HERE, circles, main, structure, ways


@pytest.fixture
def root(tmp_path: Path) -> Path:
    files = {
        "__init__.py": '"""Root."""\n__all__ = ["A", "B"]\n',
        "wire/__init__.py": "",
        "wire/bytes.py": '"""Bytes."""\nX = 1\n',
        "bus/__init__.py": "",
        "bus/bus.py": 'def f():\n    """Doc."""\n    from busmaster.wire import bytes\n    return bytes.X\n',
        "service/one.py": "from busmaster.wire.bytes import X\nfrom busmaster.bus.bus import f\n",
    }
    for name, text in files.items():
        path = tmp_path / "busmaster" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_structure_of_a_small_package(root: Path) -> None:
    found = structure(root)
    assert found["rooms"] == 4
    assert found["arrows between rooms"] == 3
    assert found["circles of rooms"] == 0
    assert found["arrows upward, from the library into the application"] == 0
    assert found["root names"] == 2
    assert found["names"]["library modules that the application imports"] == ["bus.bus", "wire.bytes"]
    assert found["names"]["modules with one importer"] == ["bus.bus"]
    assert found["statements of bus"] == 3  # the function, its import and its return, not its docstring


COMMENTED = '''"""A docstring
of two lines."""

# A comment of two
# lines.
X = """A text
of two lines, # not a comment
"""  # after code
"""The docstring of X."""


def f():  # type: ignore[no-untyped-def]
    """Doc."""

    return X  # noqa: B000
'''


def test_comments_are_counted_per_100_lines_of_code(root: Path) -> None:
    (root / "busmaster" / "wire" / "bytes.py").write_text(COMMENTED)
    found = structure(root)
    assert found["comment lines per 100 lines of wire"] == 60.0  # 3 of 5: X has three lines, f two
    assert found["comment lines per 100 lines of bus"] == 0.0
    assert found["comment lines per 100 lines of code"] == pytest.approx(100 * 3 / (5 + 1 + 3 + 2), abs=0.05)


def test_an_import_of_the_application_by_the_library_is_an_arrow_upward(root: Path) -> None:
    (root / "busmaster" / "wire" / "bytes.py").write_text("from busmaster.service import one\n")
    found = structure(root)
    assert found["arrows upward, from the library into the application"] == 1
    assert found["names"]["circles of rooms"] == [["bus", "service", "wire"]]


def test_circles_are_found_by_way_of_others() -> None:
    assert circles({("a", "b"), ("b", "c"), ("c", "a"), ("c", "d")}) == [{"a", "b", "c"}]


@pytest.mark.slow
def test_the_ways_pass_what_every_request_passes() -> None:
    """A trace that sees nothing, or only one side, would be small, and nobody would wonder."""
    found = ways(HERE)
    names = found["names"]
    assert any(name.startswith("transport/pump.py") for name in names["local read: functions"])
    assert any("codec.py" in name for name in names["local read: functions"])
    assert not any("emulator/" in name or "mint.py" in name for name in names["local read: functions"])
    assert any(
        name.startswith("app/service/authorisation.py") for name in names["remote write: functions of the owner"]
    )
    assert found["remote write: functions of the owner"] < found["remote write: functions"]
    assert "Authorisation" in names["remote write: objects of the owner"]


def test_a_revision_that_does_not_exist_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.verification.measures.measured", lambda root: {})
    with pytest.raises(SystemExit, match="no-such-revision"):
        main(["--against", "no-such-revision"])
