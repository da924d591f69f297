"""`lagnet-export`: turns a run into a bundle, after checking that both compute the same."""

import dataclasses
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import onnxruntime
import torch
import tyro
from rich.console import Console
from torch import Tensor

from command import command, progress_bar, settings, terminal, why_not_folder
from models import BundleError, Manifest, ObservationBlock, check_target, write_bundle
from pointgoal import seeds
from pointgoal.observation import HAZARD_RADIUS, layout
from pointgoal.scene import build_scene, robot_constants
from pointgoal.seeds import Use
from trainer import checkpoint, onnx_graph
from trainer.actions import ActionRange
from trainer.algorithms import ALGORITHMS, prepare_environments
from trainer.algorithms.base import Algorithm
from trainer.calibration import Threshold, calibrate
from trainer.closed_loop import Episodes, episodes
from trainer.config import Config
from trainer.errors import CheckpointError, ExportError, TrainerError
from trainer.learner import Learner
from trainer.networks import mlp
from trainer.train import below, load_config, make_environments, why_not_exported
from trainer.warning import WarningConfig, fit

TOLERANCE = 1e-5
"""Largest difference between torch and onnxruntime; relative to the value where that is above 1."""
CHECKED = 1000
"""Real observations on which both are compared."""
ENVIRONMENTS = 50
EXPORTED_BY = ("numpy", "torch", "onnx", "onnxscript", "onnxruntime", "mujoco")
"""Packages whose versions a manifest names."""
NO_NETWORK = 1.0
"""λ of an algorithm without a multiplier network: no state is told from another."""

Precision = Literal["single", "double"]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ExportConfig:
    """Exports the last checkpoint of a run as a bundle: policy.onnx, multiplier.onnx, manifest.json."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder of the bundle to write."""
    episodes: int = 300
    """Deterministic closed-loop episodes that give the bundle its figures and its threshold."""
    threads: int = 2
    """Threads for physics."""
    warning_episodes: int = 300
    """Episodes of each of eight kinds on which λ is fitted to warn, with the policy frozen; 0 exports the
    multiplier that trained it."""
    replace: bool = False
    """Whether a bundle that is there already is replaced."""


class TrainedRun:
    """What a run has learnt, in torch.

    Attributes:
        config: its settings.
        learner: its networks.
        algorithm: its algorithm, which may have a multiplier network.
        steps: environment steps behind it.
        features: the learner's, in double precision.
        multiplier: λ from the networks' inputs [B, m]; None for an algorithm without a multiplier network.
    """

    multiplier: Callable[[Tensor], Tensor] | None

    def __init__(self, folder: Path) -> None:
        """Loads the last checkpoint.

        Raises:
            CheckpointError: if there is none, or it does not fit its settings.
        """
        self.config = load_config(folder)
        arrays, facts = checkpoint.read(folder)
        state = below(arrays, "learner.")
        try:
            inputs = state["normaliser.mean"].shape[0]
            rng = np.random.default_rng(0)
            self.range = ActionRange(**{k: np.asarray(v, np.float32) for k, v in facts["actions"].items()})
            self.learner = Learner(self.config, inputs, self.range, rng)
            self.algorithm: Algorithm = ALGORITHMS[self.config.algorithm](self.learner)
            self.learner.load_state_dict(state)
            self.algorithm.load_state(facts["algorithm"])
            self.steps = int(facts["epoch"]) * self.config.epoch_steps
            for parameters in self.learner.parameters.values():
                parameters.requires_grad_(False)
            self.features = onnx_graph.exact(self.learner.features)
            network = self.algorithm.multiplier_network()
            self.multiplier = None if network is None else partial(network, network=mlp)
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise CheckpointError(f"the checkpoint in {folder} does not fit its settings: {error}") from error

    def actions(self, observation: Floats) -> Floats:
        """The mean action [B, a] within bounds for raw observations [B, n], by torch in double precision."""
        actor, shape = self.learner.actor.detach(), self.learner.actor_shape
        with torch.no_grad():
            drawn = mlp(actor[: shape.size].double(), self._exact(observation), shape)
            return np.asarray(self.range.sent(drawn).numpy())

    def multipliers(self, observation: Floats) -> Floats:
        """λ [B] of raw observations [B, n], likewise; a constant without a multiplier network."""
        if self.multiplier is None:
            return np.full(observation.shape[0], NO_NETWORK, np.float32)
        with torch.no_grad():
            return np.asarray(self.multiplier(self._exact(observation)).numpy())

    def _exact(self, observation: Floats) -> torch.Tensor:
        """The networks' inputs [B, m] in double precision."""
        inputs: torch.Tensor = self.features(torch.from_numpy(observation).double())
        return inputs

    @torch.inference_mode()
    def act(self, observation: Floats) -> Floats:
        """The mean action [B, a] within bounds for raw observations [B, n], as the rollout computes it."""
        learner, shape = self.learner, self.learner.actor_shape
        drawn = mlp(learner.actor[: shape.size], learner.inputs(observation), shape)
        return np.asarray(self.range.sent(drawn).numpy())

    def graphs(self, precision: Precision) -> tuple[bytes, bytes]:
        """policy.onnx and multiplier.onnx."""
        learner, shape = self.learner, self.learner.actor_shape
        features = self.features if precision == "double" else learner.features
        inputs = len(features.normaliser.mean)
        actor = learner.actor[: shape.size]
        policy = onnx_graph.Policy(actor, shape, features, self.range)
        multiplier = (
            onnx_graph.Constant(NO_NETWORK)
            if self.multiplier is None
            else onnx_graph.Multiplier(self.multiplier, features)
        )
        return onnx_graph.graph(policy, inputs, "action"), onnx_graph.graph(multiplier, inputs, "multiplier")


def export(config: ExportConfig, console: Console | None = None) -> Manifest:
    """Writes the bundle of a run.

    Args:
        config: what to export where.
        console: where the progress bar goes; None for none.

    Returns:
        The manifest that was written.

    Raises:
        TrainerError: if the run cannot be read, is of a task that a bundle cannot hold, or if torch and
            onnxruntime differ.
        BundleError: if the bundle cannot be written.
    """
    torch.set_num_threads(1)
    if config.warning_episodes < 0:
        raise ExportError(f"--warning-episodes must be at least 0, not {config.warning_episodes}")
    if config.episodes < 1 or config.threads < 1:
        raise ExportError(
            f"--episodes and --threads must be at least 1, not {config.episodes} and {config.threads}"
        )
    _check_target(config)
    run = TrainedRun(config.run)
    level = _level(run.config)
    fitted = _fit(run, level, config.warning_episodes, console or Console(quiet=True))
    played = play(run, config.episodes, config.threads)
    seen = played.observation[np.isfinite(played.observation).all(-1)]
    rng = seeds.generator(Use.CALIBRATION, run.config.seed)
    checked = seen[rng.choice(len(seen), min(CHECKED, len(seen)), False)]
    (policy, multiplier), differences = graphs(run, checked)
    threshold = _threshold(run, played)
    manifest = Manifest(
        name=config.bundle.resolve().name,
        created=datetime.now(UTC).replace(microsecond=0),
        task=run.config.task,
        level=level,
        algorithm=run.config.algorithm,
        observation_layout=tuple(ObservationBlock(**block) for block in layout(level).to_json()),
        observation_size=layout(level).size,
        action_low=(float(run.range.low[0]), float(run.range.low[1])),
        action_high=(float(run.range.high[0]), float(run.range.high[1])),
        threshold=threshold.value,
        threshold_source=threshold.source,
        multiplier_source=fitted.source,
        hazard_radius=HAZARD_RADIUS,
        robot=robot_constants(build_scene(level)),
        opset=onnx_graph.OPSET,
        training={k: v for k, v in dataclasses.asdict(run.config).items() if k not in {"out", "resume"}},
        figures=_figures(played) | {"steps": float(run.steps)} | differences | fitted.figures,
        versions={name: version(name) for name in EXPORTED_BY},
    )
    return write_bundle(config.bundle, policy, multiplier, manifest).manifest


def play(run: TrainedRun, count: int, threads: int, hold: int = 1, use: Use = Use.CALIBRATION) -> Episodes:
    """Deterministic closed-loop episodes of a run's policy on layouts that training never saw.

    Args:
        run: whose policy plays.
        count: episodes.
        threads: of the simulation.
        hold: control steps that a decision is held for; the episodes' steps are decisions then.
        use: what for; together with the run's seed it says which layouts.
    """
    settings = dataclasses.replace(run.config, num_envs=min(count, ENVIRONMENTS), threads=threads)
    with closing(prepare_environments(settings.algorithm, make_environments(settings), hold)) as env:
        return episodes(
            env,
            run.act,
            seeds.rows(use, run.config.seed, count),
            run.config.episode_steps // hold,
        )


def graphs(run: TrainedRun, observation: Floats) -> tuple[tuple[bytes, bytes], dict[str, float]]:
    """The ONNX graphs in single precision, a third of the time of double, where that computes the same.

    Args:
        run: whose.
        observation: raw observations [B, n] to compare on.

    Returns:
        policy.onnx and multiplier.onnx, and what `compare` found.

    Raises:
        ExportError: if they differ in double precision as well.
    """
    try:
        single = run.graphs("single")
        return single, compare(run, *single, observation)
    except ExportError:
        # A policy that reacts steeply magnifies the rounding.
        double = run.graphs("double")
        return double, compare(run, *double, observation)


def compare(run: TrainedRun, policy: bytes, multiplier: bytes, observation: Floats) -> dict[str, float]:
    """Holds the ONNX graphs against torch in double precision.

    An action is held to the tolerance as a draw: on the way out of the dead zone what is sent moves ten times
    as far as what is drawn, and so does its rounding.

    Args:
        run: the torch side.
        policy: policy.onnx.
        multiplier: multiplier.onnx.
        observation: raw observations [B, n].

    Returns:
        The largest difference of each graph, of the action as it is sent.

    Raises:
        ExportError: if one is above TOLERANCE.
    """
    found = {}
    for name, graph, expected, gain in (
        ("action", policy, run.actions(observation), run.range.gain),
        ("multiplier", multiplier, run.multipliers(observation), np.float32(1.0)),
    ):
        session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
        (computed,) = session.run([name], {"observation": observation})
        difference = np.abs(computed - expected) / np.maximum(1.0, np.abs(expected))
        worst = float((difference / gain).max())
        if not worst <= TOLERANCE:
            raise ExportError(
                f"torch and onnxruntime differ by {worst:.2g} in the {name} "
                f"(at most {TOLERANCE:.0e} is allowed): no bundle written"
            )
        found[f"onnx_difference_{name}"] = float(difference.max())
    return found


def _check_target(config: ExportConfig) -> None:
    """Refuses what could not be written after all, before anything is spent."""
    check_target(config.bundle)
    if why := why_not_folder(config.bundle):
        raise ExportError(f"{config.bundle}: {why}")
    if config.bundle.exists() and not config.replace:
        raise ExportError(f"{config.bundle}: there is a bundle already; --replace replaces it")


def _level(config: Config) -> int:
    if why := why_not_exported(config):
        raise ExportError(why)
    assert config.level is not None
    return config.level


@dataclass(frozen=True)
class _Fitted:
    """What a manifest says of how λ came about."""

    source: str
    figures: dict[str, float]


def _fit(run: TrainedRun, level: int, episodes: int, console: Console) -> _Fitted:
    """Has the run's λ warn, where that is asked for and there is anything to warn of."""
    if not episodes or level == 0:
        return _Fitted(f"as {run.config.algorithm} trained it", {})
    settings = WarningConfig(episodes=episodes)
    with progress_bar(console) as bar:
        job = bar.add_task("fitting λ", total=1.0)
        run.multiplier, figures = fit(
            run.act,
            run.learner.features,
            level,
            run.range.high,
            settings,
            run.config.seed,
            lambda share: bar.update(job, completed=share),
        )
    source = (
        f"fitted with the policy frozen: discounted maximum of violation (1) and barrier below its floor "
        f"({settings.floor}), γ = {settings.discount}, on {figures['warning_states']:.0f} states"
    )
    return _Fitted(source, figures)


def _threshold(run: TrainedRun, played: Episodes) -> Threshold:
    if run.multiplier is None:
        why = f"{run.config.algorithm} has no multiplier network"
        return Threshold(0.0, f"gate always open: {why}", np.empty(0), why)
    multiplier = np.stack([run.multipliers(row) for row in np.nan_to_num(played.observation)])
    return calibrate(multiplier, played.cost)


def _figures(played: Episodes) -> dict[str, Any]:
    violations = np.nansum(played.cost > 0, 0)
    return {
        "episodes": float(played.cost.shape[1]),
        "return": float(played.returns.mean()),
        "cost": float(played.costs.mean()),
        "violating_steps": float(violations.mean()),
        "episodes_with_violation": float((violations > 0).mean()),
    }


def main() -> None:
    """Console script `lagnet-export`."""
    with command("lagnet-export", TrainerError, BundleError, status=1):
        config = settings(ExportConfig, "lagnet-export")
        console = terminal()
        manifest = export(config, console)
        figures = manifest.figures
        console.print(
            f"{config.bundle}: return {figures['return']:.2f}, cost {figures['cost']:.3f} "
            f"over {figures['episodes']:.0f} episodes"
        )
        console.print(f"threshold {manifest.threshold:.4g} ({manifest.threshold_source})")


if __name__ == "__main__":
    main()
