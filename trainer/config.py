"""The settings of a training run: one flat dataclass, every field a command-line flag."""

import dataclasses
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from trainer.errors import ConfigError

FILE = "config.json"

AlgorithmName = Literal[
    "ppo", "ppo-lag", "trpo-lag", "cppo-pid", "ipo", "cpo", "scpo", "lagnet", "lagnet-foresight"
]


@dataclass(frozen=True)
class Config:
    """Trains one policy (and, where the algorithm has one, its multiplier network) on one task."""

    algorithm: AlgorithmName = "lagnet"
    """Learning algorithm. `lagnet` is the paper's; `lagnet-foresight` is ours."""
    task: str = "PointGoal1-v0"
    """Gymnasium id of the task; it must offer a vector environment that reports info["cost"]."""
    cost: Literal["depth", "indicator"] = "depth"
    """Cost of a step: depth inside the hazards [m] (the paper's), or 1 inside any hazard."""
    cost_limit: float = 1.0
    """Cost limit d on the undiscounted cost of an episode; the state-wise limit is w = d / episode_steps."""
    total_steps: int = 3_000_000
    """Environment steps to train for, over all environments together."""
    seed: int = 0
    """Seed of everything random: layouts, initial weights, exploration, minibatches."""
    out: Path | None = None
    """Folder of the run (by convention runs/NAME). Must be new or empty."""
    resume: Path | None = None
    """Continue the run in this folder from its last checkpoint; takes no other flag."""

    num_envs: int = 80
    """Environments stepped side by side."""
    action_repeat: int = 5
    """Control steps that a decision is held for during training; the exported policy decides every step."""
    epoch_steps: int = 20_000
    """Control steps between two updates, over all environments; a multiple of num_envs · action_repeat."""
    episode_steps: int = 1000
    """Steps of a full episode [steps]; turns the cost limit into the state-wise limit."""
    threads: int = 2
    """Threads for physics, and for the update (one for the policy, one for the critics)."""

    discount: float = 0.99
    """Discount γ of the reward, a control step."""
    cost_discount: float = 0.99
    """Discount γ of the cost, a control step."""
    gae: float = 0.95
    """λ of generalised advantage estimation for the reward, a decision; also of C̄_ξ's targets."""
    cost_gae: float = 0.8
    """λ of generalised advantage estimation for the cost: where few steps cost anything, longer returns are
    mostly noise."""
    passes: int = 10
    """Passes over an epoch's data in one update, at most."""
    minibatch: int = 500
    """Samples in one minibatch."""
    learning_rate: float = 5e-4
    """Adam's step size for the actor; decays linearly to zero over the run."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    clip: float = 0.2
    """ε of PPO's clipped surrogate."""
    kl_stop: float = 0.02
    """An update ends early once a pass moved the policy by more than this mean KL divergence."""
    entropy: float = 0.002
    """Weight of the entropy bonus in PPO's objective; decays linearly to zero over the run."""
    gradient_clip: float = 40.0
    """Largest norm of a gradient, for the actor, the critics and the multiplier network each."""
    critic_l2: float = 0.0
    """Weight of Σ p² over the critics' parameters in their loss (OmniSafe's is 0.001)."""
    nearness: float = 0.25
    """Distance [m] over which the nearness of a hazard falls by a factor e in what the networks see of the
    surroundings (features.Surroundings); 0 leaves all that out."""
    action_range: tuple[float, ...] | None = None
    """Largest size of each action that the policy uses, which is also its unit. Not set: 0.05 for the point
    robot's thrust, which saturates there, and 1 for its turning; the task's bounds elsewhere."""
    saturation: float = 0.05
    """Weight, in PPO's objective, of the squared excess of the policy's mean over the action range: keeps it
    exploring."""
    initial_log_std: float = 0.0
    """Initial log standard deviation of the policy's actions."""
    final_log_std: float = -2.0
    """Largest log standard deviation in the last tenth of the run; the bound falls in the second half. What
    is learnt with much noise need not hold without: a robot may stay where only noise would move it."""

    rescale: Literal["mean", "state"] | None = None
    """lagnet, lagnet-foresight: divide eq. 14 by 1 + mean λ, or each state's term by 1 + λ_ξ(s) σ_c. Not set:
    "mean" for lagnet, "state" for lagnet-foresight."""
    policy_step: Literal["adam", "trust-region"] | None = None
    """lagnet, lagnet-foresight: how the policy ascends eq. 14: by PPO's passes of Adam over minibatches, or
    once an epoch by TRPO's natural-gradient step. Not set: "adam" for lagnet, "trust-region" for
    lagnet-foresight."""
    limit_share: float = 1.0
    """lagnet, lagnet-foresight: share of the cost limit that the multiplier aims at; below 1, a run whose
    cost still swings about its aim ends within the limit."""
    multiplier_init: float = 20.0
    """lagnet: the value λ_ξ(s) starts at in every state (the paper's is about 20)."""
    multiplier_learning_rate: float = 3e-4
    """lagnet: Adam's step size for the multiplier network's ascent on eq. 15."""
    multiplier_passes: int = 1
    """lagnet: passes of that ascent over an epoch (at most `passes`)."""

    foresight: float = 0.99
    """lagnet-foresight: discount γ_f of the future cost that C̄_ξ(s) adds up, a control step (0.99: 2 s)."""
    foresight_init: float = 0.25
    """lagnet-foresight: the value C̄_ξ(s) starts at in every state."""
    foresight_learning_rate: float = 1e-3
    """lagnet-foresight: Adam's step size for the regression of C̄_ξ."""
    foresight_passes: int = 5
    """lagnet-foresight: passes of that regression over an epoch (at most `passes`)."""
    foresight_power: float = 0.5
    """lagnet-foresight: p of λ_ξ(s) = β C̄_ξ(s)^p; 0 makes λ the same in every state."""
    scale_init: float = 3.0
    """lagnet-foresight: the value the scale β starts at."""
    scale_gain: float = 0.08
    """lagnet-foresight: log β moves by this much an epoch for each unit of episode cost above d."""
    scale_step: float = 0.05
    """lagnet-foresight: largest change of log β in an epoch."""

    dual_init: float = 0.001
    """ppo-lag, trpo-lag, cppo-pid: the value the multiplier (for cppo-pid its integral) starts at."""
    dual_learning_rate: float = 0.035
    """ppo-lag, trpo-lag: Adam's step size for the multiplier's ascent."""
    pid_kp: float = 0.1
    """cppo-pid: gain of the proportional part."""
    pid_ki: float = 0.01
    """cppo-pid: gain of the integral part."""
    pid_kd: float = 0.01
    """cppo-pid: gain of the derivative part."""
    pid_smoothing: float = 0.95
    """cppo-pid: smoothing of the proportional and the derivative part."""
    pid_delay: int = 10
    """cppo-pid: epochs between the two costs of the derivative part."""
    ipo_form: Literal["log-barrier", "omnisafe"] = "log-barrier"
    """ipo: the paper's logarithmic barrier, or the penalty that OmniSafe puts in its place."""
    ipo_sharpness: float = 20.0
    """ipo: t of the barrier −log(d − J_c) / t (the paper's is 20)."""
    ipo_kappa: float = 0.01
    """ipo: κ of OmniSafe's penalty κ / (d − J_c)."""
    trust_kl: float = 0.01
    """trpo-lag, cpo, scpo, lagnet-foresight: radius δ of the trust region, as a KL divergence."""
    cg_iterations: int = 15
    """trpo-lag, cpo, scpo, lagnet-foresight: iterations of conjugate gradients."""
    damping: float = 0.1
    """trpo-lag, cpo, scpo, lagnet-foresight: multiple of the identity added to the Fisher matrix."""
    fisher_every: int = 4
    """trpo-lag, cpo, scpo, lagnet-foresight: every how-many-th sample goes into the Fisher products."""
    cpo_form: Literal["paper", "omnisafe"] = "paper"
    """cpo, scpo: the step as the paper derives it, or with OmniSafe's sign and unit of the constraint."""

    checkpoint_every: int = 10
    """Epochs between two checkpoints. One is also written at the start, at the end and on Ctrl-C."""
    tensorboard: bool = True
    """Also write TensorBoard events into the run's folder."""

    @property
    def state_limit(self) -> float:
        """State-wise limit w = d / episode_steps [cost per step]."""
        return self.cost_limit / self.episode_steps

    @property
    def horizon(self) -> int:
        """Decisions of each environment in one epoch (T)."""
        return self.epoch_steps // (self.num_envs * self.action_repeat)

    @property
    def episode_decisions(self) -> int:
        """Decisions of a full episode (H)."""
        return self.episode_steps // self.action_repeat

    def per_decision(self, discount: float) -> float:
        """A discount for a decision from one for a control step."""
        return float(discount**self.action_repeat)

    @property
    def level(self) -> int | None:
        """The level of a PointGoal task; None for another task."""
        match = re.fullmatch(r"PointGoal([012])-v\d+", self.task)
        return None if match is None else int(match[1])

    @property
    def epochs(self) -> int:
        """Epochs in the run; the last one completes total_steps."""
        return math.ceil(self.total_steps / self.epoch_steps)


_POSITIVE = (
    "total_steps", "num_envs", "action_repeat", "epoch_steps", "episode_steps", "threads", "passes",
    "minibatch",
    "learning_rate", "critic_learning_rate", "clip", "kl_stop", "gradient_clip",
    "multiplier_learning_rate", "multiplier_passes", "checkpoint_every", "foresight_init",
    "foresight_learning_rate", "foresight_passes", "scale_init", "scale_step", "limit_share",
    "dual_learning_rate", "pid_delay",
    "ipo_sharpness", "ipo_kappa", "trust_kl", "cg_iterations", "fisher_every",
)  # fmt: skip
_NOT_NEGATIVE = (
    "cost_limit", "seed", "entropy", "nearness", "saturation", "critic_l2", "multiplier_init",
    "foresight_power", "scale_gain", "dual_init", "pid_kp", "pid_ki", "pid_kd", "damping",
)  # fmt: skip
_FRACTION = ("discount", "cost_discount", "gae", "cost_gae", "foresight", "pid_smoothing")


def check(config: Config) -> None:
    """Refuses settings that cannot work.

    Args:
        config: the settings to check.

    Raises:
        ConfigError: names the first field at fault, its value and what it must be.
    """
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{_flag(name)} must be a finite number, not {value}")
    for name in _POSITIVE:
        if values[name] <= 0:
            raise ConfigError(f"{_flag(name)} must be above 0, not {values[name]}")
    for name in _NOT_NEGATIVE:
        if values[name] < 0:
            raise ConfigError(f"{_flag(name)} must not be negative, not {values[name]}")
    for name in _FRACTION:
        if not 0 <= values[name] <= 1:
            raise ConfigError(f"{_flag(name)} must lie between 0 and 1, not {values[name]}")
    _check_multiples(config)


def _check_multiples(config: Config) -> None:
    decisions = config.num_envs * config.action_repeat
    if config.epoch_steps % decisions:
        raise ConfigError(
            f"--epoch-steps ({config.epoch_steps}) must be a multiple of "
            f"--num-envs × --action-repeat ({decisions})"
        )
    if config.episode_steps % config.action_repeat:
        raise ConfigError(
            f"--episode-steps ({config.episode_steps}) must be a multiple of "
            f"--action-repeat ({config.action_repeat})"
        )


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
