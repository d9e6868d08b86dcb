"""Measures of the structure: rooms, imports between them, public names, comments, and the length of a request's way.

They are the targets of the design for version 0.3. They report and gate nothing: the tests gate what must hold.

    python -m tests.verification.measures                   # a table
    python -m tests.verification.measures --against REV     # and the same of another revision, beside it
    python -m tests.verification.measures --json

How each is counted:

- A room is a package or module directly below `busmaster/`, the root (`__init__`) and `__main__` too. The folder of the
  benchmarks is one, and so is a folder with code in another language. A module that imports nothing of the package and
  is not imported is none: an old name, whose import is an error. These are the rooms of the design, which has 25 of
  them and 129 arrows for e1884e4. The statements and comments of the application are reported by its packages, and so
  are the arrows in a second count, without the benchmarks.
- An arrow goes from one room to another that it imports anything from, for types and in functions too.
- A circle is a set of rooms that import each other, directly or by way of others. An arrow goes upward if it goes from
  the library into the application; those of the root's lazy names are not counted.
- Statements are those of the syntax trees, without docstrings.
- Lines of code have a token that is not a comment. Blank lines and docstrings, also those of attributes, are not code.
  A comment line contains a comment, alone or after code. Comments for tools (`noqa`, `type:`, `pragma:`) do not count.
- A request's way is traced with `sys.setprofile` on a line emulated in this process: the distinct functions of the
  package that ran during one warm call, without comprehensions and emulated devices; and their files. The remote write
  runs with its client in another thread, so that both sides are told apart. The objects are the instances of classes
  of the application whose code ran on the owner's side.
"""

from __future__ import annotations

import argparse
import ast
import asyncio
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import threading
import tokenize
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

APPLICATION = {"cli", "config", "discovery", "doctor", "doors", "gate", "outputs", "service"}
"""The rooms of the application in revisions before `busmaster/app/` held them."""
ROOT = "__init__"
BENCHMARKS = "benchmarks"
HERE = Path(__file__).parents[2]
FOR_TOOLS = ("noqa", "type:", "pragma:")
"""Beginnings of comments that are not for a reader."""
LAYOUT = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
COMPREHENSIONS = {"<listcomp>", "<genexpr>", "<dictcomp>", "<setcomp>"}
"""Functions to the interpreter, of some versions, not to a reader."""
WARM = 20
"""Calls before the one that is traced: what is made once is made by then."""
TRACES = 5
"""Traces of which the shortest counts: a busy machine makes a reply untimely, which is then examined more closely."""
OPENED = 0.5
"""Seconds between two such rounds of calls: for the maximum reply delay after a line is opened, replies to requests of
an earlier master are expected, and every reply is examined more closely."""


# the sources


@dataclass
class Sources:
    """The modules of a package, and what they import."""

    package: Path
    trees: dict[str, ast.Module] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    edges: dict[str, set[str]] = field(default_factory=dict)
    measured: set[str] = field(default_factory=set)
    """The modules that benchmarks import."""

    def __post_init__(self) -> None:
        for path in sorted(self.package.rglob("*.py")):
            text = self.texts[self._named(path)] = path.read_text()
            self.trees[self._named(path)] = ast.parse(text)
        self.edges = {name: set(self._imports(tree)) - {name} for name, tree in self.trees.items()}
        benchmarks = sorted(self.package.parent.joinpath("benchmarks").glob("*.py"))
        self.measured = {name for path in benchmarks for name in self._imports(ast.parse(path.read_text()))}

    def _named(self, path: Path) -> str:
        """Return the module's name in the package; "" for the package's own."""
        parts = path.relative_to(self.package).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def _imports(self, tree: ast.Module) -> Iterator[str]:
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                named = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                named = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            for name in named:
                if name.split(".")[0] == "busmaster":
                    yield self._module(name)

    def _module(self, dotted: str) -> str:
        """Return the module that an imported name is, or is in."""
        name = dotted.removeprefix("busmaster").removeprefix(".")
        while name not in self.trees:
            name = name.rpartition(".")[0]
        return name

    def statements(self, room: str) -> int:
        """Return how many statements the room has, without docstrings."""
        return sum(
            isinstance(node, ast.stmt) and not _is_docstring(node)
            for name, tree in self.trees.items()
            if room_of(name) == room
            for node in ast.walk(tree)
        )

    def comments(self, rooms: set[str]) -> float:
        """Return the number of comment lines per 100 lines of code of these rooms."""
        lines = [lines_of(self.texts[name], tree) for name, tree in self.trees.items() if room_of(name) in rooms]
        code = sum(code for code, _ in lines)
        return round(100 * sum(comments for _, comments in lines) / code, 1) if code else 0.0

    def arrows(self, room: Callable[[str], str]) -> set[tuple[str, str]]:
        """Return each pair of rooms of which the first imports the second, without the benchmarks."""
        pairs = {(room(name), room(other)) for name, others in self.edges.items() for other in others}
        return {(one, other) for one, other in pairs if one != other}

    def rooms(self) -> set[str]:
        """Return the rooms as the design counts them."""
        tied = {name for name, others in self.edges.items() if others} | set(self.importers()) | self.measured
        foreign = {path.parent.relative_to(self.package).parts[:1] for path in self.package.rglob("*.lua")}
        return {BENCHMARKS} | {top_of(name) for name in tied} | {parts[0] for parts in foreign if parts}

    def files_of_devices(self) -> set[str]:
        """Return the files of the emulator, and of the protocols' devices that are built on it."""
        return {
            str(path.relative_to(self.package))
            for path in self.package.rglob("*.py")
            if room_of(name := self._named(path)) == "emulator"
            or (room_of(name) == "protocols" and any(room_of(other) == "emulator" for other in self.edges[name]))
        }

    def importers(self) -> Counter[str]:
        """Return how many other modules import each, without packages' own and without what nothing imports."""
        return Counter(other for others in self.edges.values() for other in others)


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def lines_of(text: str, tree: ast.Module) -> tuple[int, int]:
    """Return the numbers of lines of code, and of lines with a comment for a reader."""
    docstrings = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.stmt) and _is_docstring(node)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    code, comments = set[int](), set[int]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if not token.string.lstrip("#: ").startswith(FOR_TOOLS):
                comments.add(token.start[0])
        elif token.type not in LAYOUT:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code - docstrings), len(comments)


def room_of(module: str) -> str:
    """Return the room of a module."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "app" else parts[0] or ROOT


def top_of(module: str) -> str:
    """Return the room of a module as the design counts them: the application is one."""
    return module.split(".")[0] or ROOT


def is_application(module: str) -> bool:
    """Return whether a module is of the application."""
    return module.split(".")[0] in {*APPLICATION, "app"}


def circles(arrows: set[tuple[str, str]]) -> list[set[str]]:
    """Return the sets of rooms that reach each other."""
    rooms = {room for arrow in arrows for room in arrow}
    reach = {room: _reached(arrows, room) for room in rooms}
    found: list[set[str]] = []
    for room in sorted(rooms):
        circle = {other for other in reach[room] if room in reach[other]}
        if circle and circle not in found:
            found.append(circle)
    return found


def _reached(arrows: set[tuple[str, str]], start: str) -> set[str]:
    found: set[str] = set()
    waiting = [start]
    while waiting:
        one = waiting.pop()
        new = {other for room, other in arrows if room == one} - found
        found |= new
        waiting += new
    return found


def structure(root: Path) -> dict[str, Any]:
    """Return what can be counted in the sources below `root`."""
    sources = Sources(root / "busmaster")
    arrows = sources.arrows(room_of)
    rooms = sorted({room_of(name) for name in sources.trees})
    eager = {(room, other) for room, other in arrows if not (room == ROOT and is_application(other))}
    upward = [
        (room, other)
        for room, other in arrows
        if room not in (ROOT, "__main__") and not is_application(room) and is_application(other)
    ]
    seam = {
        other
        for name, others in sources.edges.items()
        if is_application(name)
        for other in others
        if not is_application(other) and other != "__main__"
    }
    single = [name for name, count in sources.importers().items() if count == 1]
    everything = {room: sources.statements(room) for room in rooms}
    return {
        "rooms": len(sources.rooms()),
        "arrows between rooms": len(sources.arrows(top_of)) + len({top_of(name) for name in sources.measured}),
        "arrows between rooms and packages of the application": len(arrows),
        "circles of rooms": len(circles(eager)),
        "arrows upward, from the library into the application": len(upward),
        "root names": _root_names(sources.trees[""]),
        "library modules that the application imports": len(seam),
        "modules with one importer": len(single),
        "modules": len(sources.trees),
        "statements": sum(everything.values()),
        **{f"statements of {room}": count for room, count in everything.items()},
        "comment lines per 100 lines of code": sources.comments(set(rooms)),
        **{f"comment lines per 100 lines of {room}": sources.comments({room}) for room in rooms},
        "names": {
            "circles of rooms": [sorted(circle) for circle in circles(eager)],
            "library modules that the application imports": sorted(seam),
            "modules with one importer": sorted(single),
        },
    }


def _root_names(tree: ast.Module) -> int:
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            assert isinstance(node.value, ast.List)
            return len(node.value.elts)
    raise SystemExit(
        "the root has no list named __all__: say in tests/verification/measures.py how its names are found"
    )


# the way of a request


@dataclass
class Trace:
    """What ran in one thread while it was on."""

    package: str
    devices: set[str]
    """Files of emulated devices, whose code is not the package's side of the line."""
    functions: set[tuple[str, str, int]] = field(default_factory=set)
    files: set[str] = field(default_factory=set)
    objects: dict[int, Any] = field(default_factory=dict)

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        """Note a call of the package's code; `sys.setprofile` calls this."""
        if event != "call":
            return
        code = frame.f_code
        own = frame.f_locals.get("self")
        if code.co_filename.startswith(self.package):
            file = code.co_filename.removeprefix(self.package).lstrip("/")
        elif code.co_filename == "<string>" and type(own).__module__.startswith("busmaster."):
            file = type(own).__module__.removeprefix("busmaster.").replace(".", "/") + ".py"  # written by dataclasses
        else:
            return
        if file in self.devices or code.co_name in COMPREHENSIONS:
            return
        self.functions.add((file, code.co_qualname, code.co_firstlineno))
        self.files.add(file)
        module = type(own).__module__.removeprefix("busmaster.")
        if own is not None and is_application(module):
            self.objects[id(own)] = own  # kept: the id of one that is gone would be given again

    async def of(self, call: Callable[[], Awaitable[object]]) -> None:
        """Trace one call that is awaited in this thread, and what its loop does meanwhile."""
        sys.setprofile(self)
        try:
            await call()
        finally:
            sys.setprofile(None)


def emulated_line() -> Any:
    """Return a port of an emulated line with one controller, in this process."""
    from busmaster import Hcp2Controller
    from busmaster.emulator.line import Line
    from busmaster.emulator.memory import MemoryPort
    from busmaster.registry import make_device

    return MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)]))


async def traced_read(trace: Trace) -> None:
    """Trace one local read."""
    from busmaster import Bus, Hcp2Controller

    async with Bus(emulated_line()) as bus:
        controller = Hcp2Controller(bus, 5)
        for pause in (OPENED, 0.0):
            for _ in range(WARM):
                await controller.read(1)
            await asyncio.sleep(pause)
        await trace.of(lambda: controller.read(1))


async def traced_write(owner: Trace, client: Trace) -> None:
    """Trace one remote write: the owner's side, and the client's."""
    from busmaster import Bus, Hcp2Controller, Service, connect

    with tempfile.TemporaryDirectory() as folder:
        async with Bus(emulated_line()) as bus:
            Hcp2Controller(bus, 5)
            async with Service(bus, path=Path(folder) / "traced") as service:
                loop = asyncio.get_running_loop()
                warm = asyncio.Event()
                traced = threading.Event()
                done = loop.create_future()

                async def write() -> None:
                    async with connect(service.address) as remote:
                        controller = Hcp2Controller(remote, 5)
                        for pause in (OPENED, 0.0):
                            for _ in range(WARM):
                                await controller.write(1, 7.0)
                            await asyncio.sleep(pause)
                        loop.call_soon_threadsafe(warm.set)
                        await asyncio.to_thread(traced.wait)
                        await client.of(lambda: controller.write(1, 7.0))
                        loop.call_soon_threadsafe(done.set_result, None)  # before it disconnects

                def fail(error: BaseException) -> None:
                    if not done.done():
                        done.set_exception(error)

                def run() -> None:
                    try:
                        asyncio.run(write())
                    except BaseException as error:
                        loop.call_soon_threadsafe(fail, error)

                thread = threading.Thread(target=run)
                thread.start()
                waiting = asyncio.ensure_future(warm.wait())
                await asyncio.wait([waiting, done], return_when=asyncio.FIRST_COMPLETED)
                waiting.cancel()

                async def owned() -> None:
                    traced.set()
                    await done

                await owner.of(owned)
                await asyncio.to_thread(thread.join)


def _succeeds(traced: Coroutine[Any, Any, None]) -> bool:
    """Return whether the request succeeded: tracing can delay a byte so much that its reply is not believed."""
    from busmaster import BusError

    try:
        asyncio.run(traced)
    except BusError:
        return False
    return True


def ways(root: Path) -> dict[str, Any]:
    """Return how long the ways of a local read and of a remote write are, for the package below `root`."""
    package = root / "busmaster"
    devices = Sources(package).files_of_devices()

    def trace() -> Trace:
        return Trace(str(package), devices)

    reads: list[Trace] = []
    writes: list[tuple[Trace, Trace]] = []
    while len(reads) < TRACES:
        one = trace()
        if _succeeds(traced_read(one)):
            reads.append(one)
    while len(writes) < TRACES:
        pair = trace(), trace()
        if _succeeds(traced_write(*pair)):
            writes.append(pair)
    read = min(reads, key=lambda one: len(one.functions))
    owner, client = min(writes, key=lambda pair: len(pair[0].functions | pair[1].functions))
    return {
        "local read: functions": len(read.functions),
        "local read: files": len(read.files),
        "remote write: functions": len(owner.functions | client.functions),
        "remote write: files": len(owner.files | client.files),
        "remote write: functions of the owner": len(owner.functions),
        "remote write: objects of the owner": len(owner.objects),
        "names": {
            "local read: functions": [f"{file} {name}" for file, name, _ in sorted(read.functions)],
            "remote write: functions of the owner": [f"{file} {name}" for file, name, _ in sorted(owner.functions)],
            "remote write: objects of the owner": sorted(type(one).__qualname__ for one in owner.objects.values()),
        },
    }


# the report


def measured(root: Path) -> dict[str, Any]:
    """Return all measures of the tree at `root`, the traced ones by a process that imports the package from there."""
    found = structure(root)
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, str(Path(__file__)), "--ways-of", str(root)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment, cwd=root)
    if done.returncode:
        sys.stderr.write(f"not traced in {root}: {done.stderr.strip().splitlines()[-1]}\n")
        return found
    traced: dict[str, Any] = json.loads(done.stdout)
    return {**found, **traced, "names": {**found["names"], **traced["names"]}}


def unpacked(revision: str, folder: str) -> Path:
    """Put the package and the benchmarks of a revision into a folder, and return that."""
    done = subprocess.run(
        ["git", "-C", str(HERE), "archive", revision, "busmaster", BENCHMARKS], capture_output=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{revision}: {done.stderr.decode().strip()}")
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return Path(folder)


def table(now: dict[str, Any], before: dict[str, Any] | None, revision: str) -> str:
    """Return the measures as a table."""
    names = [name for name in {**now, **(before or {})} if name != "names"]
    width = max(map(len, names))
    if before is None:
        return "\n".join(f"{name:{width}}  {now.get(name, '-'):>8}" for name in names)
    column = max(8, len(revision))
    lines = [f"{'':{width}}  {revision:>{column}}  {'now':>8}"]
    lines += [f"{name:{width}}  {before.get(name, '-'):>{column}}  {now.get(name, '-'):>8}" for name in names]
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """Report the measures of this tree, and of another revision beside it."""
    parser = argparse.ArgumentParser(prog="python -m tests.verification.measures", description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="report as JSON, with the names of what is counted")
    parser.add_argument("--against", metavar="REV", help="report another revision beside this tree")
    parser.add_argument("--ways-of", metavar="DIR", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.ways_of:
        sys.stdout.write(json.dumps(ways(Path(chosen.ways_of))))
        return
    now = measured(HERE)
    before = None
    if chosen.against:
        with tempfile.TemporaryDirectory() as folder:
            before = measured(unpacked(chosen.against, folder))
    if chosen.json:
        sys.stdout.write(
            json.dumps({"now": now} if before is None else {"now": now, chosen.against: before}, indent=2) + "\n"
        )
    else:
        sys.stdout.write(table(now, before, chosen.against or "") + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
