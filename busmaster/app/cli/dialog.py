"""The questions of the screen, and what it shows on demand, at the foot of the picture."""

from __future__ import annotations

from typing import ClassVar, TypeVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from busmaster.app.cli.parsing import parse_value
from busmaster.errors import InvalidCommand

T = TypeVar("T")
STYLE = """
Dialog { align: center bottom; background: transparent; }
Dialog .box { width: 100%; height: auto; max-height: 100%; border: round ansi_default; background: ansi_default;
    color: ansi_default; padding: 0 1; scrollbar-size: 0 0; }
Dialog Static { color: ansi_default; background: ansi_default; width: 1fr; }
Dialog Input { border: none; height: 1; padding: 0; background: ansi_default; color: ansi_default; }
"""
"""Of the dialogs, behind what the screen says of all its parts."""


class Dialog(ModalScreen[T]):
    """Something at the foot of the picture, which stays in sight above it. Escape leaves it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "leave", show=False)]

    def action_leave(self) -> None:
        """End it without an answer."""
        self.dismiss(None)


class AskYes(Dialog[bool]):
    """Asks whether something is meant. Its result is True for yes, else None."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "agree", show=False),
        Binding("n", "leave", show=False),
    ]

    def __init__(self, question: str) -> None:
        super().__init__()
        self.question = question

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            yield Static(Text(f"{self.question}  y or n"))

    def action_agree(self) -> None:
        """End it with yes."""
        self.dismiss(True)


class AskValue(Dialog[str]):
    """Asks for a value of `name`, then whether to write it. Its result is the value, or None for no."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "leave", show=False),
        Binding("y", "agree", show=False),
    ]

    def __init__(self, name: str, unit: str) -> None:
        super().__init__()
        self.asked = name
        self.unit = unit
        self.value: str | None = None

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            unit = f" in {self.unit}" if self.unit else ""
            yield Static(Text(f"write {self.asked}{unit}  (Enter; Esc leaves it)"), id="question")
            yield Input(placeholder="value")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the value and ask whether it is meant, or say why it is no number."""
        event.stop()
        if not event.value.strip():
            return
        question = self.query_one("#question", Static)
        try:
            parse_value(event.value)
        except InvalidCommand as error:
            question.update(Text(f"write {self.asked}: {error}  (Enter; Esc leaves it)"))
            return
        self.value = event.value.strip()
        event.input.remove()
        question.update(Text(f"write {self.asked} = {f'{self.value} {self.unit}'.rstrip()}?  y or n"))

    def action_agree(self) -> None:
        """End the question with the value, once there is one."""
        if self.value is not None:
            self.dismiss(self.value)


class AskWords(Dialog[str]):
    """Asks for the words of which rows are shown. Its result is these; None leaves them as they are."""

    def __init__(self, words: str) -> None:
        super().__init__()
        self.words = words

    def compose(self) -> ComposeResult:
        with Vertical(classes="box"):
            yield Static(Text("show rows with (node, item, group, unit, health, error; Enter; empty for all)"))
            yield Input(self.words, placeholder="all")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the words."""
        event.stop()
        self.dismiss(event.value.strip())


class Show(Dialog[None]):
    """Shows a text, which may change, until a key is pressed that says so."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter,space,q,question_mark", "leave", show=False),
        Binding("up", "scroll(-1)", show=False),
        Binding("down", "scroll(1)", show=False),
    ]

    def __init__(self, text: Text) -> None:
        super().__init__()
        self.text = text

    def compose(self) -> ComposeResult:
        with VerticalScroll(classes="box"):
            yield Static(self.text, id="text")

    def update(self, text: Text) -> None:
        """Show this text in its place."""
        if self.is_mounted:
            self.query_one("#text", Static).update(text)

    def action_scroll(self, lines: int) -> None:
        """Go up or down in a text that is longer than the terminal."""
        self.query_one(VerticalScroll).scroll_relative(y=lines, animate=False)
