"""What a decision may say is in the channels, and is drawn."""

from __future__ import annotations

from dataclasses import fields

from decision import Decision, Mode, OpenedBy
from recorder.channels import DECISION, schemas
from recorder.picture import CAUSES, MODES
from recorder.timeline import FAULT


def test_every_field_of_a_decision_can_be_plotted(observation_layout) -> None:
    plotted = schemas(observation_layout)[DECISION]["properties"]
    assert {field.name for field in fields(Decision)} - {"memory"} <= set(plotted)


def test_every_mode_and_every_cause_has_a_colour() -> None:
    assert set(MODES) == {*Mode, FAULT}
    assert set(CAUSES) == set(OpenedBy)
