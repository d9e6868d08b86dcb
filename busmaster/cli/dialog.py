"""The question of the screen: which value, and whether it is meant."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, Label

from busmaster.cli.parsing import parse_value
from busmaster.errors import InvalidCommand


class AskValue(ModalScreen[str | None]):
    """Asks for a value of `name`, then whether to write it. Its result is the value, or None for no."""

    CSS = """
    AskValue { align: center bottom; background: transparent; }
    AskValue Vertical { width: 100%; height: auto; border: round ansi_blue; background: ansi_default; padding: 0 1; }
    AskValue Label { color: ansi_default; width: 1fr; }
    AskValue Input { border: none; height: 1; padding: 0; background: ansi_default; color: ansi_default; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,n", "dismiss(None)", show=False),
        Binding("y", "agree", show=False),
    ]

    def __init__(self, name: str, unit: str) -> None:
        super().__init__()
        self.asked = name
        self.unit = unit
        self.value: str | None = None

    def compose(self) -> ComposeResult:
        with Vertical():
            unit = f" in {self.unit}" if self.unit else ""
            yield Label(f"write {self.asked}{unit}  (Enter; Esc leaves it)", markup=False)
            yield Input(placeholder="value")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the value and ask whether it is meant, or say why it is no number."""
        if not event.value.strip():
            return
        try:
            parse_value(event.value)
        except InvalidCommand as error:
            self.query_one(Label).update(f"write {self.asked}: {error}  (Enter; Esc leaves it)")
            return
        self.value = event.value.strip()
        event.input.remove()
        self.query_one(Label).update(f"write {self.asked} = {f'{self.value} {self.unit}'.rstrip()}?  y or n")

    def action_agree(self) -> None:
        """End the question with the value, once there is one."""
        if self.value is not None:
            self.dismiss(self.value)
