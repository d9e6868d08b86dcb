"""What a value is said as between programs, and that it comes back as it was."""

from __future__ import annotations

import json
from math import inf, nan
from typing import Any

import pytest

from busmaster.service.messages import encoded, value_of


@pytest.mark.parametrize(
    "value", [None, True, 1, 12.5, "a\n", (1, (2, 3)), inf, -inf, frozenset(), frozenset({0, 5, 31}), (frozenset({7}),)]
)
def test_a_value_comes_back_as_it_was(value: Any) -> None:
    assert value_of(json.loads(encoded(value))) == value


def test_what_is_no_number_comes_back_too() -> None:
    assert str(value_of(json.loads(encoded((nan,))))) == "(nan,)"


def test_what_cannot_be_said_is_refused() -> None:
    with pytest.raises(TypeError, match="a complex cannot be said"):
        encoded(1j)
