"""Seeing the wire: recording what passes on a line, reading it back, and decoding it without a master."""
