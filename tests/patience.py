"""How long a test waits for a fact: until it comes."""

from __future__ import annotations

PATIENCE = 100.0
"""Seconds after which what is waited for will never come. Only a test that fails waits so long, however busy the
machine is: no test may take this, or any other time, for the fact itself."""
