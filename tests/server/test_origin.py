"""What a browser may ask for on behalf of a page: of ours everything, of others nothing that changes."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from server.app import create_app
from server.guard import Guard
from server.keys import Keys

PATHS = ("/act", "/act/batch", "/alarms/latency/acknowledge", "/hold")
PLAIN = {"content-type": "text/plain"}
"""What a page may post to any address without asking first."""


def scope(path: str, **headers: str) -> dict[str, object]:
    sent = [(name.encode(), value.encode()) for name, value in headers.items()]
    return {"path": path, "method": "POST", "headers": sent}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("headers", "foreign"),
    [
        ({}, False),
        ({"origin": "http://testserver"}, False),
        ({"origin": "https://testserver"}, False),  # a proxy before it speaks TLS
        ({"origin": "https://robots.example", "sec-fetch-site": "same-origin"}, False),
        ({"sec-fetch-site": "none"}, False),
        ({"origin": "http://evil.example"}, True),
        ({"origin": "http://testserver:81"}, True),
        ({"origin": "http://testserver.evil.example"}, True),
        ({"origin": "null"}, True),
        ({"origin": "http://testserver", "sec-fetch-site": "same-site"}, True),
        ({"sec-fetch-site": "cross-site"}, True),
    ],
)
def test_another_sites_page_changes_nothing(monitor, path: str, headers, foreign: bool) -> None:
    service = TestClient(create_app(monitor, keys=Keys(admin="admin")), headers={"x-api-key": "admin"})
    reply = service.post(path, content="{}", headers=PLAIN | headers)
    assert (reply.status_code == 403) == foreign
    if foreign:
        assert reply.json()["detail"][0]["loc"] == ["header", "origin"]
    assert service.get("/model", headers=headers).status_code == 200


def test_a_foreign_page_is_refused_without_a_key_too_and_is_no_robot(monitor, observation) -> None:
    guard = create_app(monitor)
    page = TestClient(guard, headers=PLAIN | {"origin": "http://evil.example"})
    assert page.post("/act", json={"observation": observation}).status_code == 403
    assert guard.refusals[403] == 1
    assert TestClient(guard).post("/act", json={"observation": observation}).status_code == 200
    assert guard.is_robots(scope("/act", host="localhost"))
    assert not guard.is_robots(scope("/act", host="localhost", origin="http://evil.example"))
    assert not guard.is_robots(scope("/act", host="evil.example"))


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("localhost:8000", True),
        ("lagnet.localhost", True),
        ("127.0.0.1:8000", True),
        ("[::1]:8000", True),
        ("robot1:8000", True),
        ("evil.example:8000", False),
        ("evil.example", False),
        ("evil.example.", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
    ],
)
def test_a_name_that_somebody_has_lead_here_is_not_ours(monitor, host: str, own: bool) -> None:
    """Its pages would be of our own site (DNS rebinding); a service with a key needs no such rule."""

    def statuses(service: Guard, **headers: str) -> set[int]:
        asked = TestClient(service, headers={"host": host} | headers)
        return {asked.get(path).status_code for path in ("/", "/model", "/healthz")}

    assert statuses(create_app(monitor)) == {200 if own else 403}
    assert statuses(create_app(monitor, keys=Keys(act="secret")), authorization="Bearer secret") == {200}
