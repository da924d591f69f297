"""Never lost: interruptions of every kind, and runs that go on from them bit for bit."""

import csv
import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trainer import checkpoint
from trainer.config import Config
from trainer.errors import CheckpointError, ConfigError, NonFiniteError
from trainer.train import Run, load_config, train

ALGORITHMS = ("ppo", "ppo-lag", "cppo-pid", "scpo", "lagnet", "lagnet-foresight")
SHORT = ["--task", "PointGoal0-v0", "--total-steps", "30000", "--num-envs", "10", "--epoch-steps", "500",
         "--minibatch", "250", "--passes", "1", "--threads", "1", "--checkpoint-every", "2"]  # fmt: skip


def tiny(algorithm, out, **settings):
    return Config(
        algorithm=algorithm, task="Tiny", action_repeat=1,
        out=out, episode_steps=20, num_envs=10, epoch_steps=200, total_steps=2000,
        minibatch=100, passes=2, threads=1, tensorboard=False, checkpoint_every=3, fisher_every=1, **settings,
    )  # fmt: skip


def arrays(folder):
    found, facts = checkpoint.read(folder)
    return found, facts


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(algorithm, tmp_path, tiny_task, monkeypatch):
    make = lambda c: tiny_task(c.num_envs)  # noqa: E731
    train(tiny(algorithm, tmp_path / "whole"), make)

    advance, epochs = Run.advance, iter(range(100))

    def dying(self):
        if next(epochs) == 7:  # two rows after the checkpoint of epoch 6 was written... and one is lost
            raise MemoryError
        return advance(self)

    monkeypatch.setattr(Run, "advance", dying)
    with pytest.raises(MemoryError):
        train(tiny(algorithm, tmp_path / "cut"), make)
    monkeypatch.undo()
    assert (tmp_path / "cut/progress.csv").read_bytes().count(b"\n") == 8
    assert train(Config(resume=tmp_path / "cut"), make).finished
    assert (tmp_path / "cut/progress.csv").read_bytes() == (tmp_path / "whole/progress.csv").read_bytes()
    whole, whole_facts = arrays(tmp_path / "whole")
    cut, cut_facts = arrays(tmp_path / "cut")
    assert whole_facts == cut_facts
    assert whole.keys() == cut.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], cut[name], err_msg=name)


def point(out, **settings):
    """A short run at a level with vases, which fall asleep and have to stay so."""
    return Config(
        algorithm="ppo", task="PointGoal1-v0", out=out, num_envs=4, epoch_steps=400, total_steps=4000,
        minibatch=100, passes=1, threads=1, tensorboard=False, **settings,
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole_point_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("point") / "run"
    train(point(folder, checkpoint_every=100))
    return folder


@pytest.mark.parametrize("stop", [1, 4, 7])
@pytest.mark.parametrize("every", [3, 100])
def test_among_vases_it_goes_on_bit_for_bit_wherever_it_was_stopped(
    whole_point_run, tmp_path, monkeypatch, stop, every
):
    """A stop saves beside the grid of checkpoints; so does every checkpoint for a run with another grid."""
    advance, done = Run.advance, iter(range(1, 100))

    def then_ctrl_c(self):
        row = advance(self)
        if next(done) == stop:
            os.kill(os.getpid(), signal.SIGINT)
        return row

    monkeypatch.setattr(Run, "advance", then_ctrl_c)
    assert not train(point(tmp_path / "run", checkpoint_every=every)).finished
    monkeypatch.undo()
    assert checkpoint.read(tmp_path / "run")[1]["epoch"] == stop
    assert train(Config(resume=tmp_path / "run")).finished
    assert (tmp_path / "run/progress.csv").read_bytes() == (whole_point_run / "progress.csv").read_bytes()
    whole, there = arrays(whole_point_run)[0], arrays(tmp_path / "run")[0]
    for name, value in whole.items():
        np.testing.assert_array_equal(value, there[name], err_msg=name)


def test_without_its_checkpoint_a_run_is_not_begun_anew(whole_point_run, tmp_path):
    folder = shutil.copytree(whole_point_run, tmp_path / "run")
    (folder / checkpoint.FILE).unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    with pytest.raises(CheckpointError, match=rf"holds no {checkpoint.FILE}"):
        train(Config(resume=folder))
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before
    assert before["progress.csv"]


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"task": "PointGoal7-v0"}, "PointGoal7-v0"),
        ({"task": "no task"}, "no task"),
        ({"action_range": (np.nan, 1.0)}, "--action-range"),
        ({"action_range": (0.05, 2.0)}, "--action-range"),
        ({"episode_steps": 1001}, "--episode-steps"),
        ({"cost": "deep"}, "cost"),
        ({"total_steps": 0}, "--total-steps"),
    ],
)
def test_a_start_that_fails_leaves_nothing_behind(tmp_path, wrong, named):
    with pytest.raises(ConfigError, match=named):
        train(replace(point(tmp_path / "new" / "run"), **wrong))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    with pytest.raises(ConfigError, match=named):
        train(replace(point(tmp_path / "run"), **wrong))
    assert list((tmp_path / "run").iterdir()) == []


def test_nor_does_a_disk_that_is_full_at_the_start(tmp_path, tiny_task, monkeypatch):
    def no_space(folder, arrays, facts):
        raise CheckpointError("cannot write: No space left")

    monkeypatch.setattr(checkpoint, "write", no_space)
    with pytest.raises(CheckpointError, match="No space left"):
        train(tiny("ppo", tmp_path / "run"), lambda c: tiny_task(c.num_envs))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    (tmp_path / ".run.part").mkdir()
    (tmp_path / ".run.part" / "config.json").write_text("{")  # killed while it was being made
    assert train(tiny("ppo", tmp_path / "run"), lambda c: tiny_task(c.num_envs)).finished
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("steps", [50, 1500])
def test_episodes_have_the_length_that_was_asked_for(tmp_path, steps):
    config = replace(point(tmp_path / "run"), episode_steps=steps, total_steps=8000)
    train(config)
    with (tmp_path / "run/progress.csv").open() as file:
        lengths = {row["length"] for row in csv.DictReader(file)} - {""}
    assert lengths == {repr(float(steps))}


def start(*arguments, **options):
    command = [sys.executable, "-m", "trainer.train", *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path.cwd())}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, **options)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    process = start("--out", str(folder), *SHORT, "--no-tensorboard")
    assert process.communicate()[0] is None
    assert process.returncode == 0
    return (folder / "progress.csv").read_bytes()


def wait_for(condition, process):
    until = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < until
        time.sleep(0.002)


@pytest.mark.long
def test_kill_at_ten_random_moments(whole_run, tmp_path):
    folder = tmp_path / "run"
    rng = random.Random(0)
    process = start("--out", str(folder), *SHORT, "--no-tensorboard")
    wait_for((folder / checkpoint.FILE).exists, process)
    for _ in range(10):
        table = folder / "progress.csv"
        seen = len(table.read_bytes()) if table.exists() else 0
        wait_for(lambda: table.exists() and len(table.read_bytes()) > seen, process)  # noqa: B023
        time.sleep(rng.uniform(0, 0.05))
        process.kill()
        process.wait()
        checkpoint.read(folder)
        process = start("--resume", str(folder))
        wait_for(lambda: True, process)
        time.sleep(0.5)
    _, message = process.communicate()
    assert process.returncode == 0, message
    assert (folder / "progress.csv").read_bytes() == whole_run


def test_ctrl_c_saves_and_says_how_to_go_on(whole_run, tmp_path):
    folder = tmp_path / "run"
    process = start("--out", str(folder), *SHORT, "--no-tensorboard")
    wait_for(
        lambda: (folder / "progress.csv").exists() and (folder / "progress.csv").stat().st_size > 0, process
    )
    process.send_signal(signal.SIGINT)
    _, message = process.communicate()
    assert process.returncode == 130
    assert f"lagnet-train --resume {folder}" in message
    done = checkpoint.read(folder)[1]["epoch"]
    assert 0 < done < 60
    process = start("--resume", str(folder))
    assert process.wait() == 0
    assert (folder / "progress.csv").read_bytes() == whole_run


def test_a_full_disk_is_told_before_training(tmp_path, tiny_task, monkeypatch):
    def no_space(file: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_space)
    monkeypatch.setattr(Run, "advance", lambda self: pytest.fail("trained"))
    with pytest.raises(CheckpointError, match=r"cannot write .*: No space left"):
        train(tiny("ppo", tmp_path / "run"), lambda c: tiny_task(c.num_envs))


def test_a_full_disk_keeps_the_previous_checkpoint(tmp_path):
    checkpoint.write(tmp_path, {"x": np.arange(3)}, {"epoch": 1})
    (tmp_path / (checkpoint.FILE + ".part")).symlink_to("/dev/full")  # every write: no space left on device
    with pytest.raises(CheckpointError, match="No space left"):
        checkpoint.write(tmp_path, {"x": np.arange(300_000)}, {"epoch": 2})
    found, facts = checkpoint.read(tmp_path)
    assert facts["epoch"] == 1
    np.testing.assert_array_equal(found["x"], np.arange(3))
    assert [p.name for p in tmp_path.iterdir()] == [checkpoint.FILE]


def test_a_folder_that_cannot_be_made_is_told(tmp_path, tiny_task):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot make"):
        train(tiny("ppo", tmp_path / "file" / "run"), lambda c: tiny_task(c.num_envs))


def test_a_folder_in_use_is_refused_and_untouched(tmp_path, tiny_task):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(CheckpointError, match="--resume"):
        train(tiny("ppo", tmp_path), lambda c: tiny_task(c.num_envs))
    assert [p.name for p in tmp_path.iterdir()] == ["notes"]


def test_a_torn_or_foreign_checkpoint_is_told(tmp_path, tiny_task):
    make = lambda c: tiny_task(c.num_envs)  # noqa: E731
    train(tiny("ppo", tmp_path / "run"), make)
    file = tmp_path / "run" / checkpoint.FILE
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no checkpoint at all"):
        file.write_bytes(content)
        with pytest.raises(CheckpointError, match="damaged"):
            train(Config(resume=tmp_path / "run"), make)


def test_a_checkpoint_of_another_shape_is_told(tmp_path, tiny_task):
    train(tiny("ppo", tmp_path / "run"), lambda c: tiny_task(c.num_envs))
    wider = Run(replace(tiny("ppo", None), num_envs=20), tmp_path / "run", tiny_task(20))
    with pytest.raises(CheckpointError, match="does not fit"):
        wider.load()
    other = Run(tiny("lagnet", None), tmp_path / "run", tiny_task(10))
    with pytest.raises(CheckpointError, match="multiplier"):
        other.load()


def test_resume_takes_no_other_flag(tmp_path):
    with pytest.raises(ConfigError, match="no other flag"):
        train(Config(resume=tmp_path, total_steps=5))
    with pytest.raises(CheckpointError, match="no run"):
        train(Config(resume=tmp_path))


def test_the_settings_are_kept(tmp_path, tiny_task):
    config = tiny("lagnet", tmp_path / "run", cost_limit=0.7, rescale="state")
    train(config, lambda c: tiny_task(c.num_envs))
    assert load_config(tmp_path / "run") == replace(config, out=None)


def test_a_value_that_is_not_finite_stops_and_keeps_the_last_good_checkpoint(tmp_path, tiny_task):
    config = tiny("lagnet", tmp_path / "run")
    with pytest.raises(
        NonFiniteError, match=r"reward that is not finite in epoch 5; the checkpoint at 600 steps"
    ):
        train(config, lambda c: tiny_task(c.num_envs, poison_after=90))
    found, facts = checkpoint.read(tmp_path / "run")
    assert facts["epoch"] == 3
    assert all(np.isfinite(value).all() for value in found.values())
    assert train(Config(resume=tmp_path / "run"), lambda c: tiny_task(c.num_envs)).finished
