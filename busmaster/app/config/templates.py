"""Device templates: the points of one kind of drive, written once and named by each node that is such a drive.

    [nodes.drive4-7]
    protocol = "microflex"
    address = "4-7"
    template = "microflex"                       # shipped; or the path of a file: "templates/ours.toml"

    [nodes.drive4-7.points]
    speed_reference = { minimum = 0, maximum = 80 }   # its other keys are those of the template

A template is a file with the protocols that it is for, and points as a node has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

from busmaster.app.config.keys import Internal, read_section, tables_of
from busmaster.app.config.point_section import PointSection, read_point
from busmaster.app.config.source import FileError, Source
from busmaster.app.config.table import Table
from busmaster.ext import NodeKind, guess, kinds

FOLDERS = Path(__file__).parents[2] / "protocols"
SUFFIX = ".toml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """The points of a template. Without a name, no template is used."""

    name: Internal[str] = ""
    protocol: tuple[str, ...]
    """The protocol of the nodes that it is for, or several."""
    title: str = ""
    """Title of the template."""
    points: Annotated[Mapping[str, Table], tables_of("point")]
    """A table for each point, as `[nodes.NAME.points]` has them."""


@cache
def shipped() -> tuple[str, ...]:
    """Return the names of the templates that come with the package: the TOML files of the protocols' folders."""
    return tuple(sorted(_shipped()))


def shipped_file(name: str) -> Path:
    """Return the file of a template that comes with the package."""
    return _shipped()[name]


@cache
def _shipped() -> Mapping[str, Path]:
    return {path.stem: path for path in FOLDERS.glob(f"*/*{SUFFIX}")}


def read_template(node: Table, kind: NodeKind) -> Template:
    """Read the template that a node's section names, if it names one.

    Raises FileError with file and line if the template is unknown, for other protocols, or has an error.
    """
    if "template" not in node:
        return Template(protocol=(), points={})
    name = node.text("template")
    top = Table(_source(node, name))
    values = read_section(top, Template)
    for protocol in values["protocol"]:
        if protocol not in kinds():
            raise top.error(f"no such protocol {protocol!r}{guess(protocol, kinds())}", "protocol")
    template = Template(**values, name=name, points={point.name: point for point in top.tables("points")})
    if kind.name not in template.protocol:
        raise node.error(
            f"{name} is for nodes of {' and '.join(template.protocol)}, not of {kind.name}; use another template",
            "template",
        )
    for point in template.points.values():
        read_point(point, kind)  # reports errors with the line in the template
    return template


def _source(node: Table, name: str) -> Source:
    if name in _shipped():
        return Source.read(shipped_file(name))
    if not name.endswith(SUFFIX):
        others = f"; use one of {', '.join(shipped())}, or the path of your own file, which ends in {SUFFIX}"
        raise node.error(f"no such template {name!r}{guess(name, shipped()) or others}", "template")
    path = node.source.beside(name)
    try:
        return Source.read(path)
    except FileError:
        raise
    except OSError as error:
        raise node.error(f"the template {path} cannot be read: {error.strerror or error}", "template") from None


def read_points(node: Table, kind: NodeKind) -> dict[str, PointSection]:
    """Read the points of a node's section: those of its template, and its own.

    If both define a point, the keys of the node override those of the template. Raises FileError with file, line and
    key for an error in either.
    """
    template = read_template(node, kind)
    points = {name: read_point(point, kind, template.name) for name, point in template.points.items()}
    for own in node.tables("points"):
        with own.part():
            given = template.points.get(own.name)
            if given is None:
                points[own.name] = read_point(own, kind)
            else:
                both = Table(own.source, own.key, {**given.data, **own.data})
                points[own.name] = read_point(both, kind, template.name)
    return points
