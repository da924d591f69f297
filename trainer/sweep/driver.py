"""`lagnet-sweep`: gives the runs to Ray, watches them, and takes up again what a lost worker leaves."""

import logging
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Any

from rich.console import Console

from command import command, complain, hint, settings, terminal
from trainer import checkpoint
from trainer.errors import CheckpointError, ConfigError, TrainerError
from trainer.sweep.job import SUMMARY, Job, State, write_summary
from trainer.sweep.settings import FOLDER, Sweep, SweptRun, is_finished, plan, refuse_other_settings
from trainer.sweep.table import Board
from trainer.sweep.worker import TOKEN, Outcome, claim, work

PERIOD = 1.0
"""Between two looks at the runs [s]."""
GRACE = 60.0
"""How long stopped runs have to complete their epoch and write their checkpoint [s]."""
_ANSWER = 10.0
"""How long a cluster has to accept a connection [s]."""
_ATTEMPTS = 3
"""How often a cluster is asked for a connection before that is given up."""
_STORE = 80_000_000
"""Size of Ray's object store on this machine [bytes]: next to nothing passes through it."""


def sweep(settings: Sweep, console: Console) -> list[Job]:
    """Trains all runs of a sweep that are not finished yet.

    Args:
        settings: of the sweep.
        console: where the table goes.

    Returns:
        What has become of each run. On Ctrl-C, some are left stopped.

    Raises:
        TrainerError: if the sweep cannot begin, or loses its cluster; never because of one run.
    """
    runs = plan(settings)
    root = settings.out.resolve()
    own = root / FOLDER
    try:
        own.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CheckpointError(f"cannot make {own}: {error.strerror}") from error
    with claim(own / "driver", {"node": socket.gethostname(), "pid": os.getpid()}, 0.0):
        jobs = [_begin(run) for run in runs]
        if any(job.active for job in jobs):
            token = token_hex()
            checkpoint.replace(own / TOKEN, token.encode())
            with _ray(settings) as ray:
                Driver(settings, jobs, token, ray).run(console)
        write_summary(root, jobs)
    return jobs


def _begin(run: SweptRun) -> Job:
    """The job of a run as its folder stands."""
    job = Job(run)
    try:
        refuse_other_settings(run)
        if is_finished(run):
            job.state = State.FINISHED
    except CheckpointError as error:
        job.state, job.error = State.FAILED, str(error)
    job.look()
    return job


@contextmanager
def _ray(settings: Sweep) -> Iterator[Any]:
    """Ray, started on this machine or connected to the cluster; disconnected or ended afterwards."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ConfigError("lagnet-sweep needs Ray: pip install 'lagnet[sweep]'") from error
    if settings.address is not None:
        _check_address(settings.address)
    # Before a worker imports numpy: BLAS reads the number of its threads once.
    threads = {f"{library}_NUM_THREADS": str(settings.threads) for library in ("OMP", "OPENBLAS", "MKL")}
    options: dict[str, Any] = {"runtime_env": {"env_vars": threads}, "log_to_driver": False}
    options["logging_level"] = logging.ERROR
    if settings.address is None:
        options |= {"include_dashboard": False, "object_store_memory": _STORE, "num_cpus": settings.cores}
    _connect(ray, settings.address, options)
    try:
        yield ray
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str | None, options: dict[str, Any]) -> None:
    """ray.init; a cluster is asked again, for its client server now and then fails to start at first.

    Raises:
        ConfigError: if Ray does not start, or the cluster refuses to the last.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            ray.init(address or "local", **options)
            return
        except (OSError, RuntimeError, ValueError, TimeoutError) as error:
            if address is None or attempt == _ATTEMPTS:
                raise ConfigError(f"cannot start Ray on {address or 'this machine'}: {error}") from error
            ray.shutdown()


def _check_address(address: str) -> None:
    """Makes sure that something listens there: Ray itself would try for minutes.

    Raises:
        ConfigError: if the address is none, or nothing answers.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(f"--address must be ray://HOST:PORT or HOST:PORT, not {address}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWER).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(f"no Ray cluster answers at {address}: {error}") from error


def _work_here(run: SweptRun, token: str, attempt: int) -> Outcome:
    """`work`, as Ray calls it on a node."""
    import ray

    node = ray.get_runtime_context().get_node_id()[:4]
    return work(run, token, attempt, f"{socket.gethostname()}/{node}")


class Driver:
    """Moves the jobs of a sweep along until none is left, or Ctrl-C."""

    def __init__(self, settings: Sweep, jobs: Sequence[Job], token: str, ray: Any) -> None:
        self._jobs = jobs
        self._retries = settings.retries
        self._token = token
        self._stopping = False
        self._ray = ray
        # A process of its own for each run (max_calls); what to do about a lost one is decided here.
        options = {"num_cpus": settings.threads, "max_retries": 0, "max_calls": 1}
        self._remote = ray.remote(**options)(_work_here)
        self._given: dict[Any, Job] = {}

    def run(self, console: Console) -> None:
        """Runs until every job has ended one way or the other.

        Raises:
            TrainerError: if the cluster is lost.
        """
        try:
            with Board(self._jobs, console) as board:
                for job in self._jobs:
                    if job.active:
                        self._give(job)
                try:
                    while self._given:
                        self._step(board)
                except KeyboardInterrupt:
                    self._stop(board)
        except (self._ray.exceptions.RaySystemError, ConnectionError) as error:
            raise TrainerError(f"the Ray cluster is gone ({error}); call again to go on") from error

    def _give(self, job: Job) -> None:
        """Puts a job into Ray's queue."""
        job.attempt += 1
        job.started_at = job.progress.steps
        job.state = State.WAITING
        self._given[self._remote.remote(job.run, self._token, job.attempt)] = job

    def _step(self, board: Board) -> None:
        """Waits a moment and takes in what has changed."""
        ended, _ = self._ray.wait(list(self._given), num_returns=len(self._given), timeout=PERIOD)
        for reference in ended:
            self._take(reference)
        for job in self._given.values():
            job.look()
        board.show()

    def _take(self, reference: Any) -> None:
        """Takes in how a worker ended."""
        job = self._given.pop(reference)
        job.look()
        errors = self._ray.exceptions
        try:
            outcome: Outcome = self._ray.get(reference)
        except errors.RayError as error:
            if self._stopping:
                job.state = State.STOPPED
            elif isinstance(error, errors.RayTaskError):
                job.state, job.error = State.FAILED, str(error).strip()
            else:
                self._lost(job, error)
        else:
            job.error = outcome.error
            job.state = State.STOPPED if outcome.error is None else State.FAILED
            if outcome.finished:
                job.state = State.FINISHED

    def _lost(self, job: Job, error: Exception) -> None:
        """Its worker or the worker's node died: another one continues, unless that leads nowhere."""
        job.lost = 0 if job.progress.steps > job.started_at else job.lost + 1
        if job.lost <= self._retries:
            self._give(job)
        else:
            reason = str(error).strip().splitlines()[0]
            job.state, job.error = State.FAILED, f"lost {job.lost} workers without any progress: {reason}"

    def _stop(self, board: Board) -> None:
        """Asks the workers to save and end; a second Ctrl-C no longer waits for them."""
        self._stopping = True
        for reference in self._given:
            self._ray.cancel(reference)
        deadline = time.monotonic() + GRACE
        try:
            while self._given and time.monotonic() < deadline:
                self._step(board)
        except KeyboardInterrupt:
            pass
        for job in self._jobs:
            if job.active:
                job.state = State.STOPPED
        self._given.clear()


def main() -> None:
    """Console script `lagnet-sweep`."""
    with command("lagnet-sweep", TrainerError, status=1):
        console = terminal()
        chosen = settings(Sweep, "lagnet-sweep")
        try:
            jobs = sweep(chosen, console)
        except KeyboardInterrupt:
            console.print("stopped before anything began")
            raise
        sys.exit(_report(chosen.out, jobs, console))


def _report(folder: Path, jobs: Sequence[Job], console: Console) -> int:
    """Says how the sweep ended; returns the exit code: 0 all finished, 130 stopped, 1 something failed."""
    for job in jobs:
        if job.error is not None:
            complain(job.run.name, job.error)
    states = [job.state for job in jobs]
    done = states.count(State.FINISHED)
    console.print(f"{done} of {len(jobs)} runs finished: {folder / SUMMARY}")
    if done == len(jobs):
        console.print(f"see them with: {hint('lagnet-plot', folder)}")
        return 0
    console.print(f"go on with the same command: {hint('lagnet-sweep', *sys.argv[1:])}")
    return 130 if State.STOPPED in states else 1
