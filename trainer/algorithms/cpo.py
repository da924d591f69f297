"""CPO [Achiam 2017]: a trust-region step under a linearised cost constraint."""

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.critics import check_finite, fit_critics
from trainer.learner import Batch, Learner
from trainer.rollout import Figures
from trainer.trust_region import (
    Surrogates,
    conjugate_gradient,
    expected,
    fisher,
    line_search,
    surrogates,
)

LINE_SEARCH = 20
TINY = 1e-8


class Case(IntEnum):
    """Where the constraint's boundary lies with respect to the trust region."""

    RECOVERY = 0
    """The whole trust region is infeasible: reduce the cost only."""
    INFEASIBLE = 1
    """The policy is infeasible, a part of the trust region is feasible."""
    PARTLY = 2
    """The policy is feasible, a part of the trust region is not."""
    FREE = 3
    """The whole trust region is feasible: TRPO's step."""
    FLAT = 4
    """Feasible, and the cost does not depend on the policy: TRPO's step."""


@dataclass(frozen=True)
class Quadratic:
    """The problem max gᵀΔ with ½ ΔᵀHΔ ≤ δ and bᵀΔ + c ≤ 0, in the numbers its solution depends on.

    Attributes:
        q: gᵀH⁻¹g.
        r: −gᵀH⁻¹b; the paper minimises, so its g is our −g.
        s: bᵀH⁻¹b.
        c: the constraint's value at Δ = 0.
        delta: δ, radius of the trust region.
        flat: whether b is (nearly) zero.
    """

    q: float
    r: float
    s: float
    c: float
    delta: float
    flat: bool

    @property
    def reward_curvature(self) -> float:
        """The paper's A = q − r²/s, ≥ 0 by Cauchy and Schwarz."""
        return max(0.0, self.q - self.r**2 / (self.s + TINY))

    @property
    def room(self) -> float:
        """The paper's B = 2δ − c²/s: positive if the boundary cuts the trust region."""
        return 2 * self.delta - self.c**2 / (self.s + TINY)

    @property
    def case(self) -> Case:
        """Which of the five cases applies."""
        if self.c < 0:
            if self.flat:
                return Case.FLAT
            return Case.FREE if self.room < 0 else Case.PARTLY
        return Case.RECOVERY if self.room < 0 else Case.INFEASIBLE


def weights(problem: Quadratic) -> tuple[float, float]:
    """The optimal step Δ = α x + ω p, with H x = g and H p = b (paper, theorem 2).

    Args:
        problem: its numbers.

    Returns:
        α and ω.
    """
    q, r, s, c, delta = problem.q, problem.r, problem.s, problem.c, problem.delta
    if problem.case in (Case.FREE, Case.FLAT):
        return (2 * delta / (q + TINY)) ** 0.5, 0.0
    if problem.case is Case.RECOVERY:
        return 0.0, -((2 * delta / (s + TINY)) ** 0.5)
    A, B = problem.reward_curvature, max(problem.room, TINY)
    side = 1 if c >= 0 else -1
    split = r / c if abs(c) > TINY else math.copysign(math.inf, r * side)
    a_range, b_range = ((split, math.inf), (0.0, split)) if c >= 0 else ((0.0, split), (split, math.inf))
    at_a = _project((A / B) ** 0.5, *a_range)
    at_b = _project((q / (2 * delta)) ** 0.5, *b_range)
    value_a = -0.5 * (A / (at_a + TINY) + B * at_a) - r * c / (s + TINY)
    value_b = -0.5 * (q / (at_b + TINY) + 2 * delta * at_b)
    multiplier = at_a if value_a >= value_b else at_b
    nu = max(0.0, multiplier * c - r) / (s + TINY)
    return 1 / (multiplier + TINY), -nu / (multiplier + TINY)


def _project(value: float, low: float, high: float) -> float:
    """The nearest number ≥ 0 in [low, high]; the upper bound wins where they cross."""
    return max(0.0, min(max(value, low), high))


class CPO(Algorithm):
    """One constrained trust-region step an epoch, with a line search that checks the surrogates.

    In the paper's form c = (J_c − d) / H, in the units of the surrogate E[r A_c], a mean over decisions.
    OmniSafe's form differs in two respects: c = J_c − d, and r has the other sign (it puts the ascent
    direction where the paper has the gradient of what is minimised).
    """

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        config = self.config
        excess = self.episode_cost(figures) - config.cost_limit
        step = cpo_update(self.learner, batch, excess)
        return step | fit_critics(self.learner, batch)


def cpo_update(learner: Learner, batch: Batch, excess: float) -> dict[str, float]:
    """CPO's step.

    Args:
        learner: whose actor moves.
        batch: the epoch.
        excess: by how much the acting policy's episode cost is above its limit.

    Returns:
        Surrogate before the step, the constraint's multiplier ν / λ, the case, share taken, divergence.

    Raises:
        NonFiniteError: if a surrogate or the step is not finite.
    """
    config = learner.config
    paper = config.cpo_form == "paper"
    c = excess / config.episode_decisions if paper else excess
    objective = expected(batch.reward_advantage)
    before = surrogates(learner, batch, objective)
    (g,) = torch.autograd.grad(before.objective, learner.actor, retain_graph=True)
    (b,) = torch.autograd.grad(before.cost, learner.actor)
    reward, cost = before.objective.item(), before.cost.item()
    product = fisher(learner, batch)
    x = conjugate_gradient(product, g, config.cg_iterations)
    p = conjugate_gradient(product, b, config.cg_iterations)
    problem = Quadratic(
        q=float(x @ product(x)),
        r=float(-g @ p if paper else g @ p),
        s=float(b @ p),
        c=c,
        delta=config.trust_kl,
        flat=float(b @ b) <= 1e-6,
    )
    along_x, along_p = weights(problem)
    step: Tensor = along_x * x + along_p * p
    check_finite(
        {
            "policy surrogate": reward,
            "cost surrogate": cost,
            "trust-region step": float(step.sum()),
        }
    )
    case = problem.case

    def accept(found: Surrogates) -> bool:
        improved = case <= Case.INFEASIBLE or bool(found.objective >= reward)
        cheaper = bool(found.cost - cost <= max(-c, 0.0))
        return improved and cheaper and bool(found.divergence <= config.trust_kl)

    share, kl = line_search(learner, batch, objective, step, accept, LINE_SEARCH)
    multiplier = -along_p / along_x if along_x else 0.0
    return {
        "multiplier": multiplier,
        "case": float(case),
        "policy_loss": -reward,
        "step_share": share,
        "kl": kl,
    }
