"""λ that warns: fitted after training, with the policy frozen, on the states that a deployed robot visits.

Eq. 15 is linear in λ, so in every state its optimum is 0 or infinity. With a quadratic penalty,
max E[λ(s) (C̄(s) − w) − λ(s)² / 2], it is [E[C̄ | s] − w]₊, the regression of what follows the state. Training
takes C̄ as a sum of costs, which the policy trades against its return. A gate asks something else: how near is
the next moment at which the filter would be needed? So here w = 0 and C̄ is the discounted maximum (as in
Fisac et al., *Bridging Hamilton-Jacobi safety analysis and reinforcement learning*, 2019)

    C̄(s_t) = max_k γ^k c(s_{t+k}),   c = 1 in a violation, f where the barrier is below its floor, else 0,

of the policy driving on by itself. Its λ lies in [0, 1]: 1 in a violation, γ^k where one is sure to come in k
steps, less where it may not come. Between 0 and 1 cross-entropy has the minimiser of squares, E[C̄ | s], and
finds it sooner. λ sees the observation alone, through the policy's own features.

States: the policy's own; those that it gets to when it is disturbed; and those that it is in when the filter
lets go of it, for the gate opens and closes: a filter with hazards given or by the lidar drives for a while,
then the policy alone, and only what the latter did is learnt from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from decision import MEMORY
from filter import BarrierFilter, FilterConfig
from guide import Guide
from pointgoal import seeds
from pointgoal.loop import drive
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv
from trainer.features import Features
from trainer.networks import Shape, fast_mlp, initial, mlp

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Policy = Callable[[Floats], Floats]

HORIZON = 60
"""Control steps that must be known after a state to learn from it: γ^60 is below 0.1."""
_FILTERED, _ALONE = (5, 60), (80, 160)
"""How long the filter drives and how long the policy drives alone, at least and at most [steps]."""
_SIGMAS = (0.0, 0.0, 0.3, 0.6, 1.0)
"""Action noise of the disturbed robots, in parts of the largest action."""
_KICK_RATE, _KICK = 0.01, (5, 25)
"""How often a disturbed robot begins to do something at random, and for how long [steps]."""


@dataclass(frozen=True)
class WarningConfig:
    """How λ is fitted.

    Attributes:
        episodes: of each of the eight kinds of drive.
        discount: γ a control step.
        floor: c where the barrier is below its floor.
        minibatches: steps of Adam.
        minibatch: states in each.
        learning_rate: at first; it falls to 0 as a cosine.
        hidden: units of each of λ's two hidden layers.
    """

    episodes: int = 300
    discount: float = 0.96
    floor: float = 0.22
    minibatches: int = 20_000
    minibatch: int = 2000
    learning_rate: float = 1e-3
    hidden: int = 128


@dataclass(frozen=True)
class Kind:
    """A kind of drive.

    Attributes:
        disturbed: whether some robots' actions are.
        filtered: whether a filter drives in between.
        given: whether it knows the hazards, not their lidar alone.
    """

    disturbed: bool
    filtered: bool
    given: bool = False


KINDS = (
    *(Kind(disturbed, False) for disturbed in (False, False, True, True)),
    *(Kind(disturbed, True, given) for disturbed in (False, True) for given in (False, True)),
)


class FittedMultiplier:
    """λ(s) = σ(f(s)), a perceptron of the features.

    Attributes:
        parameters: of f [P].
        shape: its layer sizes.
    """

    def __init__(self, parameters: Tensor, shape: Shape) -> None:
        self.parameters = parameters
        self.shape = shape

    def __call__(self, inputs: Tensor) -> Tensor:
        """λ [B] for the features [B, m]."""
        return torch.sigmoid(mlp(self.parameters.to(inputs.dtype), inputs, self.shape)[:, 0])


def fit(
    policy: Policy,
    features: Features,
    level: int,
    limit: Floats,
    config: WarningConfig,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[FittedMultiplier, dict[str, float]]:
    """Drives, and fits λ.

    Args:
        policy: raw observations [N, n] → actions [N, 2].
        features: what λ sees of an observation.
        level: of the task, 1 or 2.
        limit: largest action [2].
        config: the settings.
        seed: of layouts, disturbances, weights and minibatches.
        progress: called with the share that is done.

    Returns:
        λ, and figures: states and mean loss of the last thousand minibatches.
    """
    rng = seeds.generator(Use.WARNING, seed)
    layouts = seeds.rows(Use.WARNING, seed, len(KINDS) * config.episodes)
    inputs, targets = [], []
    for k, kind in enumerate(KINDS):
        part = layouts[k * config.episodes : (k + 1) * config.episodes]
        observation, target = gather(policy, level, limit, kind, part, config, rng)
        inputs.append(_features(features, observation))
        targets.append(torch.from_numpy(target))
        progress(0.6 * (k + 1) / len(KINDS))
    found, loss = _regress(
        torch.cat(inputs), torch.cat(targets), config, rng, lambda share: progress(0.6 + 0.4 * share)
    )
    return found, {"warning_states": float(sum(map(len, targets))), "warning_loss": loss}


def gather(
    policy: Policy,
    level: int,
    limit: Floats,
    kind: Kind,
    layouts: list[int],
    config: WarningConfig,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Drives one episode for each layout.

    Returns:
        Observations [S, n] in which the policy was alone and their C̄ [S].
    """
    n = len(layouts)
    env = PointGoalVectorEnv(level=level, num_envs=n, num_threads=1)
    robot_filter = BarrierFilter(guide=Guide(FilterConfig()))
    disturbance = _Disturbance(n, limit, rng) if kind.disturbed else None
    phases = _Phases(n, rng) if kind.filtered else None
    memory = np.zeros(n, MEMORY)
    seen, low, alone = [], [], []

    def act(observation: npt.NDArray[Any], env: PointGoalVectorEnv) -> npt.NDArray[Any]:
        nonlocal memory
        seen.append(observation.astype(np.float32))
        action = policy(seen[-1]).astype(np.float64)
        if disturbance is not None:
            action = disturbance(action)
        # The floor of a filter that has the lidar alone, whatever drives: λ sees no more.
        view = robot_filter.look(observation)
        low.append(view.low)
        filtered = np.zeros(n, np.bool_) if phases is None else phases.step()
        alone.append(~filtered)
        if phases is None:
            return action
        if kind.given:
            view = robot_filter.look(observation, env.hazards_in_body_frame())
        decided = robot_filter.decide(view, action, memory, filtered)
        memory = decided.memory
        return decided.action

    costs = [np.where(step.running, step.cost, 0.0) for step in drive(env, act, layouts)]
    env.close()
    cost = np.where(np.array(costs) > 0.0, 1.0, np.where(np.array(low), config.floor, 0.0))
    target, known = nearness(cost, np.array(alone), config.discount)
    return np.array(seen)[known], target[known].astype(np.float32)


def nearness(
    cost: npt.NDArray[np.float64], alone: Bools, discount: float
) -> tuple[npt.NDArray[np.float64], Bools]:
    """C̄ of every step, as far as the policy drove on alone.

    Args:
        cost: c [T, E].
        alone: whether the policy drove [T, E].
        discount: γ.

    Returns:
        C̄ [T, E], and where it is known [T, E]: the policy drove on for `HORIZON` steps.
    """
    target, known = np.zeros_like(cost), np.zeros_like(alone)
    value, ahead = np.zeros(cost.shape[1]), np.zeros(cost.shape[1], np.int64)
    for t in reversed(range(len(cost))):
        value = np.where(alone[t], np.maximum(cost[t], discount * value), 0.0)
        ahead = np.where(alone[t], ahead + 1, 0)
        target[t], known[t] = value, ahead >= HORIZON
    return target, known


class _Disturbance:
    """Noise on some robots' actions, and now and then something else for a while."""

    def __init__(self, n: int, limit: Floats, rng: np.random.Generator) -> None:
        self._rng = rng
        self._limit = limit.astype(np.float64)
        self._sigma = rng.choice(_SIGMAS, n)
        self._left = np.zeros(n, np.int64)
        self._kick = np.zeros((n, 2))

    def __call__(self, action: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        rng, n = self._rng, len(action)
        noisy = action + self._sigma[:, None] * self._limit * rng.normal(size=(n, 2))
        begins = (self._left == 0) & (rng.random(n) < _KICK_RATE) & (self._sigma > 0.0)
        count = int(begins.sum())
        self._left[begins] = rng.integers(*_KICK, count)
        self._kick[begins] = rng.uniform(-1.0, 1.0, (count, 2)) * self._limit
        noisy = np.where((self._left > 0)[:, None], self._kick, noisy)
        self._left = np.maximum(self._left - 1, 0)
        return np.asarray(np.clip(noisy, -self._limit, self._limit))


class _Phases:
    """Who drives: the filter for a while, then the policy alone."""

    def __init__(self, n: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._filtered = rng.random(n) < 0.5
        self._left = rng.integers(1, _ALONE[1], n)

    def step(self) -> Bools:
        """Whether the filter drives now (n,)."""
        self._left -= 1
        turns = self._left <= 0
        self._filtered = self._filtered ^ turns
        n = len(turns)
        fresh = np.where(self._filtered, self._rng.integers(*_FILTERED, n), self._rng.integers(*_ALONE, n))
        self._left = np.where(turns, fresh, self._left)
        return self._filtered


@torch.inference_mode()
def _features(features: Features, observation: Floats) -> Tensor:
    return torch.cat([features(block) for block in torch.split(torch.from_numpy(observation), 20_000)])


def _regress(
    inputs: Tensor,
    targets: Tensor,
    config: WarningConfig,
    rng: np.random.Generator,
    progress: Callable[[float], None],
) -> tuple[FittedMultiplier, float]:
    shape = Shape(inputs.shape[1], 1, config.hidden)
    parameters = initial(shape, rng, 1.0).requires_grad_()
    optimiser = torch.optim.Adam([parameters], config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.minibatches)
    losses = []
    for step in range(config.minibatches):
        rows = torch.from_numpy(rng.integers(0, len(inputs), config.minibatch))
        logits = fast_mlp(parameters, inputs[rows], shape)[:, 0]
        loss = binary_cross_entropy_with_logits(logits, targets[rows])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % 200 == 0:
            progress(step / config.minibatches)
    return FittedMultiplier(parameters.detach(), shape), float(np.mean(losses[-1000:]))
