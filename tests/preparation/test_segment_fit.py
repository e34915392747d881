"""Steps of the fit of parameters and initial states."""

import dataclasses

import pyro
import pyro.distributions as dist
import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import Backlash, CoulombFriction, StribeckFriction
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.preparation import gauss_newton, segment_fit
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import fit_segments
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import SEGMENT_FIT
from npdr_ppl.rollouts import Rollouts

OPTIONS = DataOptions(None, 20, "uncertain", "float64")
START = torch.tensor([0.5, -0.5], dtype=torch.float64)


@pytest.fixture
def segments(noisy_pendulum, recording):
    return SegmentModel(noisy_pendulum, recording, OPTIONS)


def objective(segments, z, offsets, scale):
    residual = segments.residuals(z[None], offsets[None], scale)
    return float(residual.square().sum() + z.square().sum() + offsets.square().sum())


def promised(segments, fit):
    """Returns what an undamped step from the fit would gain, were the simulation linear."""
    now = segments.linearise(fit.z, fit.offsets, fit.scale)
    pull = (now.by_starts.mT @ now.residual[..., None])[..., 0] - fit.offsets
    inner = now.by_starts.mT @ now.by_starts + torch.eye(segments.num_offsets)
    own = torch.linalg.solve(inner, pull)
    left = now.residual - (now.by_starts @ own[..., None])[..., 0]
    gradient = (now.by_parameters.mT @ left[..., None]).sum(0)[:, 0] - fit.z
    step = torch.linalg.solve(now.information() + torch.eye(len(fit.z)), gradient)
    return float(gradient @ step + (pull * own).sum())


def test_fine_steps_end_where_nothing_is_left_to_gain(segments):
    rough = fit_segments(segments, START, is_rough=True)
    fine = fit_segments(segments, START)
    assert (
        promised(segments, fine)
        < 2 * SEGMENT_FIT.least_gain
        < promised(segments, _at(segments, START))
    )
    least = objective(segments, fine.z, fine.offsets, fine.scale)
    assert least <= objective(segments, rough.z, rough.offsets, fine.scale)
    # Rough steps end within a thousandth of it: enough to rank hypotheses that differ plainly.
    assert objective(segments, rough.z, rough.offsets, fine.scale) < 1.01 * least


@pytest.mark.slow
def test_parameters_known_a_thousand_times_better_hold_up_no_other():
    place = ("arm", "stribeck_friction")
    case = make_case("furuta", "one", (place,), strength=1.0, seed=2001)
    model = add_effect(case.model, StribeckFriction("arm"))
    segments = SegmentModel(model, case.fit, segment_options(case.fit))
    (hidden,) = case.truth
    typical = {
        f"{hidden.name}.{name}": torch.tensor(0.5 * value).double()
        for name, value in hidden.parameters.items()
    }
    fit = fit_segments(segments, segments.place_of(typical))
    assert promised(segments, fit) < 2 * SEGMENT_FIT.least_gain


def test_a_segment_that_begins_far_off_is_reached_and_holds_up_no_other(segments):
    plain = fit_segments(segments, START)
    far = 25.0
    segments.inputs = _shifted(segments.inputs, 3, far)
    found = fit_segments(segments, START)
    # What the smoother is said to be sure of holds a seventh of it back.
    assert found.offsets[3, 0] - plain.offsets[3, 0] < -0.8 * far
    others = torch.arange(len(found.offsets)) != 3
    assert (found.offsets[others] - plain.offsets[others]).abs().max() < 0.5
    assert (found.z - plain.z).abs().max() < 0.2
    assert promised(segments, found) < 2 * SEGMENT_FIT.least_gain


def test_a_segment_that_friction_holds_is_freed():
    rates = torch.linspace(0.4, 0.6, 12, dtype=torch.float64)
    segments = SegmentModel(coasting, _coasts(rates), OPTIONS)
    values = segments.inputs.initial_values.clone()
    values[3, 1] = 0.0  # nothing that is nearly at rest moves against 0.4 N m
    segments.inputs = dataclasses.replace(segments.inputs, initial_values=values)
    found = fit_segments(segments, torch.zeros(1))
    begun = segments.inputs.initial_value_errors[:, 1] * found.offsets[:, 1] + values[:, 1]
    # What the smoother is said to be sure of holds a tenth of it back; stuck, it is 0.45 off.
    torch.testing.assert_close(begun, rates, rtol=0.0, atol=0.1)


def test_a_segment_that_stands_out_stays_where_it_was_recorded():
    rates = torch.linspace(0.4, 0.6, 12, dtype=torch.float64)
    recorded = DataOptions(None, 20, "recorded", "float64")
    segments = SegmentModel(coasting, _coasts(rates), recorded)
    segments.observed[3] += 1.0
    found = fit_segments(segments, torch.zeros(1))
    assert segments.num_offsets == 0 and found.offsets.shape == (12, 0)


@pytest.mark.slow
def test_restarts_leave_many_local_minima_that_play_makes(monkeypatch):
    # Other local minima are hundreds away; what a few more steps might gain is less than this.
    def num_found():
        return sum(above < 10.0 for above in _above_the_least())

    # Of six fits each of four recordings, 11 end at the least with restarts, and 3 without.
    assert num_found() >= 3
    monkeypatch.setattr(
        segment_fit, "SEGMENT_FIT", dataclasses.replace(SEGMENT_FIT, most_restarts=0)
    )
    assert num_found() <= 1


def _above_the_least():
    """Yields how far above the least misfit of a joint with play fits from elsewhere end."""
    case = make_case("pendulum", "one", (("hinge", "backlash"),), strength=0.72, seed=74)
    model = add_effect(case.model, Backlash("hinge"))
    segments = SegmentModel(model, case.fit, DataOptions(None, 10, "uncertain", "float64"))
    (hidden,) = case.truth
    true = {
        name: torch.tensor(value) for name, value in {**case.parameters, **hidden.sites}.items()
    }
    names = {site.name for site in segments.prior.sites}
    start = segments.place_of({name: value for name, value in true.items() if name in names})
    least = fit_segments(segments, start)
    for away in (-0.5, -0.1), (-0.3, 0.3), (0.3, -0.3), (-1.0, 0.0), (1.0, 0.0), (0.0, -0.5):
        begun = start.clone()
        begun[segments.coordinates_with_minima] += torch.tensor(away, dtype=torch.float64)
        fit = fit_segments(segments, begun)
        ends = [objective(segments, f.z, f.offsets, least.scale) for f in (fit, least)]
        yield ends[0] - ends[1]


def test_where_the_simulation_fails_is_said(segments, monkeypatch):
    def fails(z, offsets):
        return torch.nan * segments.observed.expand(len(z), -1, -1, -1)

    monkeypatch.setattr(segments, "simulate", fails)
    with pytest.raises(DataError, match="simulation fails at the parameters"):
        fit_segments(segments, START)


def linearisation(*, diverges):
    """Returns that of four linear segments; the simulation diverges along one or all of them."""
    generator = torch.Generator().manual_seed(0)
    residual, by_z, by_start = (
        torch.randn(shape, generator=generator, dtype=torch.float64)
        for shape in ((4, 30), (4, 30, 2), (4, 30, 2))
    )
    # What explodes does so alike along all columns: 1 + Gᵀ G is singular in double precision.
    by_start[diverges] = 1e100
    return Linearisation(residual, by_z, by_start)


def step_from(now, *, is_alone=slice(None)):
    """Returns the parameters and offsets after a step of some of the segments."""
    now = Linearisation(*(getattr(now, f.name)[is_alone] for f in dataclasses.fields(now)))
    num = len(now.residual)
    dampings = torch.full((num,), 1e-2).double()
    held = torch.zeros(2, dtype=torch.bool)
    offsets = torch.zeros(num, 2, dtype=torch.float64)
    factors, uniform = (0.1, 1.0, 10.0), torch.ones(2, dtype=torch.bool)
    return gauss_newton.step(now, START, offsets, held, 1e-2, dampings, factors, uniform)


def test_a_segment_whose_derivatives_explode_keeps_its_start_and_holds_up_no_other():
    now = linearisation(diverges=[2])
    assert now.is_finite and not now.is_regular
    with pytest.raises(torch.linalg.LinAlgError):  # what a plain solver says
        torch.linalg.solve(now.by_starts.mT @ now.by_starts + torch.eye(2), now.by_starts.mT)
    moved, begun = step_from(now)
    assert begun.shape == (3, 4, 2)
    assert torch.equal(begun[:, 2], torch.zeros(3, 2).double())
    assert bool((begun[:, [0, 1, 3]] != 0.0).all())
    # The step is that of a recording whose third segment starts from a known state.
    known = dataclasses.replace(now, by_starts=now.by_starts * (now.by_starts < 1e99))
    expected, others = step_from(known)
    torch.testing.assert_close(moved, expected)
    torch.testing.assert_close(begun[:, [0, 1, 3]], others[:, [0, 1, 3]])


def test_where_every_system_is_singular_no_step_is_taken():
    now = linearisation(diverges=slice(None))
    now = dataclasses.replace(now, by_parameters=torch.full_like(now.by_parameters, 1e100))
    assert now.is_finite
    moved, begun = step_from(now)
    assert torch.equal(moved, START)
    assert torch.equal(begun, torch.zeros_like(begun))


def test_a_segment_whose_derivatives_explode_says_nothing_of_the_parameters():
    now, others = linearisation(diverges=[2]), torch.tensor([0, 1, 3])
    assert linearisation(diverges=[]).is_regular
    rest = Linearisation(*(getattr(now, f.name)[others] for f in dataclasses.fields(now)))
    torch.testing.assert_close(now.information(), rest.information())
    torch.testing.assert_close(now.weights()[others], rest.weights())
    assert not now.weights()[2].any() and not now.taken_back()[2].any()


def test_a_fit_goes_on_where_derivatives_explode(segments, monkeypatch):
    plain = fit_segments(segments, START)
    linearise = segments._linearised

    def explodes(z, offsets, scale, *, is_rough=False):
        now = linearise(z, offsets, scale, is_rough=is_rough)
        now.by_starts[3] = 1e100
        return now

    monkeypatch.setattr(segments, "_linearised", explodes)
    found = fit_segments(segments, START)
    assert torch.equal(found.offsets[3], torch.zeros(segments.num_offsets).double())
    assert (found.z - plain.z).abs().max() < 0.2


def test_nothing_is_restarted_where_the_parameters_cannot_be_told(segments, monkeypatch):
    linearise = segments._linearised

    def explodes(z, offsets, scale, *, is_rough=False):
        now = linearise(z, offsets, scale, is_rough=is_rough)
        return dataclasses.replace(
            now,
            by_parameters=torch.full_like(now.by_parameters, 1e100),
            by_starts=torch.zeros_like(now.by_starts),
        )

    fit = fit_segments(segments, START)
    monkeypatch.setattr(segments, "_linearised", explodes)
    every = torch.ones(2, dtype=torch.bool)
    monkeypatch.setattr(SegmentModel, "coordinates_with_minima", every)
    assert segment_fit._restart(segments, fit.z, fit.offsets, fit.scale, ~every) is None


def test_equal_fits_from_equal_starts(segments):
    one, two = fit_segments(segments, START), fit_segments(segments, START)
    assert torch.equal(one.z, two.z) and torch.equal(one.offsets, two.offsets)


def test_a_recording_with_none_of_the_sensors(noisy_pendulum, recording):
    renamed = Rollouts.from_arrays(
        readings=recording.readings,
        actions=recording.actions,
        channel_names=("tilt", "spin"),
        action_names=("torque",),
        time_step=0.02,
    )
    with pytest.raises(DataError, match="rename them"):
        SegmentModel(noisy_pendulum, renamed, OPTIONS)


DRY = Pendulum().with_effects(CoulombFriction("hinge"))
FRICTION = {"hinge.coulomb_friction.magnitude": torch.tensor(0.4, dtype=torch.float64)}


def coasting(inputs, *, noise=None):
    parameters = {"mass": pyro.sample("mass", dist.Uniform(0.3, 1.7)), **FRICTION}
    return npdr.simulate("trajectory", DRY, parameters, inputs, noise=noise)


def _coasts(rates):
    """Returns a recording of each rate at which the pendulum is left to itself, hanging down."""
    torque = torch.zeros(20, 1, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    readings = []
    for rate in rates:
        start = torch.stack((torch.zeros_like(rate), rate))
        inputs = Inputs.single(
            torque,
            start,
            action_names=("torque",),
            state_names=("angle", "velocity"),
            time_step=0.02,
        )
        exact = torch.cat((start[None], DRY.simulate(FRICTION, inputs).reshape(-1, 2)))
        noise = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        readings.append((exact + torch.tensor([0.002, 0.02]) * noise).numpy())
    return Rollouts.from_arrays(
        readings=readings,
        actions=[torque.numpy()] * len(readings),
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    )


def _at(segments, z):
    """Returns a fit that has not begun."""
    fit = fit_segments(segments, z, max_steps=0)
    assert torch.equal(fit.z, z)
    return fit


def _shifted(inputs: Inputs, segment: int, deviations: float) -> Inputs:
    """Returns inputs of which one segment's first value is off by standard deviations."""
    values, errors = inputs.initial_values.clone(), inputs.initial_value_errors
    values[segment, 0] += deviations * errors[segment, 0]
    return dataclasses.replace(inputs, initial_values=values)


def test_corrected_derivatives_lead_to_the_same_fit(segments, monkeypatch):
    settings = [
        dataclasses.replace(SEGMENT_FIT, most_updates=most, least_ratio=0.0) for most in (0, 3)
    ]
    linearise, calls, fits = SegmentModel._linearised, [], []

    def counted(self, *args, **options):
        calls[-1] += 1
        return linearise(self, *args, **options)

    monkeypatch.setattr(SegmentModel, "_linearised", counted)
    for own in settings:
        monkeypatch.setattr(segment_fit, "SEGMENT_FIT", own)
        calls.append(0)
        fits.append(fit_segments(segments, START))
    assert calls[1] < calls[0]
    ends = [objective(segments, fit.z, fit.offsets, fits[0].scale) for fit in fits]
    assert abs(ends[1] - ends[0]) < 2 * SEGMENT_FIT.least_gain


def test_a_fit_leaves_the_ends_of_uniform_priors_at_once(segments, monkeypatch):
    """Their coordinates have hardly any influence there, and would move by hundreds."""
    assert bool(segments.prior.uniform_coordinates.all())
    expected = fit_segments(segments, START)
    places = []
    corrected = SegmentModel.corrected

    def seen(self, z, *args, **options):
        places.append(z)
        return corrected(self, z, *args, **options)

    monkeypatch.setattr(SegmentModel, "corrected", seen)
    found = fit_segments(segments, torch.tensor([0.0, 3.5], dtype=torch.float64))
    assert promised(segments, found) < 2 * SEGMENT_FIT.least_gain
    torch.testing.assert_close(found.z, expected.z, rtol=0.0, atol=0.1)
    # A step of one standard deviation would end at 2.5.
    assert abs(float(places[1][1])) < 0.6


@pytest.mark.parametrize("begun", [(4.5, 0.0), (0.0, 0.0), (-3.0, 1.0)])
def test_a_fit_ends_where_data_and_prior_balance_at_an_end(recording, begun):
    """The data ask for a mass beyond the end of its prior."""

    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 0.97))
        length = pyro.sample("length", dist.Uniform(0.3, 1.7))
        return npdr.simulate("trajectory", Pendulum(), {"mass": mass, "length": length}, inputs)

    segments = SegmentModel(model, recording, OPTIONS)
    found = fit_segments(segments, torch.tensor(begun, dtype=torch.float64))
    assert float(found.z[0]) > 1.0
    least = objective(segments, found.z, found.offsets, found.scale)
    residual = segments.residuals(found.z[None], found.offsets[None], found.scale)[0]
    # Correlated measurements count as fewer, so that fits end earlier.
    most = 2 * SEGMENT_FIT.least_gain / segments.effective_share(residual)
    for coordinate in torch.linspace(-1.0, 5.0, 61, dtype=torch.float64):
        z = torch.stack((coordinate, found.z[1]))
        gain = least - objective(segments, z, found.offsets, found.scale)
        assert gain < most


def test_a_parameter_of_little_influence_stops_no_other():
    """Both residuals are linear in the parameter, a uniform one, not in its coordinate."""
    normal = torch.distributions.Normal(0.0, 1.0)
    z = torch.tensor([3.5, -0.4], dtype=torch.float64)
    truth = normal.icdf(torch.tensor([0.7, 0.6], dtype=torch.float64))
    slopes = 1e6 * torch.tensor([[1.0, 0.3], [-0.2, 1.0]], dtype=torch.float64)
    residual = slopes @ (normal.cdf(truth) - normal.cdf(z))
    derivatives = slopes * normal.log_prob(z).exp()
    now = Linearisation(residual[None], derivatives[None], torch.zeros(1, 2, 0).double())
    none, uniform = torch.zeros(1, 0).double(), torch.ones(2, dtype=torch.bool)
    moved, _ = gauss_newton.step(
        now, z, none, ~uniform, 1e-6, torch.full((1,), 1e-6).double(), (1.0,), uniform
    )
    torch.testing.assert_close(moved, truth, rtol=0.0, atol=1e-3)
    followed, change = gauss_newton.as_moved(now, z, moved, uniform)
    torch.testing.assert_close(followed.by_parameters[0], slopes * normal.log_prob(moved).exp())
    left = residual - followed.by_parameters[0] @ change
    torch.testing.assert_close(left, slopes @ (normal.cdf(truth) - normal.cdf(moved)))


def test_the_linearisation_of_a_fit_is_that_at_its_end(segments):
    found = fit_segments(segments, START)
    assert found.linearisation is not None
    again = segments.linearise(found.z, found.offsets, found.scale)
    for field in dataclasses.fields(again):
        known, computed = (getattr(each, field.name) for each in (found.linearisation, again))
        torch.testing.assert_close(known, computed, rtol=1e-9, atol=1e-9)


def test_a_fit_does_not_keep_derivatives_that_do_not_belong_to_its_end(segments):
    first = torch.tensor([True, False])
    assert fit_segments(segments, START, held=first).linearisation is None
    assert fit_segments(segments, START, is_rough=True).linearisation is None


def test_a_gain_counts_less_where_residuals_are_correlated(segments, monkeypatch):
    gains = []
    steps = segment_fit._steps

    def seen(*args, **options):
        gains.append(options.get("share"))
        return steps(*args, **options)

    monkeypatch.setattr(segment_fit, "_steps", seen)
    fit_segments(segments, START)
    white = gains[1]
    assert gains[0] is None and white > 0.6
    slow = torch.sin(torch.arange(segments.observed.shape[1]) / 6.0)[:, None]
    segments.observed = segments.observed + 20.0 * fit_segments(segments, START).scale * slow
    gains.clear()
    fit_segments(segments, START)
    assert gains[1] < 0.6 * white


def test_the_possible_gain_is_the_greatest_that_a_linear_model_allows():
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    now = Linearisation(drawn(4, 9), drawn(4, 9, 3), drawn(4, 9, 2))
    held = torch.tensor([False, False, True])
    now = dataclasses.replace(now, by_parameters=now.by_parameters * ~held)
    z, offsets = drawn(3), drawn(4, 2)
    # All unknowns in one least-squares problem: two parameters, then the offsets.
    rows = torch.cat(
        (now.by_parameters[..., :2].flatten(0, 1), torch.block_diag(*now.by_starts)), 1
    )
    matrix = torch.cat((rows, torch.eye(10, dtype=torch.float64)))
    target = torch.cat((now.residual.flatten(), -z[:2], -offsets.flatten()))
    left = target - matrix @ torch.linalg.lstsq(matrix, target[:, None]).solution[:, 0]
    expected = float(target.square().sum() - left.square().sum())
    gain = gauss_newton.possible_gain(now, z, offsets, held, torch.zeros_like(held))
    assert gain == pytest.approx(expected)


@pytest.mark.parametrize("is_rough", [True, False])
@pytest.mark.parametrize("most_kept", [segment_fit.MOST_KEPT, 0])
def test_the_difference_of_a_fit_is_that_of_its_simulation(
    segments, monkeypatch, is_rough, most_kept
):
    monkeypatch.setattr(segment_fit, "MOST_KEPT", most_kept)
    found = fit_segments(segments, START, is_rough=is_rough)
    if most_kept:
        simulated = segments.difference(found.z[None], found.offsets[None])[0]
        torch.testing.assert_close(found.difference, simulated, rtol=0.0, atol=1e-12)
    else:
        assert found.difference is None
