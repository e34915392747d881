"""infer and Posterior: the right answer, the same answer again, and after a restart."""

import json

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import Predictive

import npdr_ppl as npdr
from npdr_ppl.errors import BackendError, DataError, ModelError, ShapeError
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior import infer as infer_module
from npdr_ppl.posterior.run_folder import begin_fit
from npdr_ppl.preparation.binding import BoundModel
from tests.helpers.pendulum_recordings import swinging


@pytest.mark.slow
def test_linear_gaussian_posterior(linear):
    model, observed = linear
    posterior = npdr.infer(model, observed, num_simulations=4_000, seed=1, progress=False)
    draws = posterior.sample(4_000)["theta"]
    precision = 1 + 1 / 0.25
    # Training tolerance of 0.15 standard deviations, besides a Monte-Carlo error of 0.016.
    tolerance = 0.15 * precision**-0.5
    assert bool(((draws.mean(0) - observed / 0.25 / precision).abs() < tolerance).all())
    assert bool(((draws.std(0) * precision**0.5 - 1).abs() < 0.15).all())
    # The density is the same posterior's.
    expected = torch.distributions.Normal(observed / 0.25 / precision, precision**-0.5)
    difference = posterior.log_prob({"theta": draws}) - expected.log_prob(draws).sum(-1)
    assert difference.abs().median() < 0.2


@pytest.mark.slow
def test_same_seed_same_posterior_and_other_seed_another(linear, quick):
    model, observed = linear
    arguments = {"backend": quick, "rounds": 2, "num_simulations": 100, "progress": False}
    first = npdr.infer(model, observed, seed=3, **arguments).sample(20)["theta"]
    torch.manual_seed(99)
    again = npdr.infer(model, observed, seed=3, **arguments).sample(20)["theta"]
    other = npdr.infer(model, observed, seed=4, **arguments).sample(20)["theta"]
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_callers_random_stream_is_left_alone(linear, quick):
    model, observed = linear
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    npdr.infer(model, observed, backend=quick, num_simulations=50, progress=False).sample(5)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.slow
def test_an_interrupted_run_continues_to_the_same_result(linear, quick, tmp_path, monkeypatch):
    model, observed = linear
    arguments = {
        "backend": quick, "rounds": 3, "num_simulations": 80, "seed": 2, "progress": False
    }  # fmt: skip
    undisturbed = npdr.infer(model, observed, **arguments).sample(10)["theta"]

    class Killed(Exception):
        pass

    real = infer_module.simulate_features
    calls = []

    def dies_in_the_third_round(*args, **kwargs):
        calls.append(args)
        if len(calls) == 3:
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(infer_module, "simulate_features", dies_in_the_third_round)
    with pytest.raises(Killed):
        npdr.infer(model, observed, checkpoint=tmp_path, **arguments)
    resumed = npdr.infer(model, observed, checkpoint=tmp_path, **arguments)
    assert len(calls) == 4, "rounds that were complete are not simulated again"
    assert torch.equal(resumed.sample(10)["theta"], undisturbed)
    assert torch.equal(
        resumed.after_round(0).sample(10)["theta"],
        npdr.infer(model, observed, **{**arguments, "rounds": 1}).sample(10)["theta"],
    )
    with pytest.raises(DataError, match="differs in seed"):
        npdr.infer(model, observed, checkpoint=tmp_path, **{**arguments, "seed": 9})


def test_a_run_continues_only_with_its_own_data(linear, quick, tmp_path, monkeypatch):
    model, observed = linear
    arguments = {"backend": quick, "num_simulations": 80, "checkpoint": tmp_path}
    first = npdr.infer(model, observed, **arguments).sample(10)["theta"]
    with pytest.raises(DataError, match="differs in the data"):
        npdr.infer(model, observed + 1e-6, **arguments)
    real = BoundModel.observed_features
    for factor, sentence in ((1.0 + 1e-8, None), (1.01, "differs in what is read from the data")):
        monkeypatch.setattr(
            BoundModel, "observed_features", lambda bound, by=factor: by * real(bound)
        )
        if sentence is None:
            assert torch.equal(npdr.infer(model, observed, **arguments).sample(10)["theta"], first)
        else:
            with pytest.raises(DataError, match=sentence):
                npdr.infer(model, observed, **arguments)


@pytest.mark.slow
def test_saved_posteriors_come_back_identical(noisy_pendulum, recording, quick, tmp_path):
    posterior = npdr.infer(
        noisy_pendulum, recording, backend=quick, num_simulations=60,
        options=npdr.DataOptions(segment_length=50, embedding="all/10"),
        progress=False,
    )  # fmt: skip
    posterior.save(tmp_path / "posterior")
    loaded = npdr.Posterior.load(tmp_path / "posterior", noisy_pendulum)
    for name, value in posterior.sample(20).items():
        assert torch.equal(loaded.sample(20)[name], value)
    assert loaded.bound.options == posterior.bound.options
    with pytest.raises(DataError, match="no inference run"):
        npdr.Posterior.load(tmp_path, noisy_pendulum)


@pytest.mark.slow
def test_posterior_draws_lie_on_the_support(noisy_pendulum, recording, quick):
    posterior = npdr.infer(
        noisy_pendulum, recording, backend=quick, num_simulations=60, progress=False
    )
    draws = posterior.sample(2_000)
    for name in ("mass", "length"):
        assert bool(((draws[name] >= 0.3) & (draws[name] <= 1.7)).all())
    likely = posterior.most_likely(500)
    density = posterior.log_prob({name: value[None] for name, value in likely.items()})
    some = posterior.log_prob({name: value[:100] for name, value in draws.items()})
    assert density.item() >= some.quantile(0.95).item()
    with pytest.raises(ShapeError, match="log_prob needs length"):
        posterior.log_prob({"mass": torch.ones(3)})


@pytest.mark.slow
def test_the_guide_drives_predictive(noisy_pendulum, recording, quick):
    posterior = npdr.infer(
        noisy_pendulum, recording, backend=quick, num_simulations=60, progress=False
    )
    inputs = recording.inputs()
    draws = Predictive(noisy_pendulum, guide=posterior.guide, num_samples=30, parallel=True)(
        inputs
    )
    assert draws["trajectory"].shape == (30, 2, 100, 2)
    one = posterior.guide(inputs)
    assert one["mass"].shape == ()
    trace = pyro.poutine.trace(posterior.guide).get_trace(inputs)
    values = {name: trace.nodes[name]["value"][None] for name in ("mass", "length")}
    torch.testing.assert_close(
        trace.log_prob_sum(), posterior.log_prob(values)[0], rtol=1e-3, atol=1e-3
    )


def test_the_guide_keeps_plates(quick):
    def fleet():
        mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
        with pyro.plate("rigs", 3):
            own = pyro.sample("own", dist.Normal(mean, 1.0))
            npdr.simulate("x", lambda own: own[:, None], {"own": own}, noise=0.5)

    observed = torch.tensor([[0.1], [0.2], [0.3]])
    posterior = npdr.infer(fleet, observed, backend=quick, num_simulations=60, progress=False)
    draws = Predictive(fleet, guide=posterior.guide, num_samples=7, parallel=True)()
    assert draws["x"].shape == (7, 3, 1)
    assert posterior.sample(5)["own"].shape == (5, 3)


def test_trained_networks_see_raw_trajectories(noisy_pendulum, recording):
    from npdr_ppl.inference.registry import backend

    tiny = backend("snpe-c", transforms=1, hidden=(16,), epochs=2, members=1)
    posterior = npdr.infer(
        noisy_pendulum, recording, backend=tiny, num_simulations=50,
        options=npdr.DataOptions(embedding="gru/10"),
        progress=False,
    )  # fmt: skip
    assert torch.isfinite(posterior.sample(10)["mass"]).all()


def test_several_sites_and_rollouts_by_name(recording, quick):
    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        for name in ("first", "second"):
            npdr.simulate(name, pendulum_simulator(), {"mass": mass}, inputs[name], noise=0.1)

    data = {"first": recording[[0]], "second": recording[[1]]}
    posterior = npdr.infer(model, data, backend=quick, num_simulations=60, progress=False)
    assert set(posterior.predict(3)) == {"first", "second"}
    with pytest.raises(
        DataError, match="data are for first, third, but the model asks for 'second'"
    ):
        npdr.infer(model, {"first": recording, "third": recording}, progress=False)


def pendulum_simulator():
    from npdr_ppl.models.pendulum import Pendulum

    return Pendulum()


@pytest.mark.slow
def test_a_sensor_that_sees_only_the_position(noisy_pendulum, recording, quick):
    positions = recording.select(["angle"])
    posterior = npdr.infer(
        noisy_pendulum, positions, backend=quick, num_simulations=60, progress=False
    )
    assert posterior.bound.observations["trajectory"].channels == (0,)
    with pytest.raises(DataError, match="velocity was not recorded"):
        npdr.infer(
            noisy_pendulum,
            positions,
            options=npdr.DataOptions(initial_state="recorded"),
            progress=False,
        )


def test_a_function_may_leave_torch(quick):
    def in_numpy(theta):
        return torch.from_numpy(theta.numpy() ** 3)[:, None]

    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0))
        npdr.simulate("x", in_numpy, {"theta": theta}, noise=0.1)

    posterior = npdr.infer(
        model, torch.tensor([0.5]), backend=quick, num_simulations=200, progress=False
    )
    assert posterior.problem.log_likelihood is None


@pytest.fixture(params=[True, False])
def is_validating(request):
    """Torch's default, which libraries change when they are imported or have run."""
    before = torch.distributions.Distribution._validate_args
    torch.distributions.Distribution.set_default_validate_args(request.param)
    yield request.param
    torch.distributions.Distribution.set_default_validate_args(before)


def test_failed_simulations_cost_only_themselves(quick, is_validating):
    def sometimes_nan(theta):
        return torch.where(theta < -0.8, torch.nan, theta)[:, None]

    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0))
        npdr.simulate("x", sometimes_nan, {"theta": theta}, noise=0.1)

    posterior = npdr.infer(
        model, torch.tensor([0.5]), backend=quick, num_simulations=200, progress=False
    )
    assert posterior.provenance.rounds[0].num_failed > 10
    assert abs(posterior.sample(200)["theta"].mean() - 0.5) < 0.5

    def broken():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0))
        npdr.simulate("x", lambda theta: theta[:, None] * torch.nan, {"theta": theta})

    with pytest.raises(npdr.NpdrError, match="Every simulation failed"):
        npdr.infer(broken, torch.tensor([0.5]), num_simulations=50, progress=False)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (torch.zeros(3), r"shape \(3,\), but the model simulates \(2,\)"),
        (torch.tensor([0.0, torch.nan]), "contains NaN"),
    ],
)
def test_bad_observations_are_refused(linear, data, sentence):
    with pytest.raises((ShapeError, DataError), match=sentence):
        npdr.infer(linear[0], data, progress=False)


def test_bad_settings_are_refused(linear, recording):
    model, observed = linear
    with pytest.raises(BackendError, match="did you mean 'snpe-c'"):
        npdr.infer(model, observed, backend="snpec", progress=False)
    with pytest.raises(BackendError, match="rounds must be at least 1"):
        npdr.infer(model, observed, rounds=0, progress=False)
    with pytest.raises(ModelError, match="no embedding 'everything'"):
        npdr.infer(
            pendulum, recording, options=npdr.DataOptions(embedding="everything"), progress=False
        )
    with pytest.raises(DataError, match="give rollouts, not a tensor"):
        npdr.infer(lambda _=None: pendulum(recording.inputs()), observed, progress=False)
    with pytest.raises(DataError, match="column torque is missing"):
        from dataclasses import replace

        npdr.infer(pendulum, replace(recording, action_names=("voltage",)), progress=False)


def test_data_in_degrees_are_converted_and_recordings_added_twice_are_used_once(recording):
    from dataclasses import replace

    from npdr_ppl.posterior.prepare import prepare

    degrees = replace(
        recording, readings=tuple(values * [57.2958, 1.0] for values in recording.readings)
    )
    prepared = prepare(pendulum, degrees, npdr.DataOptions())
    assert prepared.rollouts.notes == (
        "angle looks recorded in degrees, not in SI units; converted.",
    )
    assert np.allclose(prepared.rollouts.readings[0], recording.readings[0], atol=1e-5)
    strict = npdr.DataOptions(strict=True)
    with pytest.raises(DataError, match="angle"):
        prepare(pendulum, degrees, strict)
    twice = prepare(pendulum, recording[[0, 0]], npdr.DataOptions())
    assert twice.rollouts.spans[1] == () and "identical to rollout 0" in twice.rollouts.notes[0]
    with pytest.raises(DataError, match="identical"):
        prepare(pendulum, recording[[0, 0]], strict)


def test_a_folder_without_a_run_is_free_for_any_fit(tmp_path):
    recording = swinging()
    asked = tmp_path / "asked.json"
    for seed in (0, 1):
        begin_fit(tmp_path, pendulum, recording, backend("snpe-c"), None, seed, 100)
        assert json.loads(asked.read_text())["seed"] == seed
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    begin_fit(tmp_path, pendulum, recording, backend("snpe-c"), None, 1, 100)
    with pytest.raises(DataError, match="differs in seed"):
        begin_fit(tmp_path, pendulum, recording, backend("snpe-c"), None, 0, 100)
    # A run of an earlier version has a check of its own, later.
    asked.unlink()
    begin_fit(tmp_path, pendulum, recording, backend("snpe-c"), None, 0, 100)
    assert not asked.exists()
