import dataclasses

import pytest
import scipy.linalg
import torch

from visadapt.systems import CartPole
from visadapt.tasks.balance import CENTRED_CARTPOLE, PAPER_CARTPOLE, Cost, RegulatorCost, SettlingCost, cost_to_go
from visadapt.world import World


def written_out(cost, states, actions, now):
    """sum_k sum_i w_i (s_{k,i} - (1 - k / K) s_{0,i})^2 + r a_k^2, with the goal at the origin."""
    total = 0.0
    steps = len(states)
    for k in range(1, steps + 1):
        for i, weight in enumerate(cost.state):
            reference = now[i] + k / steps * (0.0 - now[i])
            total += weight * (states[k - 1][i] - reference) ** 2
        total += cost.action * sum(a**2 for a in actions[k - 1])
    return total


@pytest.mark.parametrize("horizon", [1, 10])
@pytest.mark.parametrize("cost", [Cost((2.0, 0.5, 3.0, 0.0), 0.1), PAPER_CARTPOLE, CENTRED_CARTPOLE])
def test_it_is_the_formula(cost, horizon):
    generator = torch.Generator().manual_seed(horizon)
    states = torch.randn(5, horizon, 4, generator=generator, dtype=torch.float64)
    actions = torch.randn(5, horizon, 2, generator=generator, dtype=torch.float64)
    now = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    found = cost(states, actions, now)
    assert found.dtype == torch.float64
    wanted = [written_out(cost, states[b].tolist(), actions[b].tolist(), now[b].tolist()) for b in range(5)]
    assert found.tolist() == pytest.approx(wanted)


@pytest.mark.parametrize("cost", [PAPER_CARTPOLE, CENTRED_CARTPOLE])
class TestCartPole:
    def test_resting_at_the_goal_costs_nothing_and_leaving_it_something(self, cost):
        rest, still = torch.zeros(1, 10, 4), torch.zeros(1, 10, 1)
        assert cost(rest, still, torch.zeros(1, 4)).tolist() == [0.0]
        assert float(cost(rest, still + 0.5, torch.zeros(1, 4))) > 0
        assert float(cost(rest + torch.tensor([0.0, 0.0, 0.1, 0.0]), still, torch.zeros(1, 4))) > 0

    def test_going_straight_to_the_goal_costs_less_than_standing_or_being_there_at_once(self, cost):
        now = torch.tensor([[0.4, 0.2, 0.1, 0.3]])
        straight = (1 - torch.arange(1, 11) / 10)[None, :, None] * now[:, None]
        still = torch.zeros(1, 10, 1)
        assert float(cost(straight, still, now)) == pytest.approx(0.0, abs=1e-12)
        for other in (now[:, None].expand(-1, 10, -1), torch.zeros(1, 10, 4)):
            assert float(cost(other, still, now)) > 0.1


def test_the_papers_cost_does_not_care_where_the_cart_is():
    weights = dataclasses.asdict(PAPER_CARTPOLE)["state"]
    assert weights == (0.0, 3.0, 10.0, 1.0)  # A.1.3
    state = torch.zeros(1, 10, 4)
    state[..., 0] = 7.0
    assert PAPER_CARTPOLE(state, torch.zeros(1, 10, 1), torch.zeros(1, 4)).tolist() == [0.0]


def least(cost):
    """Eigenvalues of the cart-pole, linearised upright, under the first action of the plan that costs least."""
    world = World(CartPole())
    rest, still = torch.zeros(1, 4, dtype=torch.float64), torch.zeros(1, 10, 1, dtype=torch.float64)

    def planned(now, plan):
        at, states = world.start(now), []
        for k in range(10):
            at = world.step(at, plan[:, k])
            states.append(at.state)
        return cost(torch.stack(states, 1), plan, now).sum()

    (_, mixed), (_, second) = torch.autograd.functional.hessian(planned, (rest, still))
    second, mixed = second.reshape(10, 10), mixed.reshape(4, 10)
    gain = -torch.linalg.solve(second, mixed.T)[:1]
    moves = torch.autograd.functional.jacobian(lambda s, a: world.step(world.start(s), a).state[0], (rest, still[:, 0]))
    return torch.linalg.eigvals(moves[0][:, 0] + moves[1][:, 0] @ gain).abs()


def test_only_where_the_end_of_the_plan_weighs_more_is_the_cart_drawn_back_to_the_middle():
    """What the swing-up's settings rest on."""
    near, far = (1.0, 3.0, 10.0, 1.0), (20.0, 3.0, 10.0, 1.0)
    assert float(least(Cost(near)).max()) == pytest.approx(1.0014, abs=1e-4)
    assert float(least(Cost(far)).max()) == pytest.approx(1.0232, abs=1e-4)
    assert float(least(SettlingCost(near, end=9.0)).max()) == pytest.approx(0.9964, abs=1e-4)
    assert float(least(SettlingCost(far, end=9.0)).max()) == pytest.approx(0.9288, abs=1e-4)


def test_the_end_of_a_plan_costs_as_much_again():
    generator = torch.Generator().manual_seed(3)
    states, actions = torch.randn(2, 10, 4, generator=generator), torch.randn(2, 10, 1, generator=generator)
    now, weights = torch.randn(2, 4, generator=generator), (2.0, 0.5, 3.0, 0.0)
    more = SettlingCost(weights, end=3.0)(states, actions, now) - Cost(weights)(states, actions, now)
    wanted = [3 * sum(w * float(s) ** 2 for w, s in zip(weights, row, strict=True)) for row in states[:, -1]]
    assert more.tolist() == pytest.approx(wanted, rel=1e-4)


class TestRegulatorCost:
    WEIGHTS = (1.0, 6.0, 1.0, 0.1)
    TO_GO = cost_to_go(World(CartPole()), WEIGHTS, Cost.action)

    def moves(self):
        """A and B of the cart-pole, linearised upright."""
        world = World(CartPole())
        rest, still = torch.zeros(4, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
        step = torch.autograd.functional.jacobian(
            lambda s, a: world.step(world.start(s[None]), a[None]).state[0], (rest, still)
        )
        return [part.numpy() for part in step]

    def test_what_is_left_to_pay_solves_the_riccati_equation(self):
        a, b = self.moves()
        weights = torch.diag(torch.tensor(self.WEIGHTS)).double().numpy()
        wanted = scipy.linalg.solve_discrete_are(a, b, weights, [[Cost.action]]) - weights  # that of now is not to pay
        assert torch.tensor(self.TO_GO).numpy() == pytest.approx(wanted, rel=1e-5)

    def test_a_plan_of_half_a_second_begins_like_one_without_end(self):
        a, b = self.moves()
        weights = torch.diag(torch.tensor(self.WEIGHTS)).double().numpy()
        price = scipy.linalg.solve_discrete_are(a, b, weights, [[Cost.action]])
        gain = scipy.linalg.solve(Cost.action + b.T @ price @ b, b.T @ price @ a)
        endless = abs(scipy.linalg.eigvals(a - b @ gain))
        found = least(RegulatorCost(self.WEIGHTS, to_go=self.TO_GO))
        assert sorted(found.tolist()) == pytest.approx(sorted(endless), abs=1e-4)
