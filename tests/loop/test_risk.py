"""What a policy search maximises over domains, and that it gets there."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from npdr_ppl.errors import ModelError
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.policy_optimisation import optimise_policy, returns_of
from npdr_ppl.loop.risk import MeanReturn, TailMean
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.base import Policy, PolicyParameter
from npdr_ppl.policies.search_registry import policy_search


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40),
    st.floats(0.01, 1.0),
)
def test_the_tail_mean_is_the_conditional_value_at_risk(values, share):
    returns = torch.tensor(values, dtype=torch.float64)
    # Rockafellar and Uryasev 2000: the greatest of ν − E[(ν − R)₊]/α, reached at one of the
    # returns, because it is piecewise linear with kinks there.
    levels = np.array(values)
    shortfall = np.maximum(levels[:, None] - levels, 0.0).mean(1)
    expected = (levels - shortfall / share).max()
    assert float(TailMean(share)(returns)) == pytest.approx(expected, abs=1e-6 / share)


def test_the_whole_tail_is_the_mean_and_less_of_it_is_lower():
    returns = torch.randn(3, 50, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(TailMean(1.0)(returns), MeanReturn()(returns))
    torch.testing.assert_close(MeanReturn()(returns), returns.double().mean(1))
    tails = torch.stack([TailMean(share)(returns) for share in (0.02, 0.2, 0.5, 1.0)])
    assert bool((tails.diff(dim=0) > 0).all())
    torch.testing.assert_close(tails[0], returns.double().min(1).values)


def test_a_failed_simulation_is_the_worst():
    returns = torch.tensor([[1.0, torch.nan, 3.0], [1.0, 2.0, 3.0]])
    for risk in (MeanReturn(), TailMean(0.5), TailMean(0.1)):
        assert risk(returns).tolist()[0] == -torch.inf
        assert risk(returns)[1].isfinite()


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1, float("nan")])
def test_shares_out_of_range_are_refused(share):
    with pytest.raises(ModelError, match="share must be above 0 and at most 1"):
        TailMean(share)


class Torque(Policy):
    """A constant torque."""

    observations = ()
    actions = ("torque",)
    parameter_info = (PolicyParameter("torque", 1.0, -4.0, 4.0),)

    def act(self, observation, time, memory, constants):
        return (constants["torque"],), memory


def near_half(positions, velocities, commands):
    return torch.exp(-10.0 * (positions[0] - 0.5).square())


def at_half(number, generator):
    return torch.tensor([[0.5, 0.0]]).expand(number, -1)


def test_training_for_the_tail_helps_the_worst_domain_and_costs_the_mean():
    """Nine light pendulums and a heavy one: a torque that holds the nine drops the tenth."""
    task = ControlTask("hold", Torque(), near_half, at_half, num_steps=40)
    masses = torch.tensor([0.8] * 9 + [1.4])
    domains = Domains(Pendulum(compile="never"), {"mass": masses})
    search = policy_search("cma-es", population=10, exploration=1.0)

    def reached(risk):
        start = task.policy.parameters
        found = optimise_policy(
            task, domains, search, start, iterations=10, num_initial_states=1, seed=0, risk=risk
        )
        generator = torch.Generator().manual_seed(0)
        states = at_half(1, generator)
        return returns_of(task, domains, found.parameters[None], states)[0, :, 0]

    for_mean, for_tail = reached(None), reached(TailMean(0.1))
    # Of 40 steps; both differences are several, where searches of ten iterations end within one.
    assert float(for_tail[-1] - for_mean[-1]) > 2.0
    assert float(for_mean.mean() - for_tail.mean()) > 2.0
