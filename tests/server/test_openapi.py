"""What the OpenAPI schema says of the service is so, whatever is sent: no 5xx, no undocumented answer."""

from __future__ import annotations

from collections import Counter

import pytest
import schemathesis
from schemathesis import engine
from schemathesis.config import SchemathesisConfig
from schemathesis.engine import Status, events

from server.app import create_app
from server.keys import Keys

CONFIG = {
    "seed": 1,
    "continue-on-failure": True,
    "cache": {"enabled": False},
    "generation": {"deterministic": True, "database": "none"},
    # A memory that the schema allows may be one that no reply held: that is 422.
    "checks": {
        "positive_data_acceptance": {"enabled": False},
        # What is wrong may be too large as well, which is seen first.
        "negative_data_rejection": {"expected-statuses": [400, 401, 403, 404, 413, 422]},
    },
    # Of a batch, each robot that is not in order is told so within a 200.
    "operations": [
        {
            "include-path": "/act/batch",
            "checks": {
                "negative_data_rejection": {"enabled": False},
                "positive_data_acceptance": {"enabled": False},
            },
        }
    ],
}
ADMIN = {"headers": {"authorization": "Bearer admin"}}


@pytest.mark.parametrize(
    ("examples", "least"), [(10, 300), pytest.param(3300, 10_000, marks=pytest.mark.long)]
)
def test_whatever_is_sent_is_answered_as_documented(monitor, examples: int, least: int) -> None:
    """All phases of schemathesis: examples, coverage, fuzzing, stateful."""
    service = create_app(monitor, keys=Keys(act="act", admin="admin"))
    settings = CONFIG | ADMIN | {"generation": CONFIG["generation"] | {"max-examples": examples}}
    schema = schemathesis.openapi.from_asgi(
        "/openapi.json", service, config=SchemathesisConfig.from_dict(settings), **ADMIN
    )
    cases: Counter[str] = Counter()
    phases, failures = set(), []
    for event in engine.from_schema(schema).execute():
        assert not isinstance(event, events.FatalError | events.NonFatalError), event
        if isinstance(event, events.ScenarioFinished):
            assert event.status not in (Status.ERROR, Status.INTERRUPTED), event.label
            phases.add(event.phase.name)
            cases[event.label or ""] += len(event.recorder.cases)
            for checks in event.recorder.checks.values():
                failures += [each for each in checks if each.failure_info is not None]
    assert not failures, [(each.name, each.failure_info.failure.message) for each in failures[:5]]
    assert sum(cases.values()) >= least, cases
    assert phases >= {"COVERAGE", "FUZZING", "STATEFUL_TESTING"}
