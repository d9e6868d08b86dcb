"""The points of a file as CSV and back: to the letter, whatever the file looks like, and nothing of it is lost."""

from __future__ import annotations

import csv
import os
import tomllib
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from busmaster.app.config import FileError, LineFile, load
from busmaster.app.config.names import POINT_NAME
from busmaster.app.config.rewriting import key_text, toml_text
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line.points_table import COLUMNS, points_csv, rows
from busmaster.app.line.points_taking import BadRows, Taking, taken, write_beside
from busmaster.app.outputs.cells import csv_lines, text_cell, text_of
from busmaster.errors import InvalidCommand

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))
HEAD = 'port = "/dev/ttyUSB0"\n[nodes.w]\nprotocol = "hcp2"\naddress = 5  # of winder 5\n'
INLINE = '\n[nodes.w.points]\n# what it is\na = { item = "10", maximum = 1_000 }   # ours\nb = { item = "11" }\n'
FORMS = {
    "inline": INLINE,
    "sections": '[nodes.w.points.a]\nitem = "10"\nmaximum = 1_000 # ours\n\n[nodes.w.points.b]\nitem = "11"\n',
    "dotted": 'points.a.item = "10"\npoints.a.maximum = 1_000\npoints.b = { item = "11" }\n',
    "in the node": 'points = { a = { item = "10", maximum = 1_000 }, b = { item = "11" } }\n',
    "dotted points": '[nodes.w.points]\na.item = "10"\na.maximum = 1_000\nb.item = "11"\n',
    "no line end": INLINE.rstrip(),
}
GROUP = '\n[groups.g]  # fast\nperiod = 0.5\npoints = "w/a,b"'
ALL_KEYS = """
[nodes.w.points]
a = { item = "10", unit = "°C", factor = 0.1, offset = -40, minimum = -40.0, max_step = 1e-05 }
b = { item = "11", writable = false, bits = { READY = 0, "FAULT-2" = 3 }, deadband = 0, heartbeat = 60, maximum = 1e16 }
i = { item = "19", bits = { A = 0, "F-2" = 3 }, alarm_if_set = ["F-2"], alarm_if_clear = ["A"] }
c = { item = "12", labels = { -1 = "=1+1", 0 = "off; \\"quoted\\", \\\\", 1 = "é" } }
d = { item = "13", low = 1, high = 2, hysteresis = 0.1, precision = 1, unit = "=cmd|' /C calc'!A0" }
"+e" = { item = "14", unit = "'" }
"@f" = { item = "15", unit = "1.20" }
g = { item = "16", unit = "" }
"4-8" = { item = "17", unit = "two\\nlines" }
20 = { read_after_write = true }
"a\\"b" = { item = "18", unit = " , ; " }
"""


def file(points: str, rest: str = GROUP) -> LineFile:
    return read(Source("line.toml", HEAD + points + rest))


def test_a_point_is_told_with_the_points_whose_limits_hold_for_it_and_they_are_not_taken_for_its_own() -> None:
    held = file(
        """
[nodes.w.points]
force = { item = "10", factor = 0.1, maximum = 50 }
pull = { item = "10", minimum = 3, maximum = 400 }
raw = { item = "10" }
other = { item = "11" }
""",
        "",
    )
    assert [(row.point, row.limited_by) for row in rows(held)] == [
        ("force", ("pull",)),
        ("pull", ("force",)),
        ("raw", ("force", "pull")),
        ("other", ()),
    ]
    data = points_csv(held)
    assert b'"force, pull"' in data
    assert taken(held, "points.csv", data).changes == ()
    more = taken(held, "points.csv", data + data.splitlines()[3].replace(b"raw", b"newer") + b"\n")
    assert [str(change) for change in more.changes] == ['w/newer is new: { item = "10" }']


def test_a_symbol_is_told_with_the_points_whose_limits_hold_for_it() -> None:
    node = (
        'port = "/dev/ttyUSB0"\n[nodes.press]\nprotocol = "msc"\naddress = 1\nsymbols = { count = 2008, cam = 3000 }\n'
    )
    held = read(Source("line.toml", f'{node}points.pieces = {{ item = "2008", maximum = 99 }}\n'))
    assert [(row.point, row.limited_by) for row in rows(held)] == [
        ("pieces", ()),
        ("count", ("pieces",)),
        ("cam", ()),
    ]


def test_points_are_told_also_if_a_group_of_the_file_names_one_that_there_is_not() -> None:
    held = file('points.a = { item = "10", maximum = 5 }\n', GROUP.replace("w/a,b", "w/none"))
    assert [row.point for row in rows(held)] == ["a"]


def test_a_point_of_a_range_of_nodes_is_one_row_of_its_section() -> None:
    many = HEAD.replace("nodes.w", "nodes.w5-8").replace("address = 5  # of winder 5", 'address = "5-8"')
    held = read(
        Source("line.toml", many + '[nodes.w5-8.points]\na = { item = "10", maximum = 1 }\nb = { item = "10" }\n')
    )
    assert len(held.nodes) == 4
    assert [(row.node, row.point, row.limited_by) for row in rows(held)] == [("w5-8", "a", ()), ("w5-8", "b", ("a",))]
    assert taken(held, "points.csv", points_csv(held)).changes == ()


def take(held: LineFile, *lines: str) -> Taking:
    return taken(held, "points.csv", "\n".join(lines).encode())


def faults(held: LineFile, *lines: str) -> list[str]:
    with pytest.raises(BadRows) as caught:
        take(held, *lines)
    return list(caught.value.faults)


def cells(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(data.decode().splitlines()))


# round trips


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_what_goes_out_and_comes_in_changes_nothing_of_an_example(path: Path) -> None:
    held = load(path)
    back = taken(held, "points.csv", points_csv(held))
    assert (back.changes, back.stay, back.text) == ((), (), path.read_text())


def test_what_goes_out_gives_the_same_points_to_a_file_without_any() -> None:
    held, bare = file(ALL_KEYS, ""), file("", "")
    back = taken(bare, "points.csv", points_csv(held))
    again = read(Source("line.toml", back.text))
    assert again.nodes == held.nodes
    assert len(back.changes) == len(held.nodes["w"].points) == 11
    assert back.text.startswith(HEAD)


def test_texts_are_written_with_their_own_characters_and_only_control_characters_are_escaped() -> None:
    unit, label = 'unit = "µm/°C 🏭\\n\\u007f"', '0 = "geöffnet"'
    held = file(f'[nodes.w.points]\na = {{ item = "10", {unit}, labels = {{ {label} }} }}\n', "")
    back = taken(file("", ""), "points.csv", points_csv(held))
    [point] = [line for line in back.text.splitlines() if "µm" in line]
    assert unit in point
    assert label in point
    assert read(Source("line.toml", back.text)).nodes == held.nodes


@settings(max_examples=30)
@given(
    unit=st.text(st.characters(exclude_categories=["Cs"])),
    name=st.from_regex(POINT_NAME, fullmatch=True),
    label=st.text(min_size=1).filter(str.isprintable),
    factor=st.floats(1e-12, 1e12) | st.integers(1, 10**9),
)
@pytest.mark.slow
@example(unit="a\rb\x7f\x00", name="\x7f", label="=", factor=1e-05)
def test_any_text_and_any_number_goes_out_and_comes_in_to_the_letter(
    unit: str, name: str, label: str, factor: float
) -> None:
    said = {name: {"item": "10", "unit": unit, "factor": factor}, "x": {"item": "11", "labels": {"-3": label}}}
    held = file(
        "\n".join(["[nodes.w.points]", *(f"{key_text(key)} = {toml_text(one)}" for key, one in said.items())]), ""
    )
    bare = file("", "")
    back = taken(bare, "points.csv", points_csv(held))
    assert tomllib.loads(back.text)["nodes"]["w"]["points"] == said
    assert taken(held, "points.csv", points_csv(held)).changes == ()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.name))
def test_of_an_example_only_the_lines_of_what_changes_are_touched(path: Path) -> None:
    held = load(path)
    changed = [row for row in rows(held) if row.origin == ""]
    table = csv_lines([("node", "point", "unit"), *((row.node, row.point, "=x") for row in changed)])
    back = taken(held, "points.csv", table)
    before, after = path.read_text().splitlines(), back.text.splitlines()
    assert len(back.changes) == len(changed) == sum(one != other for one, other in zip(before, after, strict=True))
    assert {
        point.unit for node in read(Source(str(path), back.text)).nodes.values() for point in node.points.values()
    } <= {"=x"}


def test_every_key_of_a_point_is_a_column() -> None:
    assert {key for row in cells(points_csv(file(ALL_KEYS, ""))) for key, cell in row.items() if cell} | {
        "decimals",
        "origin",
    } == set(COLUMNS)


def test_no_text_is_a_formula_a_date_or_another_number_to_a_spreadsheet() -> None:
    told = cells(points_csv(file(ALL_KEYS.replace("two\\nlines", "m"), "")))
    assert [row["point"] for row in told] == ["a", "b", "i", "c", "d", "'+e", "'@f", "g", "'4-8", "20", 'a"b']
    assert [row["unit"] for row in told][4:8] == ["'=cmd|' /C calc'!A0", "''", "'1.20", "'"]


@pytest.mark.parametrize(
    "text",
    ["", "'", "''x", "=1", "'=1", "-", "+1", "@", "\tx", "\rx", "01", "1.20", "4-8", ".5", "5", "0", "1e5", " 5"],
)
def test_a_text_cell_is_read_to_the_letter(text: str) -> None:
    assert text_of(text_cell(text)) == text


@pytest.mark.parametrize("delimiter", [",", ";"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_csv_is_taken_as_spreadsheets_write_it(delimiter: str, line_end: str, mark: str) -> None:
    lines = ["node,point,item,unit,writable", "w,c,12,°C,TRUE", 'w,d,13,"m",', ",,,,"]
    text = mark + line_end.join(lines).replace(",", delimiter) + line_end
    back = taken(file(INLINE), "points.csv", text.encode())
    points = read(Source("line.toml", back.text)).nodes["w"].points
    assert (points["c"].unit, points["c"].writable, points["d"].unit) == ("°C", True, "m")


def test_spaces_around_cells_and_capital_letters_of_columns_mean_nothing() -> None:
    back = take(file(INLINE), " Node ,POINT,item,Maximum,writable", "w,c,12, 5 , FALSE ")
    point = read(Source("line.toml", back.text)).nodes["w"].points["c"]
    assert (point.item, point.maximum, point.writable) == ("12", 5, False)


# what is written


@pytest.mark.parametrize("form", FORMS)
def test_a_file_of_every_form_keeps_all_that_is_not_changed(form: str) -> None:
    held = file(FORMS[form], "" if form == "no line end" else GROUP)
    back = take(held, "node,point,item,maximum,unit", "w,a,10,900,mm", "w,b,11,,", "w,c,12,5,N", "w,x.y,13,,")
    expected = tomllib.loads(held.table.source.text)
    expected["nodes"]["w"]["points"]["a"] |= {"maximum": 900, "unit": "mm"}
    expected["nodes"]["w"]["points"] |= {"c": {"item": "12", "maximum": 5, "unit": "N"}, "x.y": {"item": "13"}}
    assert tomllib.loads(back.text) == expected
    for comment in ("# of winder 5", "# what it is", "# ours", "# fast"):
        assert (comment in back.text) == (comment in held.table.source.text)


@pytest.mark.parametrize("form", FORMS)
def test_an_empty_cell_says_that_nothing_is_said(form: str) -> None:
    back = take(file(FORMS[form], ""), "node,point,maximum", "w,a,", "w,b,")
    assert [str(change) for change in back.changes] == ["w/a: maximum 1000 -> none"]
    assert tomllib.loads(back.text)["nodes"]["w"]["points"] == {"a": {"item": "10"}, "b": {"item": "11"}}


def test_lines_that_go_and_come_at_one_place_do_not_mix() -> None:
    held = file('points.a.item = "10"\npoints.b.maximum = 5\npoints.b.item = "11"\n', "")
    back = take(held, "node,point,maximum,unit", "w,b,,", "w,a,,mm")
    assert tomllib.loads(back.text)["nodes"]["w"]["points"] == {"a": {"item": "10", "unit": "mm"}, "b": {"item": "11"}}


def test_a_value_that_does_not_change_keeps_its_spelling() -> None:
    back = take(file(INLINE), "node,point,unit", "w,a,mm")
    assert 'a = { item = "10", maximum = 1_000, unit = "mm" }   # ours\n' in back.text


def test_values_of_a_point_in_a_section_that_do_not_change_keep_their_spelling() -> None:
    before = "[nodes.w.points.a]\nitem = '10'\nmaximum = 1_000\nfactor = 0.10\n"
    assert take(file(before, ""), "node,point,maximum", "w,a,900").text == HEAD + before.replace("1_000", "900")


def test_rows_can_come_in_another_order_than_the_points_of_the_file() -> None:
    before = '[nodes.w.points]\na = { item = "10", maximum = 1 }\nb = { item = "11", maximum = 2 }\n'
    after = before.replace("= 1 }", "= 3 }").replace("= 2 }", "= 4 }")
    assert take(file(before, ""), "node,point,maximum", "w,b,4", "w,a,3").text == HEAD + after


def test_a_new_point_stands_behind_the_last_of_the_dotted_ones() -> None:
    before = 'points.a.item = "10"\npoints.b.item = "11"\n'
    after = before + 'points.c = { item = "12" }\n'
    assert take(file(before, ""), "node,point,item", "w,a,10", "w,b,11", "w,c,12").text == HEAD + after


def test_a_column_or_a_row_that_is_not_there_changes_nothing() -> None:
    back = take(file(INLINE), "point,node,unit", "b,w,mm")
    assert back.stay == ("w/a",)
    assert read(Source("line.toml", back.text)).nodes["w"].points["a"].maximum == 1000


def test_line_ends_of_the_file_stay_as_they_are() -> None:
    held = read(Source("line.toml", (HEAD + INLINE + GROUP).replace("\n", "\r\n")))
    back = take(held, "node,point,item,unit", "w,a,10,mm", "w,c,12,N")
    assert back.text.count("\n") == back.text.count("\r\n") == held.table.source.text.count("\n") + 1


def test_points_of_a_range_of_nodes_are_those_of_its_section() -> None:
    held = read(Source("line.toml", 'port = "/dev/ttyUSB0"\n[nodes.d4-5]\nprotocol = "hcp2"\naddress = "4-5"\n'))
    back = take(held, "node,point,item", "d4-5,a,10")
    again = read(Source("line.toml", back.text))
    assert again.nodes["d4"].points == again.nodes["d5"].points
    assert faults(held, "node,point,item", "d4,a,10") == [
        "points.csv: row 2, column node: no section of nodes has the name 'd4'; the node belongs to d4-5; use that name"
    ]


def test_limits_of_every_section_of_nodes_are_shown() -> None:
    other = "".join(f'[nodes.{n}]\nprotocol = "hcp2"\naddress = {a}\n' for n, a in (("x", 6), ("y", 7)))
    point = 'points.{} = {{ item = "10"{} }}\n'
    parts = other.split("[nodes.y]")
    held = read(
        Source(
            "line.toml",
            f"{HEAD}{point.format('a', '')}{parts[0]}{point.format('b', ', maximum = 5')}{point.format('c', '')}"
            f"[nodes.y]{parts[1]}{point.format('d', ', writable = false')}{point.format('e', '')}",
        )
    )
    assert [(row.node, row.point, row.limited_by) for row in rows(held)] == [
        ("w", "a", ()),
        ("x", "b", ()),
        ("x", "c", ("b",)),
        ("y", "d", ()),
        ("y", "e", ("d",)),
    ]


def test_several_points_are_added_to_inline_points_behind_the_last() -> None:
    back = take(file(FORMS["in the node"], ""), "node,point,item", "w,c,12", "w,d,13")
    assert 'b = { item = "11" }, c = { item = "12" }, d = { item = "13" } }' in back.text
    empty = take(file("points = {}\n", ""), "node,point,item", "w,c,12", "w,d,13")
    assert 'points = { c = { item = "12" }, d = { item = "13" } }\n' in empty.text


def test_new_points_of_several_nodes_are_added_to_each_of_them() -> None:
    held = read(Source("line.toml", f'{HEAD}[nodes.x]\nprotocol = "hcp2"\naddress = 6\n'))
    back = take(held, "node,point,item", "x,b,11", "w,a,10", "x,c,12")
    nodes = tomllib.loads(back.text)["nodes"]
    assert (nodes["w"]["points"], nodes["x"]["points"]) == (
        {"a": {"item": "10"}},
        {"b": {"item": "11"}, "c": {"item": "12"}},
    )


def test_what_a_template_says_is_not_written_down_again(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(
        'protocol = "hcp2"\n[points]\na = { item = "10", maximum = 5 }\nz = { item = "12" }\n'
    )
    path = tmp_path / "line.toml"
    path.write_text(HEAD + 'template = "ours.toml"\n[nodes.w.points]\nb = { item = "11" }\n')
    held = load(path)
    out = points_csv(held)
    assert [(row["point"], row["origin"]) for row in cells(out)] == [("a", "ours.toml"), ("z", "ours.toml"), ("b", "")]
    assert taken(held, "points.csv", out).changes == ()
    back = take(held, "node,point,item,maximum,unit", "w,a,10,4,N")
    assert tomllib.loads(back.text)["nodes"]["w"]["points"] == {"b": {"item": "11"}, "a": {"maximum": 4, "unit": "N"}}
    assert faults(held, "node,point,maximum", "w,a,") == [
        "points.csv: row 2, column maximum: is 5 in the template and cannot be removed; write another value"
    ]


def test_a_key_that_a_node_repeats_of_its_template_stays_in_its_section(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text('protocol = "hcp2"\n[points]\na = { item = "10", maximum = 5 }\n')
    path = tmp_path / "line.toml"
    path.write_text(HEAD + 'template = "ours.toml"\n[nodes.w.points]\na = { maximum = 5, unit = "m" }\n')
    back = take(load(path), "node,point,unit", "w,a,mm")
    assert tomllib.loads(back.text)["nodes"]["w"]["points"] == {"a": {"maximum": 5, "unit": "mm"}}


# what is refused


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("w,c,12,,x", "row 2, column maximum: must be a number, not 'x'"),
        ('w,c,12,,"0,5"', "row 2, column maximum: 0,5 has a decimal comma; write 0.5"),
        ('w,c,12,,"-0,5"', "row 2, column maximum: -0,5 has a decimal comma; write -0.5"),
        ("w,c,12,,0,5", "row 2: the row has 6 cells instead of 5; put cells with a comma into quotes"),
        ("w,c,12,,inf", "row 2, column maximum: must be finite"),
        ("w,c,12,,true", "row 2, column maximum: must be a number, not true"),
        ("w,c,nothing,,", "row 2, column item: no such"),
        ("w,c,,,", "row 2, column point: no such"),
        ("w,c d,12,,", "row 2, column point: the name 'c d' contains a space"),
        ("v,c,12,,", "row 2, column node: no section of nodes has the name 'v'; there are w"),
        ("w,c,12,{ READY = 70 },", "row 2, column bits: READY is bit 70"),
        ("w,c,12,{ READY = x },", "row 2, column bits: must be a table of names"),
        ('w,c,12,"{ READY = 0, FAULT = 1.5 }",', "row 2, column bits: FAULT must be a whole number"),
        ('w,c,12,,"5\nx = 2"', "row 2, column maximum: must be a number, not '5"),
        ("w,c,12,5,", "row 2, column bits: must be a table of names"),
        ('w,c,12,"1\nx = 2",', "row 2, column bits: must be a table of names"),
        ('w,c,"12', "points.csv: line 2: not valid CSV: unexpected end of data"),
    ],
)
def test_a_bad_row_is_named_with_its_column(row: str, fault: str) -> None:
    [told] = faults(file(INLINE), "node,point,item,bits,maximum", row)
    assert fault in told
    assert told.startswith("points.csv: ")


def test_a_number_is_not_true_or_false_although_it_is_equal() -> None:
    held = file('points = { a = { item = "10", writable = true }, b = { item = "11" } }\n')
    assert take(held, "node,point,writable", "w,a,TRUE").changes == ()
    assert faults(held, "node,point,writable", "w,a,1") == [
        "points.csv: row 2, column writable: must be true or false, not 1"
    ]


def test_of_a_row_that_is_too_short_no_comma_is_suspected() -> None:
    [told] = faults(file(INLINE), "node,point,item,bits,maximum", "w,c,12")
    assert told == "points.csv: row 2: the row has 3 cells instead of 5"


@pytest.mark.parametrize(
    ("head", "fault"),
    [
        ("node,point,mximum", "row 1: no such column 'mximum'; did you mean 'maximum'?"),
        ("node,point,item,item", "row 1: there are two columns item"),
        ("node,item", "row 1: the column point is missing"),
        ("", "row 1: the column node is missing"),
    ],
)
def test_a_bad_head_is_named(head: str, fault: str) -> None:
    assert fault in faults(file(INLINE), head, "w,c,12")[0]


def test_what_is_no_utf_8_is_refused_with_its_line() -> None:
    with pytest.raises(BadRows, match="line 2: the file is not UTF-8"):
        taken(file(INLINE), "points.csv", "node,point,unit\nw,a,°C\n".encode("latin-1"))


def test_all_bad_rows_are_told_and_many_are_counted() -> None:
    told = faults(file(INLINE), "node,point,item", *(f"w,c{number},bad" for number in range(30)))
    assert len(told) == 21
    assert "row 21, " in told[19]
    assert told[20] == "and 10 more"


def test_a_point_that_is_there_twice_is_refused() -> None:
    assert "row 3, column point: w/c is also in row 2" in faults(file(INLINE), "node,point,item", "w,c,12", "w,c,13")[0]


def test_what_the_rest_of_the_file_cannot_bear_is_refused() -> None:
    held = file(INLINE, '\n[safe]\nwrites = { "w/a" = 0 }\nrepeatable = "w/a"\n')
    with pytest.raises(InvalidCommand, match=r"line.toml:12: safe.writes.w/a: w/a is read-only"):
        take(held, "node,point,writable", "w,a,false")


def test_a_bit_that_is_called_like_a_point_is_refused_by_its_row() -> None:
    with pytest.raises(FileError, match=r"points.csv: row 2, column bits: READY w has another point or item b.READY"):
        take(
            file(INLINE.replace("b =", '"b.READY" =').replace("b }", ""), ""),
            "node,point,item,bits",
            "w,b,12,{ READY = 0 }",
        )


def test_a_form_that_cannot_be_changed_is_left_alone() -> None:
    held = file('[nodes.w.points.a]\nitem = "10"\n[nodes.w.points.a.bits]\nREADY = 0\n', "")
    with pytest.raises(FileError, match=r"line.toml:7: nodes.w.points.a.bits: is not written as one pair"):
        take(held, "node,point,bits", "w,a,{ READY = 1 }")
    with pytest.raises(FileError, match=r"line.toml:7: nodes.w.points.a.bits: is not written as one pair"):
        take(held, "node,point,bits", "w,a,")


def test_points_of_a_node_that_is_written_in_one_line_are_not_added() -> None:
    held = read(Source("line.toml", 'port = "/dev/ttyUSB0"\n[nodes]\nw = { protocol = "hcp2", address = 5 }\n'))
    with pytest.raises(FileError, match=r"line.toml:2: nodes: points have a form that cannot be changed automatically"):
        take(held, "node,point,item", "w,c,12")


# the file


def test_a_file_is_replaced_as_a_whole_with_its_mode_and_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "real.toml").write_text("before")
    (tmp_path / "real.toml").chmod(0o640)
    (tmp_path / "line.toml").symlink_to("real.toml")
    write_beside(str(tmp_path / "line.toml"), "after °\r\n")
    assert (tmp_path / "real.toml").read_bytes() == "after °\r\n".encode()
    assert (tmp_path / "line.toml").is_symlink()
    assert (tmp_path / "real.toml").stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == ["line.toml", "real.toml"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_file_that_cannot_be_replaced_is_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def full(descriptor: int) -> None:
        raise error

    path = tmp_path / "line.toml"
    path.write_text("before")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(type(error)):
        write_beside(str(path), "after")
    assert path.read_text() == "before"
    assert [one.name for one in tmp_path.iterdir()] == ["line.toml"]


def test_a_file_keeps_its_owner_and_is_written_in_its_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "line.toml"
    path.write_text("before")
    status = path.stat()
    owners: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "fchown", lambda _, user, group: owners.append((user, group)))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    write_beside(str(path), "after")
    assert owners == [(status.st_uid, status.st_gid)]
    assert path.read_text() == "after"

    def refused(*_: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "fchown", refused)
    write_beside(str(path), "by another user")
    assert path.read_text() == "by another user"
