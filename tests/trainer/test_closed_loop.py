import numpy as np

from pointgoal.vector import PointGoalVectorEnv
from trainer.algorithms import prepare_environments
from trainer.closed_loop import episodes


def test_the_cost_of_an_episode_is_the_tasks_whatever_the_algorithm_constrains():
    def played(algorithm):
        rng = np.random.default_rng(0)
        env = prepare_environments(algorithm, PointGoalVectorEnv(1, 4, num_threads=1), 1)
        return episodes(env, lambda seen: rng.uniform(-1, 1, (len(seen), 2)), range(3, 9), 300)

    plain, constrained = played("ppo"), played("scpo")
    assert plain.costs.max() > 0
    np.testing.assert_array_equal(constrained.costs, plain.costs)
    np.testing.assert_array_equal(constrained.returns, plain.returns)
    assert constrained.observation.shape == (300, 6, 61)


def test_every_episode_has_its_own_layout():
    env = prepare_environments("ppo", PointGoalVectorEnv(1, 4, num_threads=1), 1)
    played = episodes(env, lambda seen: np.zeros((len(seen), 2)), [*range(3, 13)], 2)
    first = played.observation[0]
    assert len(np.unique(first, axis=0)) == 10
    alone, _ = PointGoalVectorEnv(1, 10, num_threads=1).reset(seed=range(3, 13))
    np.testing.assert_array_equal(first, alone.astype(np.float32))
