"""Effects as handlers: they compose, come off again, and leave the base model alone."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import Predictive

import npdr_ppl as npdr
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import Bias, CoulombFriction, InputDelay, SensorLowPass
from npdr_ppl.models.pendulum import Pendulum, pendulum

NUM_STEPS = 40


@pytest.fixture
def inputs():
    torch.manual_seed(0)
    return Inputs.single(
        torch.randn(NUM_STEPS, 1, dtype=torch.float64),
        torch.zeros(2),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.02,
        history=5,
    )


def sites(model, *args):
    trace = poutine.trace(model).get_trace(*args)
    return [n for n, s in trace.nodes.items() if s["type"] == "sample"]


def test_effect_parameters_become_sites_and_the_base_model_is_untouched(inputs):
    revised = npdr.add_effect(pendulum, CoulombFriction(port="hinge"))
    assert sites(revised, inputs) == [
        "mass",
        "length",
        "hinge.coulomb_friction.magnitude",
        "trajectory",
    ]
    assert sites(pendulum, inputs) == ["mass", "length", "trajectory"]


def test_zero_strength_is_bit_identical_whatever_the_composition(inputs):
    fixed = {"mass": torch.tensor(0.8), "length": torch.tensor(1.1)}
    model = pendulum
    for effect in (
        CoulombFriction("hinge"),
        Bias("hinge"),
        InputDelay("torque"),
        SensorLowPass("velocity"),
    ):
        model = npdr.add_effect(model, effect)
        names = [name for name in sites(model, inputs) if "." in name]
        zero = fixed | {name: torch.tensor(0.0) for name in names}
        base = pyro.condition(pendulum, data=fixed)(inputs)
        assert torch.equal(pyro.condition(model, data=zero)(inputs), base)


def test_effects_come_off_again(inputs):
    both = npdr.add_effect(
        npdr.add_effect(pendulum, CoulombFriction("hinge")), InputDelay("torque")
    )
    without = npdr.remove_effect(both, "hinge.coulomb_friction")
    assert [name for name in sites(without, inputs) if "." in name] == ["torque.input_delay.delay"]
    assert npdr.remove_effect(without, "torque.input_delay") is pendulum
    with pytest.raises(ModelError, match=r"no effect 'hinge.bias'; it has .*coulomb_friction"):
        npdr.remove_effect(both, "hinge.bias")


def test_an_effect_attaches_once():
    once = npdr.add_effect(pendulum, CoulombFriction("hinge"))
    with pytest.raises(ModelError, match="attached to .* already"):
        npdr.add_effect(once, CoulombFriction("hinge"))


def test_unknown_port_and_wrong_kind_are_said(inputs):
    with pytest.raises(ModelError, match=r"no port 'elbow'; its ports are .*hinge"):
        npdr.add_effect(pendulum, CoulombFriction("elbow"))(inputs)
    with pytest.raises(ModelError, match="'torque' of Pendulum is of kind action"):
        npdr.add_effect(pendulum, CoulombFriction("torque"))(inputs)


def test_own_priors_replace_the_defaults(inputs):
    friction = CoulombFriction("hinge", priors={"magnitude": dist.Uniform(1.0, 2.0)})
    draws = Predictive(npdr.add_effect(pendulum, friction), num_samples=50, parallel=True)(inputs)
    assert bool((draws["hinge.coulomb_friction.magnitude"] >= 1.0).all())
    with pytest.raises(ModelError, match="no parameter strength"):
        CoulombFriction("hinge", priors={"strength": dist.Uniform(0.0, 1.0)})


def test_two_sites_of_one_device_share_the_effect(inputs):
    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
        first = npdr.simulate("first", Pendulum(), {"mass": mass}, inputs)
        second = npdr.simulate("second", Pendulum(), {"mass": mass}, inputs)
        return first, second

    first, second = npdr.add_effect(model, Bias("hinge"))(inputs)
    assert torch.equal(first, second)
    only = npdr.add_effect(model, Bias("hinge"), site="second")
    pyro.set_rng_seed(1)
    first, second = only(inputs)
    assert not torch.equal(first, second)
    with pytest.raises(ModelError, match="looked for 'third'"):
        npdr.add_effect(model, Bias("hinge"), site="third")(inputs)


def test_effects_inside_plates_have_one_value_per_device(inputs):
    def fleet(inputs):
        with pyro.plate("rigs", 3):
            mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
            return npdr.simulate("trajectory", Pendulum(), {"mass": mass}, inputs)

    draws = Predictive(npdr.add_effect(fleet, Bias("hinge")), num_samples=4, parallel=True)(inputs)
    assert draws["hinge.bias.offset"].shape == (4, 3)
    assert draws["trajectory"].shape == (4, 3, 1, NUM_STEPS, 2)


def test_noise_can_be_exchanged(inputs):
    fixed = {"mass": torch.tensor(0.8), "length": torch.tensor(1.1)}
    clean = pyro.condition(pendulum, data=fixed)
    noisy = npdr.with_noise(clean, 0.1)
    difference = noisy(inputs) - clean(inputs)
    # The standard error of a standard deviation over 80 readings; 4 of them.
    assert abs(difference.std() / 0.1 - 1) < 4 / (2 * difference.numel()) ** 0.5
    assert torch.equal(npdr.with_noise(noisy, None)(inputs), clean(inputs))


def test_finer_steps_are_taken_where_there_are_some(inputs):
    fixed = {"mass": torch.tensor(0.8), "length": torch.tensor(1.1)}

    def reading(model):
        return pyro.condition(model, data=fixed)(inputs)

    finer = npdr.with_finer_steps(pendulum)
    expected = Pendulum(integrator="midpoint").simulate(fixed, inputs)
    assert torch.equal(reading(finer), expected)
    assert not torch.equal(reading(pendulum), expected)
    # Twice as well, then with twice as many steps; effects stay attached, and come off.
    finest = Pendulum(integrator="rk4").simulate(fixed, inputs)
    assert torch.equal(reading(npdr.with_finer_steps(finer)), finest)
    twice = Pendulum(integrator="rk4", substeps=2).simulate(fixed, inputs)
    most = npdr.with_finer_steps(npdr.with_finer_steps(finer))
    assert torch.equal(reading(most), twice)
    assert torch.equal(reading(npdr.with_finer_steps(most)), twice)
    revised = npdr.with_finer_steps(npdr.add_effect(pendulum, Bias("hinge")))
    assert sites(revised, inputs) == ["mass", "length", "hinge.bias.offset", "trajectory"]
    bare = npdr.remove_effect(revised, "hinge.bias")
    assert torch.equal(reading(bare), expected)
