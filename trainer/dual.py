"""Scalar multipliers and how they follow the episode cost."""

from collections import deque
from dataclasses import dataclass, field

import torch

Numbers = dict[str, float | list[float]]


class AdamMultiplier:
    """λ ≥ 0 by Adam's ascent on λ (J_c − d), as in PPO-Lagrangian [Ray 2019].

    Args:
        value: λ to start with.
        step: Adam's step size.
    """

    def __init__(self, value: float, step: float) -> None:
        self._value = torch.tensor(value, dtype=torch.float64)
        self._adam = torch.optim.Adam([self._value], lr=step, maximize=True)
        self._set(0, 0.0, 0.0)

    @property
    def value(self) -> float:
        """The multiplier λ."""
        return self._value.item()

    def update(self, episode_cost: float, limit: float) -> float:
        """One step with the mean episode cost J_c and the cost limit d; returns λ."""
        self._value.grad = torch.tensor(episode_cost - limit, dtype=torch.float64)
        self._adam.step()
        self._value.clamp_(min=0)
        return self.value

    def state(self) -> Numbers:
        """What load_state needs."""
        adam = self._adam.state[self._value]
        moments = {"first": adam["exp_avg"].item(), "second": adam["exp_avg_sq"].item()}
        return {"value": self.value, **moments, "count": int(adam["step"])}

    def load_state(self, state: Numbers) -> None:
        """Takes on a state."""
        self._value.fill_(number(state["value"]))
        self._set(int(number(state["count"])), number(state["first"]), number(state["second"]))

    def _set(self, count: int, first: float, second: float) -> None:
        """Adam's own state: steps taken and the two moments of the gradient."""
        self._adam.state[self._value] = {
            "step": torch.tensor(float(count)),
            "exp_avg": torch.tensor(first, dtype=torch.float64),
            "exp_avg_sq": torch.tensor(second, dtype=torch.float64),
        }


@dataclass
class PidMultiplier:
    """λ ≥ 0 by a PID controller on the episode cost [Stooke 2020], in OmniSafe's form.

    With Δ = J_c − d: I ← max(0, I + k_i Δ); P ← a P + (1 − a) Δ; C ← a C + (1 − a) J_c;
    D = max(0, C − C ten epochs ago); λ = max(0, k_p P + I + k_d D). Before ten epochs have passed, the
    oldest C there is stands in, at first 0.

    Attributes:
        integral: I.
        kp: gain of P.
        ki: gain in I.
        kd: gain of D.
        smoothing: a.
        delay: epochs between the two C of D.
        proportional: P.
        smoothed: C.
        past: earlier C, the oldest first.
    """

    integral: float
    kp: float
    ki: float
    kd: float
    smoothing: float
    delay: int
    proportional: float = 0.0
    smoothed: float = 0.0
    past: deque[float] = field(default_factory=lambda: deque([0.0]))

    def update(self, episode_cost: float, limit: float) -> float:
        """One step with the mean episode cost J_c and the cost limit d; returns λ."""
        delta = episode_cost - limit
        a = self.smoothing
        self.integral = max(0.0, self.integral + self.ki * delta)
        self.proportional = a * self.proportional + (1 - a) * delta
        self.smoothed = a * self.smoothed + (1 - a) * episode_cost
        rise = max(0.0, self.smoothed - self.past[0])
        self.past.append(self.smoothed)
        if len(self.past) > self.delay:
            self.past.popleft()
        return max(0.0, self.kp * self.proportional + self.integral + self.kd * rise)

    def state(self) -> Numbers:
        """What load_state needs."""
        return {
            "integral": self.integral,
            "proportional": self.proportional,
            "smoothed": self.smoothed,
            "past": list(self.past),
        }

    def load_state(self, state: Numbers) -> None:
        """Takes on a state."""
        self.integral, self.proportional, self.smoothed = (
            number(state[k]) for k in ("integral", "proportional", "smoothed")
        )
        past = state["past"]
        if not isinstance(past, list):
            raise ValueError("past is not a list")
        self.past = deque(past)


def number(value: float | list[float]) -> float:
    """A number out of a checkpoint's facts.

    Raises:
        ValueError: if it is a list.
    """
    if isinstance(value, list):
        raise ValueError(f"expected a number, found a list of {len(value)}")
    return value
