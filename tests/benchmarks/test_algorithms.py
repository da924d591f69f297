"""The comparison of the algorithms: from finished runs to a record, and from the record to tables."""

import csv
import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.algorithms import Result, finished_runs, read_record, tables, write_record
from trainer.config import Config
from trainer.curves import read_curves
from trainer.train import train


def result(algorithm="lagnet", cost_limit=1.0, seed=0, cost=0.5, **values):
    return Result(
        sweep="level1", algorithm=algorithm, settings="", cost_limit=cost_limit, seed=seed, steps=1000,
        training_return=20.0, training_cost=cost, evaluation_return=21.0, evaluation_cost=0.4,
        evaluation_p10=15.0, stepwise_return=20.5, stepwise_cost=0.6, stepwise_p10=12.0,
        violating_steps=10.0, multiplier=2.0, multiplier_peak=20.0, **values,
    )  # fmt: skip


def cells(table, column):
    index = [found.header for found in table.columns].index(column)
    return list(table.columns[index].cells)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "probe"
    for algorithm in ("lagnet-foresight", "scpo"):
        train(
            Config(
                algorithm=algorithm, out=folder / f"{algorithm}-d1.0-s0", total_steps=20_000, num_envs=20,
                epoch_steps=2000, threads=1, tensorboard=False, passes=1, nearness=0.3,
            )
        )  # fmt: skip
    unfinished = Config(
        algorithm="ppo", out=folder / "ppo-d1.0-s0", total_steps=4000, num_envs=20, epoch_steps=2000,
        threads=1, tensorboard=False, passes=1,
    )  # fmt: skip
    train(unfinished)
    config = (folder / "ppo-d1.0-s0/config.json").read_text()
    (folder / "ppo-d1.0-s0/config.json").write_text(config.replace("4000", "6000"))
    return folder


def test_finished_runs_are_put_on_record_once(sweep, tmp_path):
    assert [run.name for run in finished_runs(sweep)] == ["lagnet-foresight-d1.0-s0", "scpo-d1.0-s0"]
    command = [sys.executable, "-m", "benchmarks.algorithms", str(sweep), "--record", str(tmp_path)]
    command += ["--episodes", "3"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "probe" in printed
    assert "│ 1.0 │ lagnet-foresight │" in printed
    found = read_record(tmp_path)
    assert [one.run for one in found] == ["lagnet-foresight-d1.0-s0", "scpo-d1.0-s0"]
    for one in found:
        assert (one.steps, one.settings) == (20_000, "num_envs=20 epoch_steps=2000 passes=1 nearness=0.3")
        curve = read_curves(tmp_path / "probe" / one.run).columns
        whole = read_curves(sweep / one.run).columns
        np.testing.assert_allclose(curve["cost_100"], whole["cost_100"][4::5], rtol=1e-4)
        np.testing.assert_array_equal(curve["steps"], whole["steps"][4::5])
    before = (tmp_path / "runs.csv").read_bytes()
    for run in sweep.glob("*/checkpoint.safetensors"):
        run.rename(run.with_suffix(".away"))  # what is on record needs no run any more
    again = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert again.endswith(printed[printed.index("probe") :])
    assert (tmp_path / "runs.csv").read_bytes() == before


def test_a_limit_is_met_if_every_seed_meets_it():
    good = [result(seed=seed, cost=cost) for seed, cost in enumerate((0.9, 1.0, 0.8))]
    bad = [result("ppo-lag", seed=seed, cost=cost) for seed, cost in enumerate((0.1, 1.001, 0.2))]
    (table,) = tables([*bad, *good])
    assert cells(table, "algorithm") == ["lagnet", "ppo-lag"]
    assert cells(table, "met") == ["yes", "2 of 3"]
    assert cells(table, "worst cost") == ["1.00", "1.00"]


def test_those_that_meet_the_limit_come_first_and_then_the_higher_return():
    rows = [result("ipo", cost=2.0), result("cpo"), dataclasses.replace(result(), evaluation_return=21.5)]
    (table,) = tables([dataclasses.replace(rows[0], evaluation_return=26.0), *rows[1:]])
    assert cells(table, "algorithm") == ["lagnet", "cpo", "ipo"]


def test_ppo_stands_beside_every_limit():
    (table,) = tables([result(), result(cost_limit=2.0), result("ppo", cost_limit=2.0)])
    assert cells(table, "d") == ["1.0", "1.0", "2.0", "2.0"]
    assert cells(table, "algorithm") == ["lagnet", "ppo", "lagnet", "ppo"]
    (alone,) = tables([result("ppo")])
    assert cells(alone, "algorithm") == ["ppo"]


def test_sweeps_of_one_case_are_compared_with_each_other_and_others_stand_alone():
    ours = [result(seed=seed) for seed in range(2)]
    ablation = dataclasses.replace(result(cost=1.5), sweep="ablation", settings="gae=0.9")
    elsewhere = dataclasses.replace(result(cost_limit=3.0), sweep="elsewhere")
    *others, compared = tables([ablation, *ours, result("cpo"), elsewhere])
    assert [table.title for table in others] == ["elsewhere", "level1"]
    assert compared.title == "lagnet at d = 1.0"
    assert cells(compared, "sweep") == ["level1", "ablation"]
    assert cells(compared, "seeds") == ["2", "1"]
    assert cells(compared, "settings") == ["", "gae=0.9"]


def test_the_record_reads_back(tmp_path):
    rows = [result(seed=1), result(seed=0), result("cpo", cost_limit=0.5)]
    write_record(tmp_path, rows)
    assert read_record(tmp_path) == [rows[2], rows[1], rows[0]]
    with (tmp_path / "runs.csv").open() as file:
        assert len(list(csv.reader(file))) == 4
