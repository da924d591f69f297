"""The filter's record: a line is run once, and the shares of its steps add up."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import filter_closed_loop as loop
from decision import Origin


@pytest.fixture(scope="module")
def outcome() -> loop.Outcome:
    return loop.run(loop.Line("attacker", "plain", "given", "always", "ahead"), episodes=3)


def test_the_shares_of_the_steps_add_up(outcome: loop.Outcome) -> None:
    shares = outcome.shares
    assert shares["open"] == 1.0
    assert 0.0 < sum(shares[f"by {origin}"] for origin in Origin) < 1.0
    assert shares["replaced"] <= shares["by guide"] + 1e-12
    assert outcome.violations.sum() == 0
    assert outcome.least > 0.0


def test_a_kept_line_is_not_run_again(tmp_path: Path, monkeypatch, capsys, outcome: loop.Outcome) -> None:
    lines = [loop.Line("attacker", "plain", "given", "always", strength) for strength in ("off", "ahead")]
    ran: list[loop.Line] = []

    def run(line: loop.Line, episodes: int, seed: int) -> loop.Outcome:
        ran.append(line)
        return outcome

    monkeypatch.setattr(loop, "lines", lambda: iter(lines))
    monkeypatch.setattr(loop, "run", run)
    kept = tmp_path / "kept.csv"
    for _ in range(2):
        monkeypatch.setattr("sys.argv", ["loop", "--episodes", "3", "--out", str(kept)])
        loop.main()
    assert ran == lines
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["loop", "--print", "--out", str(kept)])
    loop.main()
    table = capsys.readouterr().out.strip().splitlines()
    assert len(table) == 4
    assert {line.count("|") for line in table} == {table[0].count("|")}
    assert f"{outcome.returns.mean():.2f}" in table[2]


def test_every_line_is_of_a_world_and_none_stands_twice() -> None:
    lines = list(loop.lines())
    assert len(set(lines)) == len(lines)
    assert {line.world for line in lines} <= set(loop.WORLDS)
    assert np.isclose(loop.WORLDS["off"].config.travel_error, 0.3)
