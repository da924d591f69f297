"""One update of each algorithm on a fixed batch, against a calculation that shares no code with it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from trainer.actions import ActionRange
from trainer.algorithms import ALGORITHMS
from trainer.config import Config
from trainer.errors import NonFiniteError
from trainer.learner import Learner
from trainer.rollout import Figures, Trajectory
from trainer.trust_region import conjugate_gradient, fisher

T, N, OBS, ACT = 30, 4, 5, 2


def make(algorithm, **settings):
    """An algorithm after one step of random experience, its batch and figures; one minibatch, one pass."""
    config = Config(
        algorithm=algorithm, task="Tiny", action_repeat=1,
        out=Path("unused"), num_envs=N, epoch_steps=T * N, minibatch=T * N, passes=1,
        threads=1, kl_stop=10.0, episode_steps=10, **settings,
    )  # fmt: skip
    rng = np.random.default_rng(5)
    learner = Learner(
        config, OBS, ActionRange(*np.float32([[1] * ACT, [0] * ACT, [-9] * ACT, [9] * ACT])), rng
    )
    with torch.no_grad():  # away from the initial policy, whose mean is almost zero
        learner.actor += 0.1 * torch.from_numpy(rng.normal(size=learner.actor.shape).astype(np.float32))
    rule = ALGORITHMS[algorithm](learner)
    learner.start_epoch(0.25)
    observation = rng.normal(size=(T + 1, N, OBS)).astype(np.float32)
    net = actor_module(learner)
    mean = net(torch.from_numpy(observation[:-1])).detach().numpy()
    std = np.exp(learner.actor.detach().numpy()[-ACT:])
    action = (mean + std * rng.normal(size=mean.shape)).astype(np.float32)
    ended = np.zeros((T, N), bool)
    ended[9::10] = True
    trajectory = Trajectory(
        observation=observation, action=action, mean=mean, reward=rng.normal(size=(T, N)).astype(np.float32),
        cost=np.maximum(0, rng.normal(size=(T, N)) - 0.5).astype(np.float32), ended=ended,
        terminated=np.zeros((T, N), bool),
        final_observation=rng.normal(size=(ended.sum(), OBS)).astype(np.float32),
    )  # fmt: skip
    figures = Figures(step_cost=float(trajectory.cost.mean()))
    figures.constrained.extend([3.0, 5.0])
    return rule, learner, rule.batch(trajectory), figures


def module(theta, outputs):
    """A torch.nn network with the given flat parameters."""
    net = nn.Sequential(
        nn.Linear(OBS, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )  # fmt: skip
    at = 0
    with torch.no_grad():
        for layer in net[::2]:
            rows, columns = layer.in_features, layer.out_features
            layer.weight.copy_(theta[at : at + rows * columns].view(rows, columns).T)
            layer.bias.copy_(theta[at + rows * columns : at + rows * columns + columns])
            at += rows * columns + columns
    return net


def flat(net):
    return torch.cat([p for layer in net[::2] for p in (layer.weight.T.reshape(-1), layer.bias)])


def actor_module(learner):
    return module(learner.actor.detach(), ACT)


class Reference:
    """Policy and Adam of our own, at the learner's parameters."""

    def __init__(self, learner):
        self.net = actor_module(learner)
        self.log_std = learner.actor.detach()[-ACT:].clone().requires_grad_()
        self.adam = torch.optim.Adam(
            [*self.net.parameters(), self.log_std], lr=learner.config.learning_rate * 0.75
        )

    def ratio(self, batch):
        policy = Independent(Normal(self.net(batch.observation), self.log_std.exp()), 1)
        return (policy.log_prob(batch.action) - batch.log_prob).exp()

    def descend(self, loss):
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return torch.cat([flat(self.net), self.log_std]).detach()


def clipped(ratio, advantage):
    return torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()


def test_ppo():
    rule, learner, batch, figures = make("ppo")
    reference = Reference(learner)
    want = reference.descend(-clipped(reference.ratio(batch), batch.reward_advantage))
    rule.update(batch, figures)
    torch.testing.assert_close(learner.actor.detach(), want, atol=2e-6, rtol=0)


def test_critics():
    rule, learner, batch, figures = make("ppo", critic_l2=0.001)
    nets = [module(row, 1) for row in learner.critics.detach()]
    adam = torch.optim.Adam(
        [p for net in nets for p in net.parameters()], lr=learner.config.critic_learning_rate
    )
    loss = sum(
        ((net(batch.observation)[:, 0] - target) ** 2).mean()
        + 0.001 * sum((p**2).sum() for p in net.parameters())
        for net, target in zip(nets, batch.targets, strict=True)
    )
    loss.backward()
    adam.step()
    rule.update(batch, figures)
    torch.testing.assert_close(
        learner.critics.detach(), torch.stack([flat(net) for net in nets]).detach(), atol=2e-6, rtol=0
    )


@pytest.mark.parametrize(
    ("algorithm", "settings", "multiplier"),
    [
        ("ppo-lag", {}, 0.001 + 0.035),  # Adam's first step is its step size, here upwards: J_c 4 > d 1
        ("cppo-pid", {}, 0.1 * 0.05 * 3 + (0.001 + 0.01 * 3) + 0.01 * 0.05 * 4),
        ("ipo", {"ipo_form": "omnisafe", "cost_limit": 4.5}, 0.01 / 0.5),
        ("ipo", {"ipo_form": "omnisafe"}, 1.0),
    ],
)
def test_scalar_multipliers(algorithm, settings, multiplier):
    rule, learner, batch, figures = make(algorithm, **settings)
    reference = Reference(learner)
    advantage = (batch.reward_advantage - multiplier * batch.cost_advantage) / (1 + multiplier)
    want = reference.descend(-clipped(reference.ratio(batch), advantage))
    logged = rule.update(batch, figures)
    assert logged["multiplier"] == pytest.approx(multiplier, rel=1e-5)
    torch.testing.assert_close(learner.actor.detach(), want, atol=2e-6, rtol=0)


@pytest.mark.parametrize("limit", [4.5, 3.0], ids=["inside", "outside"])
def test_ipo_log_barrier(limit):
    rule, learner, batch, figures = make("ipo", cost_limit=limit)
    reference = Reference(learner)
    ratio = reference.ratio(batch)
    z = 4.0 + 10 * ((ratio - 1) * batch.cost_advantage).mean() - limit
    barrier = -torch.log(-z) / 20 if limit > 4 else 20 * z  # the tangent up to a constant
    want = reference.descend(-clipped(ratio, batch.reward_advantage) + barrier)
    rule.update(batch, figures)
    torch.testing.assert_close(learner.actor.detach(), want, atol=2e-6, rtol=0)


def test_lagnet_is_equations_14_and_15():
    rule, learner, batch, figures = make("lagnet", cost_limit=1.0, multiplier_init=3.0)
    xi = module(rule.network.parameters.detach(), 1)
    adam = torch.optim.Adam(xi.parameters(), lr=learner.config.multiplier_learning_rate)
    multiplier = nn.functional.softplus(xi(batch.observation)[:, 0])
    torch.testing.assert_close(multiplier, torch.full_like(multiplier, 3.0), atol=0.1, rtol=0)
    (-(multiplier * (batch.cost - 1.0 / 10)).mean()).backward()
    adam.step()
    with torch.no_grad():
        multiplier = nn.functional.softplus(xi(batch.observation)[:, 0])
    reference = Reference(learner)
    ratio = reference.ratio(batch)
    objective = clipped(ratio, batch.reward_advantage) - (multiplier * ratio * batch.cost_advantage).mean()
    want = reference.descend(-objective / (1 + multiplier.mean()))
    rule.update(batch, figures)
    torch.testing.assert_close(rule.network.parameters.detach(), flat(xi).detach(), atol=2e-6, rtol=0)
    torch.testing.assert_close(learner.actor.detach(), want, atol=2e-6, rtol=0)


def test_lagnet_foresight_regresses_the_cost_ahead_and_scales_it():
    rule, learner, batch, figures = make("lagnet-foresight", cost_limit=1.0, foresight=0.9, gae=1.0)
    xi = module(rule.network.parameters.detach(), 1)
    value = lambda x: nn.functional.softplus(xi(torch.from_numpy(np.clip(x, -5, 5))))[..., 0].detach().numpy()  # noqa: E731
    trajectory = batch.trajectory
    want = np.zeros((T, N))
    after, final = value(trajectory.observation), iter(value(trajectory.final_observation))
    ends = {(t, n): next(final) for t, n in np.argwhere(trajectory.ended)}
    for t in reversed(range(T)):
        for n in range(N):
            ahead = ends.get((t, n), after[t + 1, n] if t == T - 1 else want[min(t + 1, T - 1), n])
            want[t, n] = trajectory.cost[t, n] + 0.9 * ahead
    np.testing.assert_allclose(rule.targets(batch), want.reshape(-1)[batch.order], atol=1e-5)

    logged = rule.update(batch, figures)
    assert logged["scale"] == pytest.approx(
        learner.config.scale_init * np.exp(learner.config.scale_step)
    )  # 10 × mean cost > d
    x = batch.observation[:3]
    torch.testing.assert_close(rule.network(x), logged["scale"] * rule.network.raw(x).sqrt())


def test_lagnet_foresight_has_one_multiplier_for_all_states_at_power_0():
    rule, _, batch, _ = make("lagnet-foresight", foresight_power=0.0, scale_init=2.5)
    assert torch.equal(rule.network(batch.observation), torch.full((T * N,), 2.5))


@pytest.mark.parametrize("algorithm", ["trpo-lag", "cpo", "scpo", "lagnet-foresight"])
def test_trust_region_steps_stay_in_the_trust_region(algorithm):
    rule, learner, batch, figures = make(algorithm, cost_limit=3.9)
    before = learner.actor.detach().clone()
    logged = rule.update(batch, figures)
    assert 0 < logged["step_share"] <= 1
    assert 0 < logged["kl"] <= learner.config.trust_kl
    assert not torch.equal(before, learner.actor.detach())


def trpo_lag_objective(batch, ratio, rule):
    multiplier = 0.001 + 0.035
    return (ratio * (batch.reward_advantage - multiplier * batch.cost_advantage)).mean() / (1 + multiplier)


def foresight_objective(batch, ratio, rule):
    """Eq. 14 where the clip is idle, each term divided by 1 + λ(s) σ_c, λ as the update has left it."""
    multiplier = rule.network(batch.observation).detach()
    terms = ratio * (batch.reward_advantage - multiplier * batch.cost_advantage)
    return (terms / (1 + multiplier * batch.cost_advantage.std())).mean()


@pytest.mark.parametrize(
    ("algorithm", "objective"),
    [("trpo-lag", trpo_lag_objective), ("lagnet-foresight", foresight_objective)],
)
def test_the_trust_region_step_is_the_natural_gradient(algorithm, objective):
    rule, learner, batch, figures = make(algorithm, fisher_every=1, cg_iterations=60)
    start = learner.actor.detach().clone()
    reference = Reference(learner)
    ratio = reference.ratio(batch)
    product = fisher_by_jacobian(learner, batch)
    rule.update(batch, figures)
    objective(batch, ratio, rule).backward()
    layers = reference.net[::2]
    g = torch.cat(
        [x for k in layers for x in (k.weight.grad.T.reshape(-1), k.bias.grad)] + [reference.log_std.grad]
    )
    step = learner.actor.detach() - start
    x = step / step.norm()
    image = product(x.double())
    cosine = (image @ g.double()) / (image.norm() * g.double().norm())  # H x is parallel to g
    assert cosine > 0.999


def test_lagnet_foresight_can_ascend_by_adam():
    rule, learner, batch, figures = make("lagnet-foresight", policy_step="adam")
    reference = Reference(learner)
    ratio = reference.ratio(batch)
    rule.update(batch, figures)
    multiplier = rule.network(batch.observation).detach()
    weight = 1 / (1 + multiplier * batch.cost_advantage.std())
    penalty = (weight * multiplier * ratio * batch.cost_advantage).mean()
    want = reference.descend(-clipped(ratio, weight * batch.reward_advantage) + penalty)
    torch.testing.assert_close(learner.actor.detach(), want, atol=2e-6, rtol=0)


def fisher_by_jacobian(learner, batch):
    """(Jᵀ Σ⁻¹ J / B + 2 on the log deviations + damping) v, with J by torch.func."""
    shape, config = learner.actor_shape, learner.config
    theta = learner.actor.detach().double()
    x = batch.observation.double()

    def outputs(p):
        w1, b1, w2, b2, w3, b3 = torch.split(p[: shape.size], shape.splits)
        h = torch.tanh(x @ w1.view(OBS, 64) + b1)
        return torch.tanh(h @ w2.view(64, 64) + b2) @ w3.view(64, ACT) + b3

    variance = torch.exp(2 * theta[shape.size :])

    def product(v):
        _, along = torch.func.jvp(outputs, (theta,), (v,))
        _, pull = torch.func.vjp(outputs, theta)
        result = pull(along / variance)[0] / len(x)
        result[shape.size :] += 2 * v[shape.size :]
        return result + config.damping * v

    return product


def test_fisher_product_is_the_gaussian_fisher_information():
    _, learner, batch, _ = make("cpo", fisher_every=1)
    v = torch.from_numpy(np.random.default_rng(1).normal(size=learner.actor.shape).astype(np.float32))
    got = fisher(learner, batch)(v)
    torch.testing.assert_close(
        got.double(), fisher_by_jacobian(learner, batch)(v.double()), atol=1e-4, rtol=1e-3
    )


def test_conjugate_gradient_solves():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12))
    H, b = torch.from_numpy(root @ root.T + np.eye(12)), torch.from_numpy(rng.normal(size=12))
    torch.testing.assert_close(conjugate_gradient(lambda v: H @ v, b, 50), torch.linalg.solve(H, b))
    assert (conjugate_gradient(lambda v: H @ v, torch.zeros(12).double(), 5) == 0).all()


def test_the_number_of_threads_does_not_change_a_bit():
    results = []
    for threads in (1, 2):
        rule, learner, batch, figures = make("lagnet")
        object.__setattr__(learner.config, "threads", threads)
        rule.update(batch, figures)
        results.append(torch.cat([p.detach().reshape(-1) for p in learner.parameters.values()]))
    assert torch.equal(*results)


@pytest.mark.parametrize(
    ("algorithm", "broken", "term"),
    [
        ("ppo", "reward_advantage", "policy loss"),
        ("ppo", "targets", "critic loss"),
        ("lagnet", "cost", "multiplier loss"),
        ("cpo", "cost_advantage", "cost surrogate"),
        ("trpo-lag", "reward_advantage", "policy surrogate"),
    ],
)
def test_a_loss_that_is_not_finite_is_named(algorithm, broken, term):
    rule, _, batch, figures = make(algorithm)
    getattr(batch, broken)[..., 3] = np.nan
    with pytest.raises(NonFiniteError, match=term):
        rule.update(batch, figures)


def test_an_environment_that_is_not_finite_is_named():
    rule, _, batch, _ = make("ppo")
    batch.trajectory.reward[2, 1] = np.inf
    with pytest.raises(NonFiniteError, match="reward"):
        rule.batch(batch.trajectory)
