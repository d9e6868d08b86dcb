"""What a field is made of."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from busmaster.wire.characters import made_of


@given(st.binary(max_size=8), st.binary(max_size=300))
def test_a_field_stays_as_it_is_if_and_only_if_it_is_made_of_these_characters(field: bytes, characters: bytes) -> None:
    assert (field.translate(made_of(characters)) == field) == (set(field) <= set(characters))


def test_every_other_byte_is_changed() -> None:
    table = made_of(b"0123456789")
    assert [byte for byte in range(256) if table[byte] == byte] == list(b"0123456789")
