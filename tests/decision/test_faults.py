"""Faults are counted, and logged once a kind a minute."""

from __future__ import annotations

import logging

from decision import Faults, faults

LOGGER = "lagnet.monitor"


def test_it_counts_and_logs_each_kind_once_a_minute(monkeypatch, caplog) -> None:
    clock = [1000.0]
    monkeypatch.setattr(faults.time, "monotonic", lambda: clock[0])
    noted = Faults()
    with caplog.at_level(logging.WARNING, LOGGER):
        for _ in range(5):
            noted.note("network", "gave NaN")
        noted.note("KeyError", "broken", KeyError("broken"))
        assert [record.message.split(" (")[0] for record in caplog.records] == ["network", "KeyError"]
        assert caplog.records[0].exc_info is None
        assert caplog.records[1].exc_info[0] is KeyError
        clock[0] += 59.0
        noted.note("network", "gave NaN")
        assert len(caplog.records) == 2
        assert noted.internal() == 1
        clock[0] += 2.0
        noted.note("network", "gave NaN")
        assert len(caplog.records) == 3
        assert "7 so far" in caplog.records[2].message
    assert noted.counts == {"network": 7, "KeyError": 1}
    assert noted.internal() == 0  # of the last minute


def test_whoever_has_them_logs_under_a_name_of_its_own(caplog) -> None:
    with caplog.at_level(logging.WARNING, "lagnet"):
        Faults("lagnet.client").note("timeout", "no reply")
    assert caplog.records[0].name == "lagnet.client"
