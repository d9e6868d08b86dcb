"""The table."""

from __future__ import annotations

from tests.plant.account import Account

HEAD = "| fault | lost | counted | told | back after |\n|---|---|---|---|---:|"


def row(found: Account) -> str:
    lost, counted = [], []
    if found.unread or found.missed:
        lost.append(f"{found.unread} values not read, {found.missed} cycles not begun")
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
    told = [_cell(text) for text in dict.fromkeys(found.told)]
    back = "-" if found.longest_back is None else f"{found.longest_back:.1f} s"
    cells = (
        *(found.name, "; ".join(lost) or "nothing", "; ".join(counted) or "-"),
        *("<br>".join([*found.notes, *told]) or "-", back),
    )
    return f"| {' | '.join(cells)} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
