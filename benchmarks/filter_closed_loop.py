"""The filter in the closed loop: violations and return, by policy, source of the hazards, and what is off.

``python -m benchmarks.filter_closed_loop`` runs what docs/filter.md shows, a line after the other, and keeps
each in a CSV file: lines that are there already are not run again. ``--print`` prints the file as a table.
Every episode is a fresh layout; all run side by side in the vector environment, the filter in one batch.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.record import keep, kept
from decision import MEMORY, Decisions, Origin
from filter import BarrierFilter, FilterConfig, Robot
from guide import DEFAULT_STRENGTH, STRENGTHS, Guide, Strength
from pointgoal import seeds
from pointgoal.lidar import encode, nearest
from pointgoal.loop import drive
from pointgoal.observation import HAZARD_RADIUS, LIDAR_BINS, LIDAR_RANGE, layout
from pointgoal.seeds import Use

FloatArray = NDArray[np.float64]
Policy = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]
"""Observation (N, 60) and hazards in the body frame (N, n, 2) -> actions (N, 2)."""
Source = Literal["given", "lidar"]
Gate = Literal["always", "floor", "none"]
EPISODE_STEPS = 1000
LARGEST = np.array([Robot().force_limit, 1.0])
"""Largest thrust and turn that have an effect."""


@dataclass(frozen=True)
class Off:
    """What is off in the world that the filter does not know of.

    Attributes:
        mass, drag, thrust, turning: factors on the robot's own.
        distance: bound on the error of a hazard's distance [m].
        bearing: bound on the error of its bearing [rad].
        speed: bound on the relative error of the measured velocities.
        gaussian: whether the bounds are standard deviations of normal errors instead.
        bin: what is wrong with one bin of each robot's hazard lidar: it shows nothing, half of what it
            should, or always 0.3.
        old: how many control steps old observations are, and given hazards with them.
        late: how many control steps late actions are.
        lost: share of the actions that do not arrive: the one before stays.
        shaken: standard deviation of a normal error of the actions, as a share of the largest.
    """

    mass: float = 1.0
    drag: float = 1.0
    thrust: float = 1.0
    turning: float = 1.0
    distance: float = 0.0
    bearing: float = 0.0
    speed: float = 0.0
    gaussian: bool = False
    bin: Literal["", "dead", "half", "stuck"] = ""
    old: int = 0
    late: int = 0
    lost: float = 0.0
    shaken: float = 0.0


@dataclass(frozen=True)
class Line:
    """One line of a table: what is run, in what world, behind which filter.

    Attributes:
        policy: a name of `POLICIES`, or a bundle's folder.
        world: a name of `WORLDS`.
        source: where the filter has the hazards from.
        gate: "always"; "floor" opens it where the barrier is low and never else, as the gate `risk` does if λ
            says nothing; "none" is no filter.
        guide: how much the guide may do.
        memory: whether the filter's memory is carried from step to step.
    """

    policy: str
    world: str
    source: Source
    gate: Gate
    guide: Strength
    memory: bool = True


@dataclass(frozen=True)
class Outcome:
    """What E episodes gave.

    Attributes:
        returns: (E,) undiscounted.
        costs: (E,) depth.
        violations: (E,) steps with a cost.
        shares: of all steps: gate open, by origin, and those on which a certified action was replaced.
        least: least distance of the robot to a hazard's edge [m].
        seconds: wall time of the filter a decision.
    """

    returns: FloatArray
    costs: FloatArray
    violations: NDArray[np.int64]
    shares: dict[str, float]
    least: float
    seconds: float


def random_policy(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Uniformly random actions."""
    return rng.uniform(-1.0, 1.0, (len(observation), 2))


def thrust_policy(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Full thrust always, straight ahead."""
    return np.tile([1.0, 0.0], (len(observation), 1))


def _steer(target: FloatArray) -> FloatArray:
    bearing = np.arctan2(target[:, 1], target[:, 0])
    return np.stack([np.ones(len(target)), np.clip(4.0 * bearing, -1.0, 1.0)], axis=1)


def attacker_policy(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Full thrust, steering at the nearest hazard."""
    nearest = np.hypot(hazards[..., 0], hazards[..., 1]).argmin(axis=1)
    return _steer(hazards[np.arange(len(hazards)), nearest])


def seeker_policy(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Steer the velocity at the goal, blind to hazards: a policy by hand that needs no training."""
    goal = goal_from_lidar(observation)
    stop = 0.519 * observation[:, 3:5]
    ahead = goal - 0.5 * stop
    lost = ~np.isfinite(goal[:, 0])
    ahead[lost] = [1.0, 0.0]
    action = _steer(ahead)
    bearing = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
    action[:, 0] = np.where(bearing < 1.0, 1.0, np.where(bearing > 2.0, -1.0, 0.0))
    return action


def goal_from_lidar(observation: FloatArray) -> FloatArray:
    """The goal's centre (N, 2) in the body frame [m]; NaN beyond the lidar's range."""
    x, y, _, seen = nearest(observation[:, layout(1).slice("goal_lidar")])
    return np.where(seen > 0.0, np.concatenate([x, y], axis=1), np.nan)


def bundle_policy(path: Path) -> Policy:
    """The policy of a bundle, deterministic."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path / "policy.onnx"), options)

    def act(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
        (action,) = session.run(["action"], {"observation": observation.astype(np.float32)})
        return np.asarray(action, dtype=np.float64)

    return act


def make_environments(level: int, n: int, off: Sequence[Off]) -> Any:
    """N environments, in which the rows take the robots of ``off`` in turn, in equal shares."""
    from pointgoal.scene import build_scene
    from pointgoal.simulation import Simulation
    from pointgoal.vector import PointGoalVectorEnv

    env = PointGoalVectorEnv(level=level, num_envs=n, num_threads=len(off))
    for part, one in zip(env._slices, off, strict=True):
        model = build_scene(level)
        robot = model.body("robot").id
        model.body_mass[robot] *= one.mass
        model.body_inertia[robot] *= one.mass
        model.dof_damping[:2] *= one.drag
        model.actuator_gear[0] *= one.thrust
        model.actuator_gear[1] *= one.turning
        env.simulations[env._slices.index(part)] = Simulation(level, part.stop - part.start, "depth", model)
    return env


def _perturbed(
    observation: FloatArray, hazards: FloatArray, off: Off, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """What faulty sensors show: observation (N, 60), its hazard lidar made anew, and hazards (N, n, 2)."""

    def error(bound: float, shape: tuple[int, ...]) -> FloatArray:
        return rng.normal(0.0, bound, shape) if off.gaussian else rng.uniform(-bound, bound, shape)

    observation = observation.copy()
    distance = np.hypot(hazards[..., 0], hazards[..., 1])
    bearing = np.arctan2(hazards[..., 1], hazards[..., 0]) + error(off.bearing, distance.shape)
    distance = np.maximum(distance + error(off.distance, distance.shape), 0.0)
    shown = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)
    motion = slice(layout(1).slice("velocimeter").start, layout(1).slice("gyro").stop)
    observation[:, motion] *= 1.0 + error(off.speed, observation[:, motion].shape)
    observation[:, layout(1).slice("hazards_lidar")] = encode(shown)
    return observation, shown


def _with_faults(observation: FloatArray, off: Off, faulty: NDArray[np.bool_]) -> FloatArray:
    """Observations (N, 60) with the bins (N, 16) that are marked as faulty as they are."""
    observation = observation.copy()
    readings = observation[:, layout(1).slice("hazards_lidar")]
    factor, level = {"dead": (0.0, 0.0), "half": (0.5, 0.0), "stuck": (0.0, 0.3)}[off.bin]
    readings[faulty] = factor * readings[faulty] + level
    return observation


class _Late:
    """What N robots are observed as, and what arrives of what they are sent, too late or not at all."""

    def __init__(self, off: Off, n: int, rng: np.random.Generator) -> None:
        self._off = off
        self._rng = rng
        self._seen: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=off.old + 1)
        self._sent = deque([np.zeros((n, 2))] * off.late)
        self._last = np.zeros((n, 2))

    def observed(self, observation: FloatArray, hazards: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The oldest observation (N, O) and hazards that are on the way; at first all are the first one."""
        self._seen.append((observation, hazards))
        return self._seen[0]

    def arrives(self, action: FloatArray) -> FloatArray:
        """What takes effect (N, 2) when an action is sent."""
        self._sent.append(action)
        action = self._sent.popleft()
        if self._off.lost:
            action = np.where(self._rng.random(len(action))[:, None] < self._off.lost, self._last, action)
        self._last = action
        if not self._off.shaken:
            return action
        return action + self._off.shaken * LARGEST * self._rng.normal(size=action.shape)


def run(line: Line, episodes: int, seed: int = 0, chunk: int = 512) -> Outcome:
    """Run the episodes of one line."""
    rows, rng = seeds.rows(Use.FILTER, seed, episodes), seeds.generator(Use.FILTER, seed)
    parts = [_run(line, rows[i : i + chunk], rng) for i in range(0, episodes, chunk)]
    weights = np.array([len(part.returns) for part in parts]) / episodes
    names = parts[0].shares
    return Outcome(
        returns=np.concatenate([part.returns for part in parts]),
        costs=np.concatenate([part.costs for part in parts]),
        violations=np.concatenate([part.violations for part in parts]),
        shares={name: float(weights @ [part.shares[name] for part in parts]) for name in names},
        least=min(part.least for part in parts),
        seconds=float(weights @ [part.seconds for part in parts]),
    )


def _run(line: Line, rows: list[int], rng: np.random.Generator) -> Outcome:
    n = len(rows)
    world = WORLDS[line.world]
    policy = POLICIES[line.policy] if line.policy in POLICIES else bundle_policy(Path(line.policy))
    robot_filter = BarrierFilter(world.config, Guide(world.config, line.guide))
    env = make_environments(world.level, n, world.off)
    returns, costs, spent = np.zeros(n), np.zeros(n), 0.0
    violations = np.zeros(n, dtype=np.int64)
    counts: Counter[str] = Counter()
    least = np.inf
    memory = np.zeros(n, MEMORY)
    off = world.off[0]
    noisy = off.distance + off.bearing + off.speed > 0.0
    faulty = np.zeros((n, LIDAR_BINS), np.bool_)
    if off.bin:
        faulty[np.arange(n), rng.integers(0, LIDAR_BINS, n)] = True
    decided: Decisions | None = None
    late = _Late(off, n, rng)

    def act(observation: FloatArray, env: Any) -> FloatArray:
        nonlocal memory, decided, spent
        observation, hazards = late.observed(observation, env.hazards_in_body_frame())
        seen, shown = _perturbed(observation, hazards, off, rng) if noisy else (observation, hazards)
        if off.bin:
            seen = _with_faults(seen, off, faulty)
        action = np.clip(policy(seen, shown, rng), -1.0, 1.0)
        if line.gate == "none":
            return late.arrives(action)
        start = time.perf_counter()
        view = robot_filter.look(seen, shown if line.source == "given" else None, memory)
        active = np.ones(n, bool) if line.gate == "always" else view.low
        decided = robot_filter.decide(view, action, memory, active)
        spent += time.perf_counter() - start
        memory = decided.memory if line.memory else memory
        return late.arrives(decided.action)

    for step in drive(env, act, rows):
        alive = step.running
        returns[alive] += step.reward[alive]
        costs[alive] += step.cost[alive]
        edge = _nearest_edge(step.after)
        # At level 2 vases cost as well, and a step with a cost need not be one in a hazard.
        violations[alive] += (edge < 0.0 if world.level == 2 else step.cost > 0.0)[alive]
        least = min(least, float(edge[alive].min(initial=np.inf)))
        if decided is not None:
            counts["open"] += int((decided.gate_open & alive).sum())
            counts["replaced"] += int((decided.certified & (decided.origin != "") & alive).sum())
            counts.update(f"by {origin}" for origin in decided.origin[alive].tolist())
    env.close()
    steps = n * EPISODE_STEPS
    shares = {name: counts[name] / steps for name in SHARES}
    return Outcome(returns, costs, violations, shares, least, spent / steps)


def _nearest_edge(observation: FloatArray) -> FloatArray:
    """Distance (N,) from the nearest hazard's edge [m], from the true scans."""
    if observation.shape[1] == layout(0).size:
        return np.full(len(observation), np.inf)
    strongest = observation[:, layout(1).slice("hazards_lidar")].max(axis=1)
    return np.asarray(LIDAR_RANGE * (1.0 - strongest) - HAZARD_RADIUS)


POLICIES: dict[str, Policy] = {
    "random": random_policy,
    "thrust": thrust_policy,
    "attacker": attacker_policy,
    "seeker": seeker_policy,
}
SHARES = ("open", *(f"by {origin}" for origin in Origin), "replaced")
"""What is counted of the steps."""


@dataclass(frozen=True)
class World:
    """Where a line is run: the level, what is off, and the filter that is ready for it."""

    config: FilterConfig = field(default_factory=FilterConfig)
    level: int = 1
    off: tuple[Off, ...] = (Off(),)


ROBUST = FilterConfig(travel_error=0.3)
"""For mass, drag, thrust and turning that are 10 % off: docs/filter.md derives the number."""
NOISY = FilterConfig(position_error=0.002, bearing_error=float(np.radians(2.0)), travel_error=0.03)
"""For errors of up to 2 mm, 2 degrees and 2 %."""
COMBINATIONS = tuple(
    Off(mass, drag, thrust, turning)
    for mass, drag, thrust, turning in itertools.product((0.9, 1.1), repeat=4)
)
DELAYS = (1, 2, 3)
NOISE = (Off(distance=0.002, bearing=float(np.radians(2.0)), speed=0.02),)
WORLDS = {
    "plain": World(),
    "off": World(ROBUST, off=COMBINATIONS),
    "noise": World(NOISY, off=NOISE),
    "level 2": World(level=2),
    "level 0": World(level=0),
    "margin 3 mm": World(FilterConfig(margin=0.003)),
    "margin 2 cm": World(FilterConfig(margin=0.02)),
    "margin 4 cm": World(FilterConfig(margin=0.04)),
    "a dead bin": World(off=(Off(bin="dead"),)),
    "a bin at half": World(off=(Off(bin="half"),)),
    "a stuck bin": World(off=(Off(bin="stuck"),)),
    **{f"observations {n} steps old": World(FilterConfig(delay_steps=n), off=(Off(old=n),)) for n in DELAYS},
    **{f"actions {n} steps late": World(FilterConfig(delay_steps=n), off=(Off(late=n),)) for n in DELAYS},
    **{f"observations {n} steps old, not told": World(off=(Off(old=n),)) for n in DELAYS},
    **{f"actions {n} steps late, not told": World(off=(Off(late=n),)) for n in DELAYS},
    "2 % of actions lost": World(off=(Off(lost=0.02),)),
    "10 % of actions lost": World(off=(Off(lost=0.1),)),
    "actions shaken by 0.1": World(off=(Off(shaken=0.1),)),
    "actions shaken, ready": World(ROBUST, off=(Off(shaken=0.1),)),
    "ready for noise": World(NOISY),
    "ready for a robot off": World(ROBUST),
}
SHIPPED, REWARD_ONLY = "models/pointgoal1", "models/ppo1"
SOURCES: tuple[Source, ...] = ("given", "lidar")
GATES: tuple[Gate, ...] = ("always", "floor", "none")


def lines() -> Iterator[Line]:
    """What docs/filter.md shows, what matters most first."""
    policies = (REWARD_ONLY, "random", "thrust", "attacker")
    for source, policy, strength in itertools.product(SOURCES, (SHIPPED, REWARD_ONLY), STRENGTHS):
        yield Line(policy, "plain", source, "always", strength)
    for world in ("plain", "off", "noise", "level 2"):
        for gate, policy, source in itertools.product(GATES[:2], policies, SOURCES):
            if (world, gate, policy) != ("plain", "always", REWARD_ONLY):
                yield Line(policy, world, source, gate, DEFAULT_STRENGTH)
    for source in SOURCES:
        yield Line(SHIPPED, "plain", source, "floor", DEFAULT_STRENGTH)
    for policy in (*policies, SHIPPED):
        yield Line(policy, "plain", "given", "none", "off")
    for policy, source in itertools.product((REWARD_ONLY, "attacker"), SOURCES):
        yield Line(policy, "plain", source, "always", DEFAULT_STRENGTH, memory=False)
    faulty = ("a dead bin", "a bin at half", "a stuck bin")
    for world, gate, policy in itertools.product(faulty, GATES[:2], (REWARD_ONLY, "attacker")):
        yield Line(policy, world, "lidar", gate, DEFAULT_STRENGTH)
    settings = ("margin 3 mm", "margin 2 cm", "margin 4 cm", "ready for noise", "ready for a robot off")
    for world, source in itertools.product(settings, SOURCES):
        yield Line(REWARD_ONLY, world, source, "always", DEFAULT_STRENGTH)
    yield from late_lines()


def late_lines() -> Iterator[Line]:
    """Late and lost: delays that the filter is told of, then what it is not."""
    told = [world for world in WORLDS if world.endswith(("steps old", "steps late"))]
    policies = (REWARD_ONLY, "random", "thrust", "attacker")
    for world, policy, source in itertools.product(told, policies, SOURCES):
        yield Line(policy, world, source, "always", DEFAULT_STRENGTH)
    for world in told:
        yield Line(SHIPPED, world, "lidar", "always", DEFAULT_STRENGTH)
        yield Line(SHIPPED, world, "given", "none", "off")
    not_told = [world for world in WORLDS if world.endswith(("not told", "lost", "shaken by 0.1", "ready"))]
    for world, policy in itertools.product(not_told, (REWARD_ONLY, "attacker")):
        yield Line(policy, world, "lidar", "always", DEFAULT_STRENGTH)


@dataclass
class Arguments:
    """What to run."""

    episodes: int = 1000
    """Episodes of each line."""
    out: Path = Path("benchmarks/results/filter.csv")
    """Where the lines are kept."""
    part: tuple[int, int] = (0, 1)
    """Run the lines i, i + n, i + 2 n ...: one process of several, each with an ``out`` of its own."""
    seed: int = 0
    """Seed of the episodes' layouts and of what is random in them; tune on others."""
    print: bool = False
    """Print the tables of what is kept instead."""


def _row(line: Line, outcome: Outcome) -> dict[str, str]:
    """One line of the CSV file."""
    return {
        **{name: str(value) for name, value in asdict(line).items()},
        "episodes": str(len(outcome.returns)),
        "return": f"{outcome.returns.mean():.2f}",
        "p10": f"{np.percentile(outcome.returns, 10):.2f}",
        "cost": f"{outcome.costs.mean():.4f}",
        "violating_steps": str(outcome.violations.sum()),
        "violating_episodes": str((outcome.violations > 0).sum()),
        "least_mm": f"{1000 * outcome.least:.1f}",
        **{name: f"{share:.5f}" for name, share in outcome.shares.items()},
        "us": f"{1e6 * outcome.seconds:.1f}",
    }


def table(rows: list[dict[str, str]]) -> str:
    """The lines as Markdown: what the robot did, and what the filter did of its steps."""
    head = ("policy", "world", "hazards", "gate", "guide", "return", "p10", "violating steps", "least [mm]")
    shares = ("open", "QP", "search", "plan", "least harm", "guide", "replaced")
    lines = [f"| {' | '.join((*head, *shares))} |", "|---" * (len(head) + len(shares)) + "|"]
    for row in rows:
        percent = {name.removeprefix("by "): 100 * float(row[name]) for name in SHARES}
        percent["QP"] = percent["barrier"] + percent["circulation"]
        world = row["world"] + ("" if row["memory"] == "True" else ", no memory")
        names = (Path(row["policy"]).name, world, row["source"], row["gate"], row["guide"])
        figures = (row["return"], row["p10"], row["violating_steps"], row["least_mm"])
        lines.append(f"| {' | '.join((*names, *figures, *(f'{percent[name]:.2f}' for name in shares)))} |")
    return "\n".join(lines)


def main() -> None:
    """Run the lines that are not kept yet, or print those that are."""
    arguments = tyro.cli(Arguments)
    if arguments.print:
        print(table(kept(arguments.out)))
        return
    first, step = arguments.part
    for line in list(lines())[first::step]:
        asked = {name: str(value) for name, value in asdict(line).items()} | {
            "episodes": str(arguments.episodes)
        }
        if any(all(row[name] == value for name, value in asked.items()) for row in kept(arguments.out)):
            continue
        row = _row(line, run(line, arguments.episodes, arguments.seed))
        keep(arguments.out, row)
        print(" ".join(row.values()), flush=True)


if __name__ == "__main__":
    main()
