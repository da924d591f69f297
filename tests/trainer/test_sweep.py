"""A sweep without Ray: its plan, its locks, its table, and what it does about lost workers."""

import csv
import dataclasses
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro
from rich.console import Console

from trainer import checkpoint
from trainer.config import Config
from trainer.errors import CheckpointError, ConfigError, NonFiniteError
from trainer.sweep import Sweep, driver, sweep
from trainer.sweep.job import Job, Progress, State, write_summary
from trainer.sweep.settings import FOLDER, is_finished, plan, refuse_other_settings
from trainer.sweep.table import Board, table
from trainer.sweep.worker import TOKEN, Outcome, claim, read_holder, work

HEADER = "epoch,steps,episodes,episodes_ended,return,cost,return_100,cost_100,multiplier\n"
QUIET = Console(quiet=True)


def small(out: Path, **changes) -> Sweep:
    settings = Sweep(
        algorithms=("ppo", "lagnet"), cost_limits=(0.5, 2.0), seeds=(3, 4), out=out, total_steps=4000,
        epoch_steps=1000, num_envs=40, action_repeat=5, tensorboard=False,
    )  # fmt: skip
    return replace(settings, **changes)


def begin(config: Config) -> None:
    """A run that has not got any further than its settings."""
    config.out.mkdir(parents=True)
    values = dataclasses.asdict(config)
    settings = {name: value for name, value in values.items() if name not in {"out", "resume"}}
    (config.out / "config.json").write_text(json.dumps(settings))


def report(folder: Path, rows: int) -> None:
    """What a run that has got so far has written."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{i},{1000 * i},{i},1,{i},{i / 10},{i},{i / 10},0.5\n" for i in range(1, rows + 1)]
    (folder / "progress.csv").write_text(HEADER + "".join(lines))


def test_a_plan_has_every_combination_seed_by_seed_with_all_other_flags_handed_on(tmp_path):
    runs = plan(small(tmp_path, minibatch=77))
    assert [run.name for run in runs[:4]] == [
        "ppo-d0.5-s3",
        "ppo-d2.0-s3",
        "lagnet-d0.5-s3",
        "lagnet-d2.0-s3",
    ]
    assert len(runs) == 8
    assert {(run.config.minibatch, run.config.threads, run.config.total_steps) for run in runs} == {
        (77, 1, 4000)
    }
    for run in runs:
        assert run.folder == run.config.out == tmp_path / run.name
        assert run.name == f"{run.config.algorithm}-d{run.config.cost_limit}-s{run.config.seed}"


def test_a_combination_named_twice_runs_once_and_folders_are_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = plan(small(Path("here"), seeds=(3, 3), cost_limits=(2, 2.0)))
    assert [run.folder for run in runs] == [
        tmp_path / "here" / f"{name}-d2.0-s3" for name in ("ppo", "lagnet")
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seeds": ()}, "--seeds must name at least one"),
        ({"cost_limits": (1.0, -1.0)}, "--cost-limit must not be negative"),
        ({"cores": 2, "address": "ray://head:10001"}, "--cores is for this machine"),
        ({"cores": 1, "threads": 2}, "must be at least --threads"),
        ({"retries": -1}, "--retries"),
        ({"epoch_steps": 1001}, "must be a multiple"),
    ],
)
def test_bad_settings_are_refused_before_anything_starts(tmp_path, changes, said):
    with pytest.raises(ConfigError, match=said):
        sweep(small(tmp_path / "out", **changes), QUIET)
    assert not (tmp_path / "out").exists()


def test_the_command_line_takes_lists_and_the_trainers_flags_but_not_those_of_one_run(tmp_path):
    flags = [
        "--algorithms",
        "cpo",
        "ipo",
        "--cost-limits",
        "0.5",
        "1",
        "--seeds",
        "0",
        "7",
        "--out",
        str(tmp_path),
    ]
    settings = tyro.cli(Sweep, args=[*flags, "--task", "PointGoal0-v0", "--total-steps", "5000"])
    assert (settings.algorithms, settings.cost_limits, settings.seeds) == (("cpo", "ipo"), (0.5, 1.0), (0, 7))
    assert settings.threads == 1
    assert settings.task == "PointGoal0-v0"
    for flag in ("--resume", "--seed", "--algorithm", "--cost-limit"):
        with pytest.raises(SystemExit):
            tyro.cli(Sweep, args=[*flags, flag, "0"], console_outputs=False)
    with pytest.raises(SystemExit):
        tyro.cli(Sweep, args=[], console_outputs=False)


def test_a_run_that_was_started_with_other_settings_is_not_continued(tmp_path):
    run = plan(small(tmp_path))[0]
    begin(run.config)
    refuse_other_settings(run)
    other = plan(small(tmp_path, total_steps=9000))[0]
    with pytest.raises(ConfigError, match="started with total_steps 4000, not 9000"):
        refuse_other_settings(other)
    with pytest.raises(ConfigError, match="total_steps"):
        sweep(small(tmp_path, total_steps=9000), QUIET)


def test_only_the_checkpoint_of_the_last_epoch_makes_a_run_finished(tmp_path):
    run = plan(small(tmp_path))[0]
    assert not is_finished(run)
    report(run.folder, 4)  # all rows are there, but the checkpoint that goes with them is not
    assert not is_finished(run)
    for epoch, finished in ((3, False), (4, True)):
        checkpoint.write(run.folder, {}, {"epoch": epoch})
        assert is_finished(run) == finished


def test_a_claim_keeps_others_out_until_its_holder_is_done(tmp_path):
    path = tmp_path / "run"
    with claim(path, {"node": "first", "pid": 1}, 0.0):
        assert read_holder(path)["node"] == "first"
        with (
            pytest.raises(CheckpointError, match=r"in use by another process: .*first"),
            claim(path, {}, 0.2),
        ):
            pass
    with claim(path, {"node": "second"}, 0.0):
        assert read_holder(path) == {"node": "second"}


def test_a_claim_ends_with_its_holders_death(tmp_path):
    path = tmp_path / "run"
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom trainer.sweep.worker import claim\n"
        "with claim(Path(sys.argv[1]), {}, 0.0):\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(CheckpointError), claim(path, {}, 0.0):
            pass
        holder.send_signal(signal.SIGKILL)
        with claim(path, {}, 30.0):
            pass
    finally:
        holder.kill()
        holder.communicate()


def test_a_claim_that_cannot_be_written_is_a_clear_error(tmp_path):
    with pytest.raises(CheckpointError, match="cannot write"), claim(tmp_path / "no" / "run", {}, 0.0):
        pass


@pytest.fixture
def shared(tmp_path):
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / TOKEN).write_text("secret")
    return tmp_path


def test_a_node_that_does_not_share_the_storage_refuses_its_run(shared):
    run = plan(small(shared))[0]
    assert "storage that every node shares" in work(run, "another", 1, "node").error
    (shared / FOLDER / TOKEN).unlink()
    assert "storage that every node shares" in work(run, "secret", 1, "node").error
    assert not run.folder.exists()


def test_a_worker_starts_a_run_or_continues_it(shared, monkeypatch):
    run = plan(small(shared))[0]
    given = []
    monkeypatch.setattr(
        "trainer.train.train", lambda config: given.append(config) or SimpleNamespace(finished=True)
    )
    assert work(run, "secret", 2, "node") == Outcome(True)
    assert read_holder(run.claim)["attempt"] == 2
    assert given[-1] == run.config
    begin(run.config)
    work(run, "secret", 3, "node")
    assert given[-1].resume == run.folder


def test_what_stops_a_run_comes_back_as_one_line(shared, monkeypatch):
    def diverge(config):
        raise NonFiniteError("critic_loss is nan")

    monkeypatch.setattr("trainer.train.train", diverge)
    assert work(plan(small(shared))[0], "secret", 1, "node") == Outcome(False, "critic_loss is nan")


class FakeRay:
    """Ray with one core, whose workers do what the test says: an outcome, or an exception to raise."""

    class Errors:
        class RayError(Exception):
            pass

        class RayTaskError(RayError):
            pass

        class RaySystemError(RayError):
            pass

    exceptions = Errors

    def __init__(self, behaviour) -> None:
        self.behaviour = behaviour
        self.queue: list[tuple[int, tuple]] = []
        self.called: list[tuple[str, int]] = []
        self.cancelled: list[int] = []
        self.ended: dict[int, Outcome | Exception] = {}

    def remote(self, **options):
        assert options["max_retries"] == 0

        def put(*arguments):
            self.queue.append((len(self.called) + len(self.queue), arguments))
            return self.queue[-1][0]

        return lambda function: SimpleNamespace(remote=put)

    def wait(self, references, num_returns, timeout):
        reference, (run, _, attempt) = self.queue[0]
        if reference in self.cancelled:
            self.ended[reference] = self.exceptions.RayError("cancelled")
        else:
            try:
                self.ended[reference] = self.behaviour(run, attempt)
            except self.exceptions.RayError as error:
                self.ended[reference] = error
        self.called.append((run.name, attempt))
        self.queue.pop(0)
        return [reference], []

    def get(self, reference):
        found = self.ended[reference]
        if isinstance(found, Exception):
            raise found
        return found

    def cancel(self, reference):
        self.cancelled.append(reference)


def drive(settings: Sweep, behaviour) -> tuple[dict[str, Job], FakeRay]:
    ray = FakeRay(behaviour)
    jobs = [Job(run) for run in plan(settings)]
    driver.Driver(settings, jobs, "token", ray).run(QUIET)
    return {job.run.name: job for job in jobs}, ray


def test_one_failing_run_does_not_stop_the_others(tmp_path):
    def behave(run, attempt):
        if run.name == "ppo-d0.5-s3":
            return Outcome(False, "return is nan")
        if run.name == "ppo-d2.0-s3":
            raise FakeRay.exceptions.RayTaskError("ZeroDivisionError")
        return Outcome(True)

    jobs, ray = drive(small(tmp_path), behave)
    assert (jobs["ppo-d0.5-s3"].state, jobs["ppo-d0.5-s3"].error) == (State.FAILED, "return is nan")
    assert (jobs["ppo-d2.0-s3"].state, jobs["ppo-d2.0-s3"].error) == (State.FAILED, "ZeroDivisionError")
    assert [job.state for job in jobs.values()].count(State.FINISHED) == 6
    assert len(ray.called) == 8
    assert driver._report(tmp_path, list(jobs.values()), QUIET) == 1


def test_a_run_whose_worker_is_lost_goes_on_as_long_as_it_gets_further(tmp_path):
    def behave(run, attempt):
        if run.name == "ppo-d0.5-s3" and attempt <= 6:
            report(run.folder, attempt)
            raise FakeRay.exceptions.RayError("node died")
        return Outcome(True)

    jobs, _ = drive(small(tmp_path, retries=0), behave)
    assert jobs["ppo-d0.5-s3"].state == State.FINISHED
    assert jobs["ppo-d0.5-s3"].attempt == 7
    assert driver._report(tmp_path, list(jobs.values()), QUIET) == 0


def test_a_run_that_loses_worker_after_worker_without_progress_is_given_up(tmp_path):
    def behave(run, attempt):
        if run.name == "lagnet-d0.5-s4":
            raise FakeRay.exceptions.RayError("worker died\nwith a long story")
        return Outcome(True)

    jobs, _ = drive(small(tmp_path, retries=2), behave)
    job = jobs.pop("lagnet-d0.5-s4")
    assert (job.state, job.attempt) == (State.FAILED, 3)
    assert job.error == "lost 3 workers without any progress: worker died"
    assert {other.state for other in jobs.values()} == {State.FINISHED}


def test_ctrl_c_cancels_what_is_left_and_leaves_it_stopped(tmp_path):
    def behave(run, attempt):
        if run.name == "lagnet-d0.5-s3":
            raise KeyboardInterrupt
        return Outcome(True)

    jobs, ray = drive(small(tmp_path), behave)
    assert [job.state for job in jobs.values()] == [State.FINISHED] * 2 + [State.STOPPED] * 6
    assert len(ray.cancelled) == 6
    assert all(attempt == 1 for _, attempt in ray.called)
    assert driver._report(tmp_path, list(jobs.values()), QUIET) == 130


def test_a_lost_cluster_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setattr(FakeRay, "wait", lambda *_, **__: (_ for _ in ()).throw(ConnectionError("gone")))
    with pytest.raises(driver.TrainerError, match="cluster is gone"):
        drive(small(tmp_path), lambda run, attempt: Outcome(True))


class Refusing:
    """A Ray that cannot be initialised the first few times."""

    def __init__(self, refusals):
        self.refusals, self.calls = refusals, []

    def init(self, address, **options):
        self.calls.append(address)
        self.refusals -= 1
        if self.refusals >= 0:
            raise ConnectionAbortedError("Initialization failure from server")

    def shutdown(self):
        self.calls.append("shutdown")


def test_a_cluster_that_refuses_at_first_is_asked_again():
    ray = Refusing(2)
    driver._connect(ray, "ray://robot:10001", {})
    assert ray.calls == [
        "ray://robot:10001",
        "shutdown",
        "ray://robot:10001",
        "shutdown",
        "ray://robot:10001",
    ]
    with pytest.raises(driver.ConfigError, match=r"cannot start Ray on ray://robot:10001: Initialization"):
        driver._connect(Refusing(3), "ray://robot:10001", {})
    alone = Refusing(1)
    with pytest.raises(driver.ConfigError, match="cannot start Ray on this machine"):
        driver._connect(alone, None, {})
    assert alone.calls == ["local"]


def test_without_ray_the_sweep_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install 'lagnet\[sweep\]'"):
        sweep(small(tmp_path), QUIET)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("ray://127.0.0.1:1", "no Ray cluster answers at ray://127.0.0.1:1"),
        ("127.0.0.1:1", "no Ray cluster answers"),
        ("127.0.0.1:99999999", "no Ray cluster answers"),
        ("ray://head", "must be ray://HOST:PORT"),
        ("head:", "must be ray://HOST:PORT"),
    ],
)
def test_an_address_without_a_cluster_is_told_at_once(tmp_path, address, said):
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match=said):
        sweep(small(tmp_path, address=address), QUIET)


def test_two_sweeps_do_not_share_a_folder(tmp_path):
    (tmp_path / FOLDER).mkdir()
    with claim(tmp_path / FOLDER / "driver", {"pid": 1}, 0.0), pytest.raises(CheckpointError, match="in use"):
        sweep(small(tmp_path), QUIET)


def test_finished_runs_need_no_ray_and_damaged_ones_are_told_apart(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    settings = small(tmp_path, seeds=(3,), cost_limits=(0.5,))
    ppo, lagnet = plan(settings)
    for run in (ppo, lagnet):
        begin(run.config)
        report(run.folder, 4)
        checkpoint.write(run.folder, {}, {"epoch": 4})
    assert {job.state for job in sweep(settings, QUIET)} == {State.FINISHED}
    (lagnet.folder / checkpoint.FILE).write_bytes(b"damaged")
    first, second = sweep(settings, QUIET)
    assert (first.state, second.state) == (State.FINISHED, State.FAILED)
    assert "damaged" in second.error
    rows = list(csv.DictReader((tmp_path / "summary.csv").open()))
    assert [row["state"] for row in rows] == ["finished", "failed"]
    assert [float(rows[0][name]) for name in ("return", "cost", "episodes")] == pytest.approx([2.5, 0.25, 4])


def test_a_summary_has_runs_that_have_not_begun(tmp_path):
    write_summary(tmp_path, [Job(run) for run in plan(small(tmp_path))])
    rows = list(csv.DictReader((tmp_path / "summary.csv").open()))
    assert len(rows) == 8
    assert {(row["state"], row["steps"], row["return"]) for row in rows} == {("waiting", "0", "")}


def test_a_job_is_running_once_its_own_worker_has_claimed_it(shared):
    job = Job(plan(small(shared))[0], attempt=2)
    for attempt, state in ((1, State.WAITING), (2, State.RUNNING)):
        with claim(job.run.claim, {"node": f"n{attempt}", "attempt": attempt}, 0.0):
            job.look()
        assert job.state == state
    report(job.run.folder, 3)
    job.look()
    assert (job.node, job.progress) == ("n2", Progress(3000, 3.0, 0.3, 0.5))


def printed(renderable) -> str:
    console = Console(width=120, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(renderable)
    return console.export_text()


def test_the_table_shows_each_run_and_where_it_stands(tmp_path):
    jobs = [Job(run) for run in plan(small(tmp_path))]
    jobs[5] = replace(
        jobs[5], state=State.RUNNING, node="robot/1f", attempt=2, progress=Progress(2000, 21.25, 1.5, 0.75)
    )
    text = printed(table(jobs, 8))
    line = next(line for line in text.splitlines() if jobs[5].run.name in line)
    for said in ("robot/1f", "2,000 ( 50%)", "21.25", "1.50", "0.75", "running (worker 2)"):
        assert said in line
    assert "1 running · 7 waiting" in text
    few = printed(table(jobs, 2))
    assert jobs[5].run.name in few
    assert few.count("waiting") == 2  # one run, and the count of all


def test_a_log_file_gets_a_line_a_change_and_the_table_once(tmp_path):
    path = tmp_path / "log"
    jobs = [Job(run) for run in plan(small(tmp_path))][:1]
    with path.open("w") as file, Board(jobs, Console(file=file, width=100)) as board:
        for state in (State.WAITING, State.RUNNING, State.RUNNING, State.FINISHED):
            jobs[0].state, jobs[0].node = state, "node"
            board.show()
    lines = path.read_text().splitlines()
    assert [line.split(":")[1].split()[0] for line in lines if line.startswith("ppo")] == [
        "waiting",
        "running",
        "finished",
    ]
    assert sum("┃ run" in line for line in lines) == 1
