"""Codec parts that several protocols share: checksums, telegram readers, numbers as text. No policy lives here."""
