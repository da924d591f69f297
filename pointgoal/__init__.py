"""The PointGoal task on MuJoCo: a point robot that drives from goal to goal among hazards.

Importing it registers ``PointGoal0-v0``, ``PointGoal1-v0`` and ``PointGoal2-v0`` with gymnasium. Without
gymnasium, as in the runtime's install, `pointgoal.observation` still works and nothing is registered.
"""

from __future__ import annotations

from importlib.util import find_spec

from pointgoal.observation import LEVELS


def register_environments() -> None:
    """Register the environments with gymnasium, once."""
    import gymnasium

    for level in LEVELS:
        name = f"PointGoal{level}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point="pointgoal.environment:unlimited",
                vector_entry_point="pointgoal.vector:PointGoalVectorEnv",
                kwargs={"level": level},
                max_episode_steps=1000,
            )


if find_spec("gymnasium") is not None:
    register_environments()
