"""Scalar multipliers and how they follow the episode cost."""

from collections import deque
from dataclasses import dataclass, field

Numbers = dict[str, float | list[float]]


@dataclass
class AdamMultiplier:
    """λ ≥ 0 by Adam's ascent on λ (J_c − d), as in PPO-Lagrangian [Ray 2019].

    Attributes:
        value: λ.
        step: Adam's step size.
        first: Adam's first moment of the gradient J_c − d.
        second: its second moment.
        count: steps taken.
    """

    value: float
    step: float
    first: float = 0.0
    second: float = 0.0
    count: int = 0

    def update(self, episode_cost: float, limit: float) -> float:
        """One step with the mean episode cost J_c and the cost limit d; returns λ."""
        gradient = episode_cost - limit
        self.count += 1
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.999 * self.second + 0.001 * gradient**2
        first = self.first / (1 - 0.9**self.count)
        second = self.second / (1 - 0.999**self.count)
        self.value = max(0.0, self.value + self.step * first / (second**0.5 + 1e-8))
        return self.value

    def state(self) -> Numbers:
        """What load_state needs."""
        return {"value": self.value, "first": self.first, "second": self.second, "count": self.count}

    def load_state(self, state: Numbers) -> None:
        """Takes on a state."""
        self.value, self.first, self.second = (number(state[k]) for k in ("value", "first", "second"))
        self.count = int(number(state["count"]))


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
