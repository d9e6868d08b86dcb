"""What `from busmaster import ...` gives: sorted, whole, documented, and cheap to import."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import busmaster
from busmaster import Bus, Hcp2Controller, MemoryPort, MentorDrive, ModbusUnit, MscController, errors
from busmaster.bus.handle import Handle
from busmaster.contract.renames import ROOT as MOVED
from busmaster.emulator.line import Line
from tests.patience import PATIENCE

OPTIONAL = ("click", "rich", "textual", "aiomqtt", "prometheus_client", "matplotlib", "msgspec", "websockets")

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "public-api.md"
PUBLIC = re.findall(r"^\| `(busmaster\.[\w.]+)` \|", PAGE.read_text(), re.MULTILINE)


def order(name: str) -> tuple[object, ...]:
    """Constants, then classes, then functions, as the linter sorts them: sum8 before sum16."""
    parts = [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
    return not name.isupper(), not name[0].isupper(), *parts


def test_the_public_names_are_sorted_and_each_once() -> None:
    assert list(busmaster.__all__) == sorted(set(busmaster.__all__), key=order)


@pytest.mark.parametrize("name", busmaster.__all__)
def test_a_public_name_exists_and_has_a_docstring_of_its_own(name: str) -> None:
    thing = getattr(busmaster, name)
    if isinstance(thing, type) or inspect.isroutine(thing):
        documentation = inspect.getdoc(thing) or ""
        assert documentation.strip(), f"{name} has no docstring"
        assert not documentation.startswith(f"{name}("), f"{name} has only the one that a dataclass makes"


@pytest.mark.parametrize("name", busmaster.__all__)
def test_whatever_a_public_class_offers_says_what_it_is(name: str) -> None:
    thing = getattr(busmaster, name)
    if isinstance(thing, type) and thing.__module__.startswith("busmaster"):
        offered = [each for each, member in vars(thing).items() if each[0] != "_" and is_called_or_asked(member)]
        assert [each for each in offered if not inspect.getdoc(getattr(thing, each))] == []


def is_called_or_asked(member: object) -> bool:
    """Whether it is a method or a property: what a field is, the docstring of its class says."""
    return isinstance(member, property | classmethod | staticmethod) or inspect.isfunction(member)


def test_dir_lists_every_public_name_before_it_is_imported() -> None:
    code = "import busmaster; print(*dir(busmaster))"
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE, capture_output=True, text=True)
    listed = {name for name in done.stdout.split() if not name.startswith("__")}
    assert listed == set(busmaster.__all__)


@pytest.mark.parametrize(("old", "now"), MOVED.items())
def test_a_name_that_has_moved_says_where_it_is(old: str, now: tuple[str, str]) -> None:
    module, new = now
    assert new in importlib.import_module(module).__all__
    assert module in PUBLIC
    with pytest.raises(ImportError, match=f"from {module} import {new}"):
        exec(f"from busmaster import {old}")
    with pytest.raises(ImportError, match=f"from {module} import {new}"):
        getattr(busmaster, old)


def test_a_name_that_never_was_is_no_attribute() -> None:
    assert not hasattr(busmaster, "Buss")


def test_every_error_is_public() -> None:
    defined = {
        name
        for name, thing in vars(errors).items()
        if isinstance(thing, type) and issubclass(thing, Exception) and thing.__module__ == errors.__name__
    }
    assert defined <= set(busmaster.__all__)


def test_what_the_root_offers_comes_from_the_package() -> None:
    for name in busmaster.__all__:
        thing = getattr(busmaster, name)
        if isinstance(thing, ModuleType):
            assert thing.__name__.startswith("busmaster.")
        elif isinstance(thing, type) or inspect.isroutine(thing):
            assert thing.__module__.split(".")[0] in ("busmaster", "typing"), name


def test_public_annotations_resolve() -> None:
    for name in busmaster.__all__:
        thing = getattr(busmaster, name)
        if inspect.isroutine(thing):
            assert typing.get_type_hints(thing), name


def test_importing_it_needs_no_extra() -> None:
    """With the extras hidden from it, the package imports and its names are there."""
    hide = f"import sys; sys.modules.update(dict.fromkeys({OPTIONAL!r}))"
    code = f"{hide}; import busmaster; [getattr(busmaster, name) for name in busmaster.__all__]"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE)


@pytest.mark.parametrize(
    ("what", "unneeded"),
    [
        ("import busmaster", r"busmaster\.(emulator|protocols|registry|config|cli)\b|msgspec\b"),
        ("from busmaster.app.cli import main; main(['--help'])", r"rich\b|textual\b"),
    ],
)
def test_what_is_not_needed_is_not_loaded(what: str, unneeded: str) -> None:
    code = f"import sys; {what}; print('loaded:', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE, capture_output=True, text=True)
    loaded = done.stdout.rpartition("loaded:")[2].split()
    assert "busmaster" in loaded
    assert [name for name in loaded if re.match(unneeded, name)] == []


def test_the_command_line_without_its_extra_says_which_one_to_install() -> None:
    code = (
        "import importlib.util as u, sys; find = u.find_spec; "
        "u.find_spec = lambda name, *rest: None if name in ('click', 'rich') else find(name, *rest); "
        "from busmaster.app.cli import main; sys.exit(main(['--help']))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        "busmaster: the command line needs click, rich; install the extra cli: pip install 'busmaster[cli]'\n"
    )


OUTSIDERS = sorted(
    path
    for folder in ("busmaster/protocols", "examples", "tests/registry/installed")
    for path in (ROOT / folder).rglob("*.py")
)
"""What an author outside could have written: it gets along with what is public."""


def imported(path: Path) -> Iterator[tuple[str, str]]:
    """The modules of the package that a file imports names from, and these names; not those of protocols."""
    for node in ast.walk(ast.parse(path.read_text())):
        module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
        if isinstance(node, ast.ImportFrom) and module.startswith("busmaster") and ".protocols" not in module:
            yield from ((module, alias.name) for alias in node.names)


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_module_says_what_it_offers(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__doc__
    assert list(module.__all__) == sorted(set(module.__all__), key=order)
    assert all(hasattr(module, offered) for offered in module.__all__)
    assert not any(offered.startswith("_") for offered in module.__all__)


@pytest.mark.parametrize("path", OUTSIDERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_protocols_and_examples_use_only_what_is_public(path: Path) -> None:
    for module, name in imported(path):
        assert module in ("busmaster", *PUBLIC), f"{path.name} imports from {module}, which is not public"
        assert name in importlib.import_module(module).__all__, (
            f"{path.name} imports {module}.{name}, which is not public"
        )


SHOWN = {
    "bus": """alarms as_of_now condition endpoint events group groups latest node nodes now plan poll_group
        reset_statistics running state statistics wall_time worst_case_wait""",
    "node": """address check exclusive health label latest lift limit limits line merge_reads note_stop now of on_return
        planned probe profile request statistics stops suspend suspended timed_request timings use_sync_reads""",
    "handle": """bus differences exclusive in_operation items node parameters point prepare_load profile read
        save_parameters use_sync_reads write""",
    "controller": "axis element elements execute io named",
    "drive": "write_all",
    "unit": "",
    "msc": """address_step clear_flag find_address_step flag flags load_cam model set_flag status symbols
        write_block""",
}
"""What users need; what the program `busmaster` needs beside it is in `busmaster.ext`."""


def test_the_objects_of_a_user_show_what_users_need_and_nothing_else() -> None:
    def shown(thing: object) -> set[str]:
        return {name for name in dir(thing) if not name.startswith("_")}

    def own(kind: type[Handle]) -> set[str]:
        bus = Bus(MemoryPort(Line(kind.profile.line)))
        return shown(kind(bus, 14)) - set(SHOWN["handle"].split())

    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    assert shown(bus) == set(SHOWN["bus"].split())
    assert shown(Hcp2Controller(bus, 5).node) == set(SHOWN["node"].split())
    assert own(Hcp2Controller) == set(SHOWN["controller"].split())
    assert own(MentorDrive) == set(SHOWN["drive"].split())
    assert own(ModbusUnit) == set(SHOWN["unit"].split())
    assert own(MscController) == set(SHOWN["msc"].split())
