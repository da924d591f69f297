"""`lagnet-train`: the training loop and its command line."""

import dataclasses
import json
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import Any

import numpy as np
import torch
from gymnasium import Space
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from rich.console import Console

from command import INTERRUPTED, command, hint, settings, terminal
from pointgoal import seeds
from pointgoal.seeds import Use
from trainer import checkpoint
from trainer.actions import action_range
from trainer.algorithms import ALGORITHMS, prepare_environments
from trainer.algorithms.base import Algorithm
from trainer.config import FILE as CONFIG
from trainer.config import Config, check
from trainer.errors import CheckpointError, ConfigError, NonFiniteError, TrainerError
from trainer.learner import Learner
from trainer.report import Bar, Events, ProgressFile, Row
from trainer.rollout import Rollout, mean

Environments = VectorEnv[Any, Any, Any]


@dataclass
class Summary:
    """How a call of `train` ended.

    Attributes:
        folder: of the run.
        steps: environment steps done since the run began.
        finished: whether that is all of them (False after Ctrl-C).
        figures: closing figures over the last 500 episodes.
        seconds: wall time of this call by part: simulation, inference, update, other [s].
        trace: (seconds since the start of this call, mean return of the last 100 episodes), one an epoch.
    """

    folder: Path
    steps: int
    finished: bool
    figures: dict[str, float | None]
    seconds: dict[str, float]
    trace: list[tuple[float, float | None]]


def make_environments(config: Config) -> Environments:
    """The task's vector environment.

    Raises:
        ConfigError: if gymnasium does not know the task or cannot make it.
    """
    import gymnasium

    import pointgoal  # noqa: F401 (registers the tasks when run from a source tree)

    arguments: dict[str, Any] = {
        "cost": config.cost,
        "num_threads": config.threads,
        "max_episode_steps": config.episode_steps,
    }
    try:
        return gymnasium.make_vec(config.task, num_envs=config.num_envs, **arguments)
    except (gymnasium.error.Error, TypeError, ValueError) as error:
        raise ConfigError(f"cannot make the task {config.task!r}: {error}") from error


def _box(space: Space[Any]) -> Box:
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise ConfigError(f"the task must have vectors for observations and actions, not {space}")
    return space


class Run:
    """One run: everything that moves from epoch to epoch, and its folder."""

    def __init__(self, config: Config, folder: Path, env: Environments) -> None:
        self.config = config
        self.folder = folder
        self.rng = seeds.generator(Use.TRAINING, config.seed)
        self.actions = action_range(config, _box(env.single_action_space))
        seen = _box(env.single_observation_space)
        self.learner = Learner(config, seen.shape[0], self.actions, self.rng)
        self.algorithm: Algorithm = ALGORITHMS[config.algorithm](self.learner)
        self.rollout = Rollout(env, config, self.rng, self.actions)
        self.epoch = 0
        self.saved = 0

    @property
    def steps(self) -> int:
        """Environment steps done."""
        return self.epoch * self.config.epoch_steps

    def advance(self) -> Row:
        """One epoch: gather, update; returns the row to log.

        Raises:
            NonFiniteError: if a loss or what the environment returned is not finite.
        """
        learner, rollout = self.learner, self.rollout
        learner.start_epoch(self.steps / self.config.total_steps)
        actor = learner.actor.detach().numpy()
        trajectory = rollout.collect(actor, learner.actor_shape, learner.features)
        figures = rollout.figures
        logged = self.algorithm.update(self.algorithm.batch(trajectory), figures)
        seen = trajectory.observation[:-1]
        learner.features.normaliser.update(seen.reshape(-1, seen.shape[-1]))
        self.epoch += 1
        fresh = figures.fresh
        return {
            "epoch": self.epoch,
            "steps": self.steps,
            "episodes": figures.total,
            "episodes_ended": fresh,
            "return": mean(list(figures.returns)[-fresh:] if fresh else []),
            "cost": mean(list(figures.costs)[-fresh:] if fresh else []),
            "length": mean(list(figures.lengths)[-fresh:] if fresh else []),
            "return_100": mean(list(figures.returns)[-100:]),
            "cost_100": mean(list(figures.costs)[-100:]),
            "step_cost": figures.step_cost,
            "action_std": float(np.exp(actor[learner.actor_shape.size :]).mean()),
            **logged,
        }

    def found(self) -> None:
        """Makes the run's folder, whole or not at all: settings, first checkpoint, an empty progress.csv.

        Raises:
            CheckpointError: if it cannot be made.
        """
        folder = self.folder
        half_made = folder.with_name(f".{folder.name}.part")
        try:
            shutil.rmtree(half_made, ignore_errors=True)
            half_made.mkdir(parents=True)
            settings = json.dumps(_plain(self.config), indent=2) + "\n"
            checkpoint.replace(half_made / CONFIG, settings.encode())
            ProgressFile(half_made).close()
            self.folder = half_made
            self.save(0)
            if folder.exists():
                folder.rmdir()
            half_made.rename(folder)
        except OSError as error:
            raise CheckpointError(f"cannot make {folder}: {error.strerror}") from error
        finally:
            self.folder = folder
            shutil.rmtree(half_made, ignore_errors=True)

    def save(self, written: int) -> None:
        """Writes the checkpoint; `written` is the length of progress.csv that belongs to it [bytes].

        Raises:
            CheckpointError: if it cannot be written.
        """
        arrays = {f"learner.{k}": v for k, v in self.learner.state_dict().items()}
        arrays |= {f"rollout.{k}": v for k, v in self.rollout.state_dict().items()}
        facts = {
            "epoch": self.epoch,
            "progress_bytes": written,
            "rng": self.rng.bit_generator.state,
            "algorithm": self.algorithm.state(),
            "actions": {k: v.tolist() for k, v in dataclasses.asdict(self.actions).items()},
        }
        checkpoint.write(self.folder, arrays, facts)
        self.saved = self.epoch

    def load(self) -> int:
        """Takes on the folder's checkpoint; returns the length of progress.csv that belongs to it [bytes].

        Raises:
            CheckpointError: if there is none, or it does not fit this run.
        """
        arrays, facts = checkpoint.read(self.folder)
        try:
            self.learner.load_state_dict(below(arrays, "learner."))
            self.rollout.load_state_dict(below(arrays, "rollout."))
            self.algorithm.load_state(facts["algorithm"])
            self.rng.bit_generator.state = facts["rng"]
            self.epoch = int(facts["epoch"])
            return int(facts["progress_bytes"])
        except (KeyError, ValueError, IndexError) as error:
            raise CheckpointError(
                f"the checkpoint in {self.folder} does not fit this run: {error}"
            ) from error


def below(arrays: dict[str, Any], prefix: str) -> dict[str, Any]:
    """The arrays whose names begin with the prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def train(
    config: Config,
    make: Callable[[Config], Environments] = make_environments,
    console: Console | None = None,
) -> Summary:
    """Trains, or continues, one run.

    Args:
        config: the settings; with `resume` set, everything else is read from that run.
        make: makes the vector environment.
        console: where the progress bar goes; None for none.

    Returns:
        How it ended.

    Raises:
        TrainerError: with one clear line, whatever goes wrong that the user can act on.
    """
    started = perf_counter()
    config, folder = prepare(config)
    resumed = config.resume is not None
    torch.set_num_threads(1)  # jobs run side by side instead, see Learner
    said = console or Console(quiet=True)
    if why := why_not_exported(config):
        said.print(f"note: {why}")
    with closing(prepare_environments(config.algorithm, make(config), config.action_repeat)) as env:
        run = Run(config, folder, env)
        if resumed:
            table = ProgressFile(folder, run.load())
        else:
            # Whatever could be wrong with the settings was tried.
            run.found()
            table = ProgressFile(folder)
        with closing(table), closing(Events(folder, config.tensorboard, run.steps)) as events:
            trace = _loop(run, table, events, said, started)
    spent = dict(run.rollout.seconds)
    spent["total"] = perf_counter() - started
    figures = run.rollout.figures
    return Summary(
        folder=folder,
        steps=run.steps,
        finished=run.epoch >= config.epochs,
        figures={
            "training_return": mean(list(figures.returns)),
            "training_cost": mean(list(figures.costs)),
            "training_constrained": mean(list(figures.constrained)),
            "training_episodes": float(len(figures.costs)),
        },
        seconds=spent,
        trace=trace,
    )


def _loop(
    run: Run, table: ProgressFile, events: Events, console: Console, started: float
) -> list[tuple[float, float | None]]:
    """Epochs until the run is done or Ctrl-C asks to stop, with checkpoints on the way."""
    config = run.config
    trace: list[tuple[float, float | None]] = []
    with _stop_request() as stopping, Bar(config.total_steps, run.steps, console) as bar:
        while run.epoch < config.epochs and not stopping():
            clock = perf_counter()
            try:
                row = run.advance()
            except NonFiniteError as error:
                kept = f"the checkpoint at {run.saved * config.epoch_steps:,} steps is kept in {run.folder}"
                raise NonFiniteError(f"{error} in epoch {run.epoch + 1}; {kept}") from error
            table.add(row)
            if run.epoch % config.checkpoint_every == 0:
                table.sync()
                run.save(table.length)
            rate = config.epoch_steps / (perf_counter() - clock)
            events.add(row | {"steps_per_second": rate}, run.steps)
            bar.show(run.steps, row, rate)
            trace.append((perf_counter() - started, row["return_100"]))
    table.sync()
    run.save(table.length)
    return trace


@contextmanager
def _stop_request() -> Iterator[Callable[[], bool]]:
    """Lets the first Ctrl-C end the current epoch; a second one interrupts at once."""
    asked: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def ask(number: int, _: FrameType | None) -> None:
        asked.append(number)
        signal.signal(signal.SIGINT, before)

    try:
        signal.signal(signal.SIGINT, ask)
    except ValueError:  # only the main thread receives signals; elsewhere there is nothing to ask
        yield lambda: False
        return
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


def prepare(config: Config) -> tuple[Config, Path]:
    """Checks the settings and the run's folder before anything is spent; writes nothing.

    Returns:
        The settings to train with, whose `resume` is set if a run is continued, and the folder.

    Raises:
        ConfigError: if a setting is at fault.
        CheckpointError: if the folder cannot be used.
    """
    if config.resume is not None:
        if config != Config(resume=config.resume):
            raise ConfigError("--resume takes every setting from the run; give no other flag beside it")
        if not (config.resume / checkpoint.FILE).exists():
            load_config(config.resume)
            raise CheckpointError(
                f"{config.resume} holds no {checkpoint.FILE}: there is nothing to go on from; "
                "what else is in it was left as it is"
            )
        return replace(load_config(config.resume), resume=config.resume), config.resume
    check(config)
    if config.out is None:
        raise ConfigError("give the run a folder: --out runs/NAME")
    folder = config.out
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CheckpointError(
            f"{folder} exists and is not empty: choose another --out, "
            f"or continue it with {hint('--resume', folder)}"
        )
    return config, folder


def _plain(config: Config) -> dict[str, Any]:
    values = dataclasses.asdict(replace(config, out=None, resume=None))
    return {name: value for name, value in values.items() if name not in {"out", "resume"}}


def load_config(folder: Path) -> Config:
    """The settings a run was started with.

    Raises:
        CheckpointError: if the folder holds none, or they are not for this version.
    """
    path = folder / CONFIG
    try:
        values = json.loads(path.read_text())
        if values["action_range"] is not None:
            values["action_range"] = tuple(values["action_range"])
        config = Config(**values)
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder} is no run: it holds no {CONFIG}") from error
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    check(config)
    return config


def why_not_exported(config: Config) -> str | None:
    """Why no bundle can be made of what these settings train, or None."""
    if config.level is None:
        return f"a bundle is for a PointGoal task, not {config.task}"
    if config.algorithm == "scpo":
        return "scpo observes more than the robot's sensors give: it cannot be exported"
    return None


def main() -> None:
    """Console script `lagnet-train`."""
    with command("lagnet-train", TrainerError, status=1):
        config = settings(Config, "lagnet-train")
        console = terminal()
        summary = train(config, console=console)
        done = "finished" if summary.finished else "stopped"
        rate = f"{summary.steps / summary.seconds['total']:,.0f}" if not config.resume else "–"
        console.print(f"{done} after {summary.steps:,} steps ({rate} steps/s): {summary.folder}")
        if not summary.finished:
            console.print(f"go on with: {hint('lagnet-train', '--resume', summary.folder)}")
            sys.exit(INTERRUPTED)
        if why_not_exported(load_config(summary.folder)) is None:
            bundle = Path("models") / bundle_name(summary.folder)
            console.print(f"go on with: {hint('lagnet-export', summary.folder, bundle)}")


def bundle_name(run: Path) -> str:
    """A name that a bundle may have for a run's folder: its own, with a dash for what none may hold."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", run.resolve().name).lstrip("._-")[:64]
    return name or "bundle"


if __name__ == "__main__":
    main()
