"""The contract of every effect of the catalogue, on every port of every ODE model of the zoo."""

from dataclasses import replace

import pytest
import torch

from npdr_ppl.engines.common.integrators import INTEGRATORS
from npdr_ppl.language.effects import ParameterEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.effects import (
    ActuatorGain,
    ActuatorLag,
    Bias,
    CoulombFriction,
    EncoderBias,
    EncoderScale,
    InputDelay,
    ParameterDrift,
    SensorLowPass,
    Tilt,
    candidate_effects,
)
from npdr_ppl.models.emps import Emps
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum
from tests.helpers.effect_recovery import Recovery
from tests.helpers.effect_replay import FREE, replay

SIMULATORS = (Pendulum, Furuta, CartPole, Emps)


def cases():
    """Every candidate but the drift of all parameters except two; masses may drift on demand."""
    for simulator in SIMULATORS:
        candidates = candidate_effects(simulator())
        drifting = [e for e in candidates if isinstance(e, ParameterEffect)][:2]
        for effect in candidates:
            if not isinstance(effect, ParameterEffect) or effect in drifting:
                name = f"{simulator.__name__}-{effect.name}"
                yield pytest.param(simulator, type(effect), effect.port, id=name)
    yield pytest.param(Pendulum, ParameterDrift, "mass", id="Pendulum-mass.parameter_drift")


CASES = list(cases())


def some_inputs(simulator, dtype=torch.float64, num_segments=3, num_steps=40) -> Inputs:
    generator = torch.Generator().manual_seed(11)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    rated = {port.name: port.rated for port in simulator.ports}
    scales = torch.tensor([min(1.0, rated[state.name]) for state in simulator.states])
    states = draw(num_segments, len(simulator.states)) * scales
    return Inputs(
        actions=simulator.actions[0].upper * draw(num_segments, num_steps, 1),
        action_names=(simulator.actions[0].name,),
        initial_readings=states + 0.1 * draw(*states.shape),
        initial_values=states,
        initial_rates=None,
        channel_names=tuple(state.name for state in simulator.states),
        past_actions=draw(num_segments, 6, 1),
        time_step=simulator.time_step,
        mask=torch.arange(num_steps) < torch.tensor([[num_steps], [num_steps - 5], [1]]),
        rollout=torch.tensor([0, 0, 1]),
        start=torch.tensor([0, num_steps, 0]),
    )


def no_strength(effect, dtype, shape=()):
    return {
        site: torch.full(shape, parameter.nominal, dtype=dtype)
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
    }


def draws(effect, port, num_draws, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return {
            f"{effect.name}.{name}": prior.sample((num_draws,)).double()
            for name, prior in effect.priors(port).items()
        }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("simulator", "effect", "port"), CASES)
def test_zero_strength_changes_no_bit(simulator, effect, port, dtype):
    check_zero_strength(simulator(), effect(port), dtype)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("effect", candidate_effects(Furuta()), ids=lambda effect: effect.name)
def test_zero_strength_changes_no_bit_under_any_integrator(effect, integrator):
    check_zero_strength(Furuta(integrator=integrator, substeps=2), effect, torch.float32)


def check_zero_strength(base, attached, dtype):
    inputs = some_inputs(type(base), dtype, num_steps=12)
    expected = base.simulate({}, inputs)
    assert expected.dtype == dtype
    changed = base.with_effects(attached)
    assert torch.equal(changed.simulate({}, inputs), expected)
    assert torch.equal(changed.simulate(no_strength(attached, dtype), inputs), expected)
    batch = changed.simulate(no_strength(attached, dtype, (2, 1)), inputs)
    assert torch.equal(batch, expected.expand(2, 1, *expected.shape))


@pytest.mark.parametrize(("simulator", "effect", "port"), CASES)
def test_batch_equals_a_loop(simulator, effect, port):
    attached = effect(port)
    changed = simulator().with_effects(attached)
    inputs = some_inputs(simulator)
    parameters = draws(attached, changed.port(port), 4)
    # One of the simulator's own parameters varies along.
    own = simulator.parameters[0]
    parameters[own.name] = own.nominal * torch.linspace(0.9, 1.1, 4, dtype=torch.float64)
    batch = changed.simulate(parameters, inputs)
    assert batch.shape == (4, 3, 40, len(simulator.states))
    for i in range(4):
        for s in range(3):
            one = changed.simulate(
                {name: value[i] for name, value in parameters.items()}, inputs.segments([s])
            )
            torch.testing.assert_close(batch[i, s], one[0], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("simulator", "effect", "port"), CASES)
def test_prior_draws_matter_and_stay_finite(simulator, effect, port):
    attached = effect(port)
    changed = simulator().with_effects(attached)
    inputs = some_inputs(simulator, num_steps=100)
    assert set(attached.priors(changed.port(port))) == {p.name for p in attached.parameters}
    out = changed.simulate(draws(attached, changed.port(port), 50), inputs)
    base = simulator().simulate({}, inputs)
    assert out.isfinite().all()
    assert (out[..., ~inputs.mask, :] == 0.0).all()
    matters = ((out - base).abs().flatten(1).amax(1) > 1e-12).float().mean()
    if is_symmetry(effect, port):
        assert matters == 0.0
    else:
        assert matters > 0.9


def is_symmetry(effect, port):
    """Nothing depends on where the arm's, the cart's or the carriage's zero is.

    For a segment starts from its own reading.
    """
    return effect is EncoderBias and port in ("arm_angle", "cart_position", "position")


@pytest.mark.parametrize(("simulator", "effect", "port"), CASES)
def test_gradients_exist_for_every_parameter(simulator, effect, port):
    attached = effect(port)
    changed = simulator().with_effects(attached)
    parameters = {
        name: value[0].requires_grad_()
        for name, value in draws(attached, changed.port(port), 1).items()
    }
    out = changed.simulate(parameters, some_inputs(simulator))
    gradients = torch.autograd.grad(out.square().sum(), list(parameters.values()))
    assert all(gradient.isfinite() for gradient in gradients)


def test_effects_compose_in_the_order_of_attachment():
    inputs = some_inputs(Furuta)
    gain, lag, delay = ActuatorGain("voltage"), ActuatorLag("voltage"), InputDelay("voltage")
    strengths = {
        "voltage.actuator_gain.error": torch.tensor(0.2, dtype=torch.float64),
        "voltage.actuator_lag.time_constant": torch.tensor(0.01, dtype=torch.float64),
        "voltage.input_delay.delay": torch.tensor(0.005, dtype=torch.float64),
    }
    # These three are linear and time-invariant, so that any order gives the same trajectory,
    # but only if later effects see the history of what earlier ones let through.
    expected = Furuta().with_effects(delay, gain, lag).simulate(strengths, inputs)
    for order in ((gain, delay, lag), (gain, lag, delay), (lag, gain, delay)):
        out = Furuta().with_effects(*order).simulate(strengths, inputs)
        torch.testing.assert_close(out[0], expected[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("order", [(EncoderBias, EncoderScale), (EncoderScale, EncoderBias)])
def test_several_errors_of_a_sensor_are_removed_from_a_start_in_reverse_order(order):
    wrong = Emps().with_effects(*(effect("position") for effect in order))
    errors = {"position.encoder_bias.offset": 0.1, "position.encoder_scale.error": 0.5}
    out = replay(wrong, FREE | errors, [0.0] * 5, start=[0.3, 0.0])
    torch.testing.assert_close(out[:, 0], torch.full_like(out[:, 0], 0.3), rtol=0.0, atol=1e-12)


def test_all_kinds_at_once_reduce_to_the_base_at_zero_strength():
    attached = (
        Tilt("gravity"),
        CoulombFriction("arm"),
        CoulombFriction("pole"),
        Bias("arm"),
        ActuatorLag("voltage"),
        InputDelay("voltage"),
        SensorLowPass("arm_velocity,pole_velocity"),
    )
    inputs = some_inputs(Furuta, torch.float32)
    base = Furuta()
    changed = base.with_effects(*attached)
    zero = {}
    for effect in attached:
        zero |= no_strength(effect, torch.float32)
    expected = base.simulate({}, inputs)
    assert torch.equal(changed.simulate(zero, inputs), expected)
    assert base.effects == ()


@pytest.mark.parametrize("steps", [1.0, 2.5, 5.0])
def test_delay_shifts_the_commands(steps):
    """A delayed command equals the same command given later, in whole and half steps."""
    commands = torch.randn(60, 1, generator=torch.Generator().manual_seed(1)).double()
    names = tuple(state.name for state in Furuta.states)

    def replay(actions, simulator, parameters):
        inputs = Inputs.single(
            actions,
            torch.zeros(4),
            action_names=("voltage",),
            state_names=names,
            time_step=0.002,
        )
        return simulator.simulate(parameters, inputs)

    padded = torch.cat((torch.zeros(6, 1, dtype=torch.float64), commands))
    whole, part = int(steps), steps - int(steps)
    shifted = (1 - part) * padded[6 - whole : 66 - whole] + part * padded[5 - whole : 65 - whole]
    delay = torch.tensor(steps * 0.002, dtype=torch.float64)
    delayed = replay(
        commands,
        Furuta().with_effects(InputDelay("voltage")),
        {"voltage.input_delay.delay": delay},
    )
    torch.testing.assert_close(delayed, replay(shifted, Furuta(), {}), rtol=1e-9, atol=1e-9)


def test_delay_longer_than_the_segment_sees_the_recorded_past():
    inputs = some_inputs(Furuta, num_steps=3)
    simulator = Furuta().with_effects(InputDelay("voltage"))
    delay = {"voltage.input_delay.delay": torch.tensor(0.01, dtype=torch.float64)}
    out = simulator.simulate(delay, inputs)
    everything = torch.cat((inputs.past_actions, inputs.actions), dim=1)
    shifted = Inputs(**{**vars(inputs), "actions": everything[:, 1:4]})
    torch.testing.assert_close(out, Furuta().simulate({}, shifted), rtol=1e-9, atol=1e-9)


def one_port_each(simulator):
    """One candidate per effect: that at the last port, so groups of sensors are among them."""
    last = {effect.id: effect for effect in candidate_effects(simulator)}
    return [pytest.param(simulator, e, id=f"{simulator.name}-{e.name}") for e in last.values()]


@pytest.mark.parametrize(
    ("simulator", "effect"),
    [case for simulator in SIMULATORS[:3] for case in one_port_each(simulator())],
)
def test_parameters_are_recovered_from_noiseless_data(simulator, effect):
    inputs = some_inputs(type(simulator))
    # Far apart, so that slow changes show, but for a vibration, whose cycles must not be lost.
    starts = (torch.tensor([0.0, 20.0, 60.0]) / simulator.time_step).long()
    if effect.id == "periodic_disturbance":
        starts = torch.zeros(3, dtype=torch.long)
    inputs = replace(inputs, start=starts, mask=torch.ones_like(inputs.mask))
    recovery = Recovery(simulator.with_effects(effect), effect, inputs)
    if effect.id == "quantisation":
        found, misfit = recovery.scan(2000, num_rounds=4)
    else:
        found, misfit = recovery.descend(1e-6)
    error = (recovery.coordinates(found) - recovery.coordinates(recovery.true)[0]).abs()
    assert misfit < 1e-6
    assert error.max() < 1e-3, f"{recovery.sites}: {found} instead of {recovery.true[0]}"


@pytest.mark.parametrize(("simulator", "effect", "port"), CASES)
def test_a_probe_switches_the_effect_on_and_its_shapes_alone_do_not(simulator, effect, port):
    attached = effect(port)
    changed = simulator().with_effects(attached)
    inputs = some_inputs(simulator, num_steps=60)
    base = simulator().simulate({}, inputs)
    probe = attached.probe(changed.port(port))
    assert list(probe) == [parameter.name for parameter in attached.parameters]
    given = {f"{attached.name}.{name}": torch.tensor(x).double() for name, x in probe.items()}
    out = changed.simulate(given, inputs)
    assert out.isfinite().all()
    if not is_symmetry(effect, port):
        assert not torch.equal(out, base)
    priors = attached.priors(changed.port(port))
    nominal = {parameter.name: parameter.nominal for parameter in attached.parameters}
    shapes = {
        name: float(prior.mean) if name not in (attached.strength or priors) else nominal[name]
        for name, prior in priors.items()
    }
    given = {f"{attached.name}.{name}": torch.tensor(x).double() for name, x in shapes.items()}
    assert torch.equal(changed.simulate(given, inputs), base)
