"""Three keys: who may read, who may ask for decisions, who may change things."""

from __future__ import annotations

import hmac
from itertools import product

import pytest
from fastapi.testclient import TestClient

from server.app import create_app
from server.keys import Keys, Level, needed
from server.serve import ServeConfig, ServeError, read_keys

ROLES = ("read", "act", "admin")


def level_of(role: str | None) -> int:
    return 0 if role is None else 1 + ROLES.index(role)


@pytest.mark.parametrize("given", [set(), {"act"}, {"admin"}, {"read", "act"}, {"act", "admin"}, set(ROLES)])
def test_each_key_does_what_the_lower_ones_do_and_no_more(monitor, observation, given: set[str]) -> None:
    app = TestClient(create_app(monitor, keys=Keys(**{role: role for role in given})))
    asked = {"observation": observation}
    requests = {
        "read": [("GET", "/model"), ("GET", "/robots"), ("GET", "/openapi.json"), ("GET", "/nowhere")],
        "act": [("POST", "/act"), ("POST", "/act/batch"), ("GET", "/act"), ("POST", "/act/")],
        "admin": [("POST", "/robots/nobody/reset"), ("DELETE", "/model"), ("PUT", "/nowhere")],
    }
    without = 0 if given else level_of("act")
    for role, sent in product((None, *ROLES, "wrong"), requests):
        valid = level_of(role) if role in given else without
        for method, path in requests[sent]:
            headers = {} if role is None else {"authorization": f"Bearer {role}"}
            status = app.request(method, path, json=asked, headers=headers).status_code
            if valid >= level_of(sent):
                assert status not in (401, 403), (role, path)
            else:
                assert status == (403 if valid else 401), (role, path)
    for path in ("/healthz", "/readyz"):
        assert app.get(path).status_code == 200


@pytest.mark.parametrize("act", [None, "act"])
@pytest.mark.parametrize("path", ["/hold", "/resume", "/model", "/robots/one/reset", "/nowhere"])
def test_without_an_admin_key_nobody_changes_anything(monitor, path: str, act: str | None) -> None:
    """Whatever the path is; and whoever may ask is told why."""
    service = TestClient(create_app(monitor, keys=Keys(act=act)))
    reply = service.post(path, json={}, headers={"x-api-key": "act"})
    assert (reply.status_code, reply.json()["detail"][0]["msg"]) == (403, "the service has no admin key")
    assert service.post(path, headers={"x-api-key": "wrong"}).status_code == (403 if act is None else 401)


def test_every_path_of_the_service_takes_a_key_but_the_two(monitor) -> None:
    service = create_app(monitor)
    for path, methods in TestClient(service).get("/openapi.json").json()["paths"].items():
        for method in methods:
            wanted = needed({"type": "http", "path": path, "method": method.upper()})
            assert (wanted == Level.NOTHING) == (path in ("/healthz", "/readyz")), path
            assert method == "get" or wanted >= Level.ACT


def test_every_key_is_compared_whatever_the_first_says(monkeypatch) -> None:
    compared = []

    def watched(given: bytes, key: bytes) -> bool:
        compared.append(key)
        return given == key

    monkeypatch.setattr(hmac, "compare_digest", watched)
    keys = Keys("r", "a", "x")
    for given in (b"r", b"a", b"x", b"none", b"", b"\xff"):
        compared.clear()
        keys.granted({b"x-api-key": given})
        assert compared == [b"r", b"a", b"x"]


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"read": "r"}, "nobody could ask"),
        ({"read": "same", "act": "same"}, "differ"),
        ({"act": "same", "admin": "same"}, "differ"),
    ],
)
def test_keys_that_do_not_go_together_are_refused(keys, why, monkeypatch, tmp_path) -> None:
    with pytest.raises(ValueError, match=why):
        Keys(**keys)
    for role, variable in zip(ROLES, ("LAGNET_READ_KEY", "LAGNET_API_KEY", "LAGNET_ADMIN_KEY"), strict=True):
        monkeypatch.delenv(variable, raising=False)
        if role in keys:
            monkeypatch.setenv(variable, keys[role])
    with pytest.raises(ServeError, match=why):
        read_keys(ServeConfig(tmp_path))


def test_keys_come_from_files_and_the_environment(monkeypatch, tmp_path) -> None:
    for variable in ("LAGNET_READ_KEY", "LAGNET_API_KEY", "LAGNET_ADMIN_KEY"):
        monkeypatch.delenv(variable, raising=False)
    assert not read_keys(ServeConfig(tmp_path)).any
    (tmp_path / "read").write_text("r\n")
    (tmp_path / "admin").write_text("two words")
    monkeypatch.setenv("LAGNET_API_KEY", "a")
    monkeypatch.setenv("LAGNET_ADMIN_KEY", "x")
    assert read_keys(ServeConfig(tmp_path, read_key_file=tmp_path / "read")) == Keys("r", "a", "x")
    with pytest.raises(ServeError, match="--admin-key-file"):
        read_keys(ServeConfig(tmp_path, admin_key_file=tmp_path / "admin"))
