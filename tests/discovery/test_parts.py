"""The parts of discovery, each alone."""

import json
import math
import os
import re
import runpy
import sys
import threading
import time
from dataclasses import replace

import pyro.distributions as dist
import pytest
import torch
from hidden_rigs import make_case, places
from torch.distributions import AffineTransform

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.discovery.revised_model import revised_source
from npdr_ppl.discovery.screening.equivalents import equivalents, irreducible
from npdr_ppl.discovery.screening.generic_laws import reading_laws, ringing_laws
from npdr_ppl.discovery.screening.latent_force import latent_force, responses
from npdr_ppl.discovery.screening.permutation_tests import LargestStatistic
from npdr_ppl.discovery.screening.projection import Projection, loss_without
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.screening.settings import ALARM, SENSITIVITY
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.evidence import weigh
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.side_by_side import side_by_side
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import (
    AsymmetricCoulombFriction,
    Bias,
    Cogging,
    CoulombFriction,
    EncoderBias,
    InputDelay,
    QuadraticDrag,
    SupplySag,
    ViscousFriction,
    candidate_effects,
)
from npdr_ppl.models.pendulum import Pendulum, pendulum


@pytest.fixture(scope="module")
def quiet():
    """A pendulum without anything hidden, fitted."""
    case = make_case("pendulum", "null", (), seed=2001)
    binding = npdr.DiscoveryOptions().binding(case.fit)
    return fit_hypothesis(case.model, case.fit, binding)


@pytest.fixture(scope="module")
def dragged():
    """A pendulum in a hidden drag, fitted without it."""
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=0.3, seed=2001)
    binding = npdr.DiscoveryOptions().binding(case.fit)
    return case, fit_hypothesis(case.model, case.fit, binding)


def test_parameters_cannot_explain_what_is_left_of_a_column(quiet):
    projection = Projection(quiet)
    own = quiet.linearisation.by_parameters
    scores = projection.scores(own)
    # The prior, worth one standard deviation, is all that keeps the rest from zero.
    assert scores.information.diagonal().max() < 1.0
    assert scores.absorbed.min() > 0.99


def test_sensitivities_are_derivatives(quiet):
    (variant,) = sensitivities(quiet, (QuadraticDrag("hinge"),))
    segments, fit = quiet.segments, quiet.fit
    box = segments.black_box(fit.z[None])
    values = {k: v[None] for k, v in variant.parameters(torch.tensor([0.01]).double()).items()}
    changed = box.simulator.with_effects(variant.effect)
    moved = segments.run(changed, {**box.parameters, **values}, fit.offsets[None])[0]
    base = segments.run(box.simulator, box.parameters, fit.offsets[None])[0]
    expected = ((moved - base).double() / fit.scale).flatten(-2) / 0.01
    difference = (variant.change[..., 0] - expected).norm() / expected.norm()
    assert difference < 0.02


def test_an_effect_that_changes_nothing_but_the_last_digits_is_no_candidate():
    case = make_case("emps", "null", seed=2001)
    fitted = fit_hypothesis(case.model, case.fit, npdr.DiscoveryOptions().binding(case.fit))
    # No force of this drive depends on where it is.
    assert not list(sensitivities(fitted, (EncoderBias("position"),)))
    assert list(sensitivities(fitted, (CoulombFriction("carriage"),)))


def test_no_p_value_is_smaller_than_one_in_all_draws(dragged):
    _, hypothesis = dragged
    generator = torch.Generator().manual_seed(0)
    shape = (*hypothesis.linearisation.residual.shape, 1)
    found = LargestStatistic(Projection(hypothesis), seed=0, draws=100)
    for _ in range(20):
        (value,) = found.p_values([torch.randn(shape, generator=generator).double()])
        assert value >= 1 / 100


def test_chance_gives_uniform_p_values(quiet):
    projection = Projection(quiet)
    generator = torch.Generator().manual_seed(3)
    shape = (*quiet.linearisation.residual.shape, 1)
    smallest = []
    for seed in range(40):
        columns = [torch.randn(shape, generator=generator).double() for _ in range(5)]
        smallest.append(min(LargestStatistic(projection, seed=seed, draws=400).p_values(columns)))
    # 40 uniform draws: fewer than three below 0.005, and a mean within four standard errors.
    assert sum(p < 0.005 for p in smallest) < 3
    assert abs(sum(smallest) / 40 - 0.5) < 4 * math.sqrt(1 / 12 / 40)


def test_a_drag_is_no_chance(dragged):
    _, hypothesis = dragged
    (variant,) = sensitivities(hypothesis, (QuadraticDrag("hinge"),))
    values = LargestStatistic(Projection(hypothesis), seed=0, draws=400).p_values([variant.change])
    assert values == [1 / 400]


def test_errors_of_a_sensor_that_depend_on_its_reading_are_no_chance(quiet):
    projection = Projection(quiet)
    laws = reading_laws(projection)
    groups = [law.change for law in laws]
    assert min(LargestStatistic(projection, seed=0).p_values(groups)) > 0.01
    names = [law.name for law in laws]
    own = projection.projected(groups[names.index("angle: error of sin 2 angle")])[..., 0]
    projection.residual = projection.residual + 10.0 * own / own.norm()
    values = LargestStatistic(projection, seed=0).p_values(groups)
    assert names[values.index(min(values))].startswith("angle: error of ")
    assert min(values) < 0.01


@pytest.mark.slow
def test_what_rings_is_heard_at_its_frequency(quiet):
    hidden = make_case(
        "pendulum", "one", (("hinge", "joint_elasticity"),), strength=1.0, seed=2001
    )
    binding = npdr.DiscoveryOptions().binding(hidden.fit)
    ringing = Projection(fit_hypothesis(hidden.model, hidden.fit, binding))

    def heard(projection):
        laws = ringing_laws(projection)
        values = LargestStatistic(projection, seed=0).p_values([law.change for law in laws])
        gains = [projection.scores(law.change).gain(slice(None)) for law in laws]
        return min(values), laws[gains.index(max(gains))].name

    from_which_on = ALARM.ringing_share * npdr.DiscoveryOptions().false_alarm_rate
    assert heard(Projection(quiet))[0] > from_which_on
    p_value, strongest = heard(ringing)
    assert p_value <= from_which_on
    (true,) = hidden.truth
    frequency = 1.0 / (2.0 * math.pi * true.parameters["time_constant"])
    found = float(strongest.removeprefix("angle: ringing at ").removesuffix(" Hz"))
    # The next frequency that is tried is a ninth away.
    assert found == pytest.approx(frequency, rel=0.15)


def test_the_latent_force_is_the_drag(dragged):
    case, hypothesis = dragged
    found = responses(hypothesis)
    (latent,) = latent_force(Projection(hypothesis), found)
    speed = found.channels["velocity"]
    drag = case.truth[0].parameters["drag"]
    # Parameters were fitted, so part of the drag hides in them; its shape remains.
    both = torch.stack((latent.force.flatten(), (-drag * speed * speed.abs()).flatten()))
    assert torch.corrcoef(both)[0, 1] > 0.6
    assert bool((latent.error > 0).all())


def test_weights_prefer_the_true_effect_and_sum_to_one(dragged):
    case, hypothesis = dragged
    binding = npdr.DiscoveryOptions().binding(case.fit)
    others = [
        fit_hypothesis(case.model, case.fit, binding, effects=(effect,))
        for effect in (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    ]
    weights = weigh([hypothesis, *others], [0.0, 0.0, 0.0], seed=0)
    assert sum(weights) == pytest.approx(1.0)
    assert weights[1] > 0.99


def test_sums_of_effects_are_not_searched_beside_their_parts():
    every = candidate_effects(Pendulum())
    names = {effect.name for effect in irreducible(every)}
    assert "hinge.asymmetric_coulomb_friction" not in names
    alone = irreducible((AsymmetricCoulombFriction("hinge"), InputDelay("torque")))
    assert {effect.id for effect in alone} == {"asymmetric_coulomb_friction", "input_delay"}


def test_equivalents_name_sums_only_with_all_their_parts():
    without = equivalents(CoulombFriction("hinge"), ("hinge.coulomb_friction",))
    both = equivalents(CoulombFriction("hinge"), ("hinge.coulomb_friction", "hinge.bias"))
    assert "coulomb_friction + bias" not in without
    assert "coulomb_friction + bias" in both


def test_the_revised_source_is_a_model(tmp_path):
    source = revised_source(pendulum, (QuadraticDrag("hinge"), Bias("hinge")), {"mass": 1.0})
    path = tmp_path / "revised_model.py"
    path.write_text(source)
    model = runpy.run_path(str(path))["revised_model"]
    assert [effect.name for effect, _ in model.effects] == ["hinge.quadratic_drag", "hinge.bias"]


def test_the_revised_source_keeps_finer_steps(tmp_path):
    path = tmp_path / "revised_model.py"
    finest = npdr.with_finer_steps(npdr.with_finer_steps(pendulum))
    path.write_text(revised_source(finest, (Bias("hinge"),), {}))
    model = runpy.run_path(str(path))["revised_model"]
    assert repr(model) == "pendulum + hinge.bias"
    assert repr(model.base) == "pendulum in still finer steps"


def test_the_revised_source_keeps_priors_that_were_given(tmp_path):
    path = tmp_path / "revised_model.py"
    drag = QuadraticDrag("hinge", priors={"drag": dist.LogNormal(-3.0, 0.1)})
    shifted = dist.TransformedDistribution(dist.Normal(0.0, 1.0), [AffineTransform(0.3, 0.1)])
    bias = Bias("hinge", priors={"offset": shifted})
    cogging = Cogging("hinge", order=7, priors={"sine": dist.Normal(0.1, 0.2)})
    path.write_text(revised_source(pendulum, (drag, bias, cogging), {}))
    model = runpy.run_path(str(path))["revised_model"]
    (found, _), (other, _), (ripple, _) = model.effects
    assert ripple.order == 7 and list(ripple.given_priors) == ["sine"]
    prior = found.given_priors["drag"]
    assert (type(prior), float(prior.loc), float(prior.scale)) == (
        dist.LogNormal, -3.0, pytest.approx(0.1)
    )  # fmt: skip
    # Transforms of one's own have no source. The file says so and still is a model.
    assert not other.given_priors
    assert "# The prior given to hinge.bias.offset has no source: put it here." in path.read_text()


@pytest.mark.slow
def test_saving_writes_json_with_the_names_of_the_architecture(tmp_path):
    case = make_case("pendulum", "null", (), seed=2001)
    options = npdr.DiscoveryOptions(effects=(QuadraticDrag("hinge"),))
    found = npdr.discover(case.model, case.fit, holdout=case.holdout, options=options)
    found.save(tmp_path)
    written = json.loads((tmp_path / "discovery.json").read_text())
    assert written["verdict"] == "none"
    assert {"alarm", "where", "effects", "ranking", "gap", "next_experiment"} <= set(written)
    assert {"before", "after", "noise_floor", "closed"} == set(written["gap"]["rmse"])
    assert {"rollout", "time_span", "channel", "region", "z"} == set(written["where"][0])


def test_an_infinite_estimate_is_null_in_json():
    estimate = Estimate(math.inf, 1.0, (0.0, math.inf), "m")
    assert estimate.to_dict() == {"mean": None, "sd": 1.0, "hdi_94": [0.0, None], "unit": "m"}


@pytest.mark.slow
def test_the_same_seed_finds_the_same():
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=0.3, seed=2001)
    effects = (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    options = npdr.DiscoveryOptions(effects=effects, max_effects=1)
    first, second = (npdr.discover(case.model, case.fit, options=options) for _ in range(2))
    assert first.effects[0].to_dict() == second.effects[0].to_dict()
    assert first.alarm == second.alarm


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "seed"),
    [(0, 1040), (1, 1040), (1, 1041)],
    ids=["infinite starts", "infinite derivatives", "derivatives with infinite squares"],
)
def test_degrees_from_which_simulations_fail_are_told_in_a_sentence(place, seed):
    spoilt = places("cart_pole", "bad_data", seed)[place]
    case = make_case("cart_pole", "bad_data", spoilt, seed=seed)
    # Where some fit succeeds the recording is refused by its verdict, elsewhere by an error.
    try:
        found = npdr.discover(case.model, case.fit)
    except DataError as error:
        told = str(error)
    else:
        assert found.verdict == "unknown"
        assert found.effects == []
        told = found.reason
    assert re.search(r"rad; are these degrees\?$", told)


def test_a_fit_beside_which_a_segment_explodes_is_refused(quiet):
    exploding = quiet.linearisation.by_starts.clone()
    exploding[0] = 1e100  # finite, and so are its squares; 1 + Gᵀ G is singular
    beside = replace(quiet)
    vars(beside)["_linearised"] = replace(quiet.linearisation, by_starts=exploding)
    with pytest.raises(DataError, match="Simulations fail right beside the model's closest fit"):
        Projection(beside)


def test_numbers_of_rollouts_are_no_rollouts():
    case = make_case("pendulum", "null", (), seed=2001)
    with pytest.raises(DataError, match=r"takes rollouts, e.g. rollouts\[\[3\]\]"):
        npdr.discover(case.model, case.fit, holdout=(3,))


def test_too_short_a_recording_is_refused():
    case = make_case("pendulum", "null", (), seed=2001)
    with pytest.raises(DataError, match="too few"):
        npdr.discover(case.model, case.fit, options=npdr.DiscoveryOptions(segment_length=500))


@pytest.mark.parametrize("wrong", [{"segment_length": 1}, {"false_alarm_rate": 0.0}])
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(DataError):
        npdr.DiscoveryOptions(**wrong)


def test_what_is_lost_without_an_effect_is_known_without_a_fit(dragged):
    case, without = dragged
    drag = QuadraticDrag("hinge")
    binding = npdr.DiscoveryOptions().binding(case.fit)
    fitted = fit_hypothesis(case.model, case.fit, binding, effects=(drag,))
    scale = fitted.fit.scale
    lost = fitted.share * float((without.losses(scale) - fitted.losses(scale)).sum())
    assert loss_without(fitted, drag) == pytest.approx(lost, rel=0.1)


def test_averages_of_neighbours_keep_noise_white_and_slow_changes_apart(quiet):
    segments = quiet.segments
    steps = segments.inputs.num_steps
    averaged = segments.averaged(segments.observed.numel() // 3, steps // 3)
    assert averaged.steps_per_average == 3
    scale = torch.ones(segments.observed.shape[-1], dtype=torch.float64)
    torch.manual_seed(0)
    noise = torch.randn(segments.observed.shape, dtype=torch.float64)
    assert averaged.whitened(noise, scale).std() == pytest.approx(1.0, abs=0.05)
    slow = torch.linspace(1.0, 2.0, steps, dtype=torch.float64)[:, None].expand_as(noise)
    distance = averaged.whitened(slow, scale).norm() / segments.whitened(slow, scale).norm()
    assert 0.97 < float(distance) <= 1.0
    assert segments.averaged(segments.observed.numel(), 1) is segments


def test_effects_that_are_simulated_together_do_what_each_does_alone(quiet, monkeypatch):
    effects = candidate_effects(quiet.simulator)
    together = list(sensitivities(quiet, effects))
    one_by_one = replace(SENSITIVITY, segments_per_part=1)
    monkeypatch.setattr("npdr_ppl.discovery.screening.sensitivities.SENSITIVITY", one_by_one)
    alone = list(sensitivities(quiet, effects))
    by_name = {variant.effect.name: [] for variant in alone}
    for variant in alone:
        by_name[variant.effect.name].append(variant.change)
    assert len(together) == len(alone)
    for variant in together:
        assert torch.equal(variant.change, by_name[variant.effect.name].pop(0))


def test_candidates_far_behind_what_was_found_are_not_tried(dragged):
    case, base = dragged
    effects = (
        *(
            law("hinge")
            for law in (QuadraticDrag, ViscousFriction, CoulombFriction, Bias, Cogging)
        ),
        SupplySag("torque"),
    )
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=effects))
    ranking = searcher.look(base).ranking
    gains = {candidate.name: candidate.gain for candidate in ranking}
    tried = Trials(case.model, case.fit, searcher.binding).extended(base, ranking)
    assert list(tried)[:2] == [candidate.name for candidate in ranking[:2]]
    assert next(iter(tried)) == "hinge.quadratic_drag"
    missed = gains.keys() - tried.keys()
    assert missed
    # Even four times their linear gain would leave them 30 units of evidence behind.
    assert all(4.0 * gains[name] < gains["hinge.quadratic_drag"] for name in missed)


@pytest.mark.slow
def test_every_effect_gets_its_own_rivals(dragged):
    case, _ = dragged
    three = QuadraticDrag("hinge"), CoulombFriction("hinge"), Bias("hinge")
    options = npdr.DiscoveryOptions(effects=(*three, Cogging("hinge")))
    searcher = Searcher(case.model, case.fit, options)
    two, all_three, ripple = (
        fit_hypothesis(case.model, case.fit, searcher.binding, effects=effects)
        for effects in (three[:2], three, (*three[:2], Cogging("hinge")))
    )
    # The last one's were tried when it was added.
    tried = {"hinge.bias": all_three, "hinge.cogging": ripple}
    rounds = [searcher.look(searcher.fit_base()), replace(searcher.look(two), trials=tried)]
    _, added, trials = searcher.with_rivals(all_three, rounds)
    assert [each.place for each in added] == [effect.name for effect in three]
    for effect in three:
        others = {other.name for other in three} - {effect.name}
        assert set(trials[effect.name, "hinge.cogging"].names) == others | {"hinge.cogging"}
    # The drag is there and the others are not, so that all is lost without it.
    assert added[0].share > 0.5 > added[2].share


@pytest.mark.slow
def test_two_processes_find_what_one_finds(dragged):
    case, _ = dragged
    effects = (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    options = npdr.DiscoveryOptions(effects=effects, max_effects=1)
    alone = npdr.discover(case.model, case.fit[[0]], options=options)
    with npdr.workers("loky", 2) as used:
        together = npdr.discover(case.model, case.fit[[0]], options=options)
    assert used.is_used
    kinds = [{k: v for k, v in d.to_dict().items() if k != "seconds"} for d in (alone, together)]
    assert kinds[0] == kinds[1]
    assert kinds[0]["effects"][0]["effect"] == "quadratic_drag"


def test_what_cannot_travel_is_done_here():
    lock = threading.Lock()

    def doubled(x):
        with lock:
            return 2 * x

    assert list(side_by_side(doubled, [1, 2, 3], 2)) == [2, 4, 6]


@pytest.mark.slow
def test_a_process_that_is_replaced_as_its_memory_has_grown_is_no_warning(recwarn):
    def hoarding(x):
        # A half more than what the executor takes for a leak, after the second it waits to look;
        # kept where it outlives this function, which travels anew with every item.
        hoard = sys.modules["__main__"].__dict__.setdefault("hoard", [])
        hoard.append(torch.ones(450_000_000 // 4))
        time.sleep(1.1)
        return os.getpid()

    assert len(set(side_by_side(hoarding, range(6), 2))) > 2
    assert not [str(warning.message) for warning in recwarn]


class WhiteNoise:
    """Stands for a fitted hypothesis whose residuals are white, with nothing to refit."""

    def __init__(self, residual):
        self.residual = residual

    def whitened(self, columns):
        return columns

    projected = whitened


def test_what_shows_in_one_segment_only_is_heard():
    """Dealing every segment its own residuals now and then would take it for chance."""
    generator = torch.Generator().manual_seed(0)
    residual = torch.randn(30, 20, generator=generator).double()
    columns = torch.zeros(30, 20, 1).double()
    columns[7] = torch.randn(20, 1, generator=generator).double()
    columns[7] /= columns[7].norm()
    others = [torch.randn(30, 20, 1, generator=generator).double() for _ in range(40)]

    def p_value(size):
        changed = WhiteNoise(residual + size * columns[..., 0])
        return LargestStatistic(changed, seed=0).p_values([columns, *others])[0]

    assert p_value(0.0) > 0.05
    assert p_value(6.0) < 0.01  # at least 1 / 60 if it kept its own
