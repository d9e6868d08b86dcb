"""The table."""

from __future__ import annotations

from tests.verification.plant.account import Account
from tests.verification.plant.long_run import LongRun
from tests.verification.plant.plant import HOLDERS

HEAD = "| fault | lost | counted | reported | recovery |\n|---|---|---|---|---:|"


def row(found: Account) -> str:
    lost, counted = [], []
    if found.unread or found.missed:
        lost.append(f"{found.unread} values not read, {found.missed} cycles missed")
        counted.append("as errors, and as missed" if found.missed else "as errors")
    if found.wrong:
        lost.append(f"**{found.wrong} wrong**")
    for holder, number in found.lost.items():
        if number:
            lost.append(f"{holder}: {number}")
            counted.append(f"{holder}: {found.counted[holder]}")
    if found.kept:
        counted.append(f"{found.kept} kept on disk")
    if found.twice:
        counted.append(f"{found.twice} sent twice")
    reported = [_cell(text) for text in dict.fromkeys(found.told)]
    back = "-" if found.longest_back is None else f"{found.longest_back:.1f} s"
    cells = (
        *(found.name, "; ".join(lost) or "nothing", "; ".join(counted) or "-"),
        *("<br>".join([*found.notes, *reported]) or "-", back),
    )
    return f"| {' | '.join(cells)} |"


def _cell(text: str) -> str:
    """A message of the program as code, and the states that MQTT published as text."""
    text = text.replace("|", "\\|")
    return text if text.startswith("MQTT: ") else "`" + text.replace("`", "'") + "`"


def long_report(run: LongRun) -> str:
    """Two tables, of the minutes and of the outputs, and what else was counted."""
    lines = [
        "| minute | fault | cycles missed | values not read | recovery |",
        "|---:|---|---:|---:|---:|",
        *(
            f"| {number} | {'; '.join(filter(None, (minute.fault, minute.note)))} |"
            f" {', '.join(f'{group} {count}' for group, count in minute.missed.items() if count) or 0} |"
            f" {minute.unread} | {'-' if minute.back is None else f'{minute.back:.1f} s'} |"
            for number, minute in enumerate(run.minutes, 1)
        ),
        "",
        "| output | polled | stored | suppressed | dropped | kept on disk | lost, not counted | sent twice |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for holder in HOLDERS:
        held, (dropped, kept, suppressed) = run.held[holder], run.counted[holder]
        lost = max(0, run.samples - len(held.samples) - dropped - kept - suppressed)
        counts = (run.samples, len(held.samples), suppressed, dropped, kept, lost, held.twice)
        lines.append(f"| {holder} | {' | '.join(map(str, counts))} |")
    for name, counter in (("commands", run.commands), ("scrapes", run.scrapes), ("readings by sqlite3", run.reads)):
        lines.append(f"\n{name}: {', '.join(f'{what} {count}' for what, count in counter.items())}")
    lines += ["", "reported:", *(f"    {text}" for text in run.told), *(f"PROBLEM: {text}" for text in run.problems)]
    return "\n".join(lines)
