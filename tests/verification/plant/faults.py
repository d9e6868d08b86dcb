"""All faults that are tried, by a short name."""

from __future__ import annotations

from tests.verification.plant import (
    faults_of_broker,
    faults_of_commands,
    faults_of_files,
    faults_of_line,
    faults_of_run,
    faults_of_scrapes,
)
from tests.verification.plant.trial import Fault

FAULTS: dict[str, Fault] = {
    **faults_of_line.FAULTS,
    **faults_of_broker.FAULTS,
    **faults_of_commands.FAULTS,
    **faults_of_files.FAULTS,
    **faults_of_run.FAULTS,
    **faults_of_scrapes.FAULTS,
}
