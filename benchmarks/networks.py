"""What the networks cost: ``python -m benchmarks.networks``.

Prints the time of a bundle's pair, as the monitor runs it, of its two files one by one, and of a plain pair:
two perceptrons of 60 → 64 → 64 with tanh, of the observation itself, one file each. Last, whole decisions
with the gate open.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch import nn

from inference import Networks
from inference.session import session
from models import Bundle
from monitor import Monitor
from pointgoal import seeds
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv
from trainer.networks import Shape, initial, mlp
from trainer.onnx_graph import graph


@dataclass
class Arguments:
    """What to measure."""

    bundle: Annotated[Path, tyro.conf.Positional] = Path("models/pointgoal1")
    """The bundle's folder."""
    batches: tuple[int, ...] = (1, 100, 1000)
    """Robots at once."""
    rounds: int = 15
    """Rounds, which take turns; the median counts."""


class Plain(nn.Module):
    """A perceptron of the observation."""

    theta: torch.Tensor

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.shape = Shape(60, outputs)
        self.register_buffer("theta", initial(self.shape, np.random.default_rng(0), 1.0))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(B, outputs), or (B,) where there is one."""
        made = torch.tanh(mlp(self.theta, observation, self.shape))
        return made if self.shape.outputs > 1 else made[:, 0]


def in_turn(calls: dict[str, Callable[[], Any]], rounds: int, count: int) -> dict[str, float]:
    """Median time of each call [us], measured in turn."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            started = time.perf_counter()
            for _ in range(count):
                call()
            times[name].append((time.perf_counter() - started) / count)
    return {name: 1e6 * statistics.median(spent) for name, spent in times.items()}


def observations(count: int) -> np.ndarray[Any, Any]:
    """Real ones (count, 60), of robots at the beginning of their episodes."""
    env = PointGoalVectorEnv(1, count)
    observation, _ = env.reset(seed=seeds.rows(Use.NETWORK_SPEED, 0, count))
    env.close()
    return observation


def main() -> None:
    """Print the table."""
    arguments = tyro.cli(Arguments)
    bundle = Bundle.load(arguments.bundle)
    networks = Networks(bundle)
    apart = session("policy", bundle.policy), session("multiplier", bundle.multiplier)
    plain = (
        session("plain policy", graph(Plain(2), 60, "action")),
        session("plain", graph(Plain(1), 60, "risk")),
    )
    monitor = Monitor.load(arguments.bundle, "always")
    print(f"{bundle.id} [us]; in brackets, times the plain pair")
    print(f"{'robots':>7s} {'plain pair':>11s} {'the pair':>16s} {'file by file':>16s} {'decisions':>18s}")
    for n in arguments.batches:
        seen = observations(n)
        feed = {"observation": seen.astype(np.float32)}

        def decide(seen: np.ndarray[Any, Any] = seen) -> Any:
            return monitor.decide(seen[0]) if len(seen) == 1 else monitor.decide_batch(seen)

        told = in_turn(
            {
                "plain": lambda feed=feed: [one.run(None, feed) for one in plain],  # type: ignore[misc]
                "pair": lambda seen=seen: networks.run(seen),  # type: ignore[misc]
                "apart": lambda feed=feed: [one.run(None, feed) for one in apart],  # type: ignore[misc]
                "decide": decide,
            },
            arguments.rounds,
            max(1000 // n, 20),
        )
        base = told["plain"]
        cells = " ".join(
            f"{told[name]:9.1f} ({told[name] / base:4.2f})" for name in ("pair", "apart", "decide")
        )
        print(f"{n:7d} {base:11.1f} {cells}")


if __name__ == "__main__":
    main()
