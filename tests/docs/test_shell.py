"""What runs the commands of a page can fail: it compares output, statuses and marks."""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import mkdtemp

import pytest

from tests.docs import pages
from tests.docs.pages import blocks, parts
from tests.docs.shell import Replacing, Shell, commands, pattern_of, tidy


@pytest.mark.parametrize(
    ("shown", "output", "vary", "alike"),
    [
        ("1  12.5\n", "1 12.5\n", False, True),
        ("1 12.5\n", "1 12.6\n", False, False),
        ("1 12.5 mm\n", "1 -0.25 mm\n", True, True),
        ("1 12.5 mm\n", "1 12.5 m\n", True, False),
        ("2026-01-02T03:04:05.678Z\n", "2026-11-22T13:14:15.000Z\n", True, True),
        ("a ... c\n", "a b b c\n", False, True),
        ("a\n...\nd\n", "a\nb\nc\nd\n", False, True),
        ("a\n...\nd\n", "a\nd\n", False, True),
        ("a\n...\nd\n", "a\nb\n", False, False),
        ("a.c\n", "abc\n", False, False),
        ("a\n", "a\nb\n", False, False),
    ],
)
def test_output_has_the_words_shown_and_anything_for_dots_and_other_numbers_where_they_vary(
    shown: str, output: str, vary: bool, alike: bool
) -> None:
    assert (re.fullmatch(pattern_of(shown, vary), tidy(output)) is not None) is alike


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    return tmp_path / "page.md"


def run(page: Path, text: str) -> None:
    page.write_text(f"# Page\n\n{text}")
    parts.cache_clear()
    with Shell(Path(mkdtemp(dir=page.parent))) as shell:
        for block in blocks(page):
            for command in commands(block):
                shell.run(command)
        shell.check_status("the end")


def test_commands_run_in_their_order_in_one_folder(page: Path) -> None:
    run(page, "```sh\necho one >file  # a remark\n```\n\n```console\n$ cat file \\\n    file\none\none\n$ echo\n```\n")


def test_other_output_fails(page: Path) -> None:
    with pytest.raises(AssertionError, match=r"page.md:4: echo two\nis to say\none\n\nbut says\ntwo"):
        run(page, "```console\n$ echo two\none\n```\n")


def test_a_failing_command_fails_unless_its_status_is_shown(page: Path) -> None:
    run(page, "```console\n$ exit 3\n$ echo $?\n3\n```\n")
    for text in ("$ exit 3\n", "$ exit 3\n$ echo\n", "$ exit 3\n$ echo $?\n2\n"):
        with pytest.raises(AssertionError, match=r"exit status 3|is to say"):
            run(page, f"```console\n{text}```\n")


PROGRAM = "import signal; signal.signal(2, lambda *_: exit(print('ended'))); print('begun'); signal.pause()"
GOES_ON = f'python -c "{PROGRAM}" '


def test_what_goes_on_is_waited_for_and_ended_by_ctrl_c(page: Path) -> None:
    run(page, f"```console\n$ {GOES_ON}&\nbegun\n$ {GOES_ON}\nbegun\n^C\nended\n```\n")
    run(page, f"<!-- goes on -->\n```sh\n{GOES_ON}\n```\n")
    with pytest.raises(AssertionError, match="is to say\nelse"):
        run(page, "<!-- goes on -->\n```console\n$ echo something\nelse\n```\n")


def test_an_unknown_mark_and_a_block_without_an_end_are_errors(page: Path) -> None:
    with pytest.raises(ValueError, match=r"page.md:3: no test knows the mark 'not run: no reason'"):
        run(page, "<!-- not run: no reason -->\n")
    with pytest.raises(ValueError, match=r"page.md:3: a block without an end"):
        run(page, "```sh\n")


def test_addresses_and_devices_of_a_page_stand_for_others_while_it_runs(tmp_path: Path) -> None:
    replace = Replacing()
    replace.device("/dev/ttyUSB0", tmp_path / "line")
    text = "/dev/ttyUSB0?baudrate=9600 /dev/ttyUSB01 127.0.0.1:5020 localhost:5020\nport = 9464\n"
    real = replace.real(text)
    assert real.startswith(f"{tmp_path / 'line'}?baudrate=9600 /dev/ttyUSB01 127.0.0.1:")
    assert "5020" not in real
    assert "9464" not in real
    assert replace.shown(real) == text
