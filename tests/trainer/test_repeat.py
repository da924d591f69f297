import numpy as np

from trainer.algorithms import prepare_environments


def test_held_actions_add_up_and_stop_at_the_episodes_end(tiny_task):
    plain, held = tiny_task(4), prepare_environments("ppo", tiny_task(4), 3)
    start = {"elapsed_steps": np.array([0, 5, 17, 18])}
    plain.reset(seed=3, options=start)
    held.reset(seed=3, options=start)
    action = np.full((4, 1), 0.5)
    steps = [plain.step(action) for _ in range(3)]
    observation, reward, terminated, truncated, info = held.step(action)
    np.testing.assert_array_equal(observation, steps[-1][0])
    ends = np.array([3, 3, 3, 2])  # the last one's episode ends after two steps
    np.testing.assert_array_equal(reward, [sum(s[1][i] for s in steps[:n]) for i, n in enumerate(ends)])
    cost = [sum(s[4]["cost"][i] for s in steps[:n]) for i, n in enumerate(ends)]
    np.testing.assert_array_equal(info["cost"], cost)
    np.testing.assert_array_equal(truncated, [False, False, True, True])
    assert not terminated.any()
    np.testing.assert_array_equal(info["final_obs"][2], steps[2][4]["final_obs"][2])
    np.testing.assert_array_equal(info["final_obs"][3], steps[1][4]["final_obs"][3])


def test_scpo_sees_the_largest_cost_and_pays_for_its_growth(tiny_task):
    plain, maximum = tiny_task(2), prepare_environments("scpo", tiny_task(2), 1)
    plain.reset(seed=0)
    maximum.reset(seed=0)
    costs, increments, seen = [], [], []
    for a in (0.1, 0.9, 0.5, 0.2, 1.0, 0.3):
        costs.append(plain.step(np.full((2, 1), a))[4]["cost"])
        observation, _, _, _, info = maximum.step(np.full((2, 1), a))
        increments.append(info["cost"])
        seen.append(observation[:, -1])
        np.testing.assert_array_equal(info["task_cost"], costs[-1])
    largest = np.maximum.accumulate(costs)
    np.testing.assert_array_equal(seen, largest)
    np.testing.assert_allclose(np.cumsum(increments, axis=0), largest)
