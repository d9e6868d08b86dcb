"""Codec parts shared by several protocols: checksums, telegram readers, numbers as text. No policy."""
