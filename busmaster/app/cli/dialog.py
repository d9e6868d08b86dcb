"""The dialogs of the screen, at its bottom: questions, and texts that the user requested."""

from __future__ import annotations

from typing import ClassVar, TypeVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from busmaster import InvalidCommand
from busmaster.app.cli.parsing import parse_value

T = TypeVar("T")
STYLE = """
Dialog { align: center bottom; background: transparent; }
Dialog .box { width: 100%; height: auto; max-height: 100%; border: round ansi_default; background: ansi_default;
    color: ansi_default; padding: 0 1; scrollbar-size: 0 0; }
Dialog Static { color: ansi_default; background: ansi_default; width: 1fr; }
Dialog Input { border: none; height: 1; padding: 0; background: ansi_default; color: ansi_default; }
"""
"""Style sheet of the dialogs, which follows that of the screen."""


class Dialog(ModalScreen[T]):
    """Something at the foot of the picture, which stays in sight above it. Escape leaves it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "leave", show=False)]

    def action_leave(self) -> None:
        """Close the dialog without a result."""
        self.dismiss(None)


class AskYes(Dialog[bool]):
    """Request a confirmation. The result is True for yes, else None."""

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
    """Request a value for `name`, then a confirmation. The result is the value, or None for no."""

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
            yield Static(Text(f"write {self.asked}{unit}  (Enter; Esc cancels)"), id="question")
            yield Input(placeholder="value")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Accept the value and request a confirmation, or show why it is not a number."""
        event.stop()
        if not event.value.strip():
            return
        question = self.query_one("#question", Static)
        try:
            parse_value(event.value)
        except InvalidCommand as error:
            question.update(Text(f"write {self.asked}: {error}  (Enter; Esc cancels)"))
            return
        self.value = event.value.strip()
        event.input.remove()
        question.update(Text(f"write {self.asked} = {f'{self.value} {self.unit}'.rstrip()}?  y or n"))

    def action_agree(self) -> None:
        """End the question with the value, once there is one."""
        if self.value is not None:
            self.dismiss(self.value)


class AskWords(Dialog[str]):
    """Request the words of the row filter. The result is the words; None for no change."""

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
    """Show a text, which may change, until one of its keys is pressed."""

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
