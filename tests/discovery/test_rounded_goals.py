"""Goals that a servo rounds: the step is found from the recording."""

import math
from dataclasses import replace

import pytest
import servo_law_rigs
import torch

import npdr_ppl as npdr
from npdr_ppl.cli.resolve import resolve_model
from npdr_ppl.discovery.screening.groups import ranked_laws
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.rounded_commands import strongest_rounding
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.settings import GENERIC_LAWS
from npdr_ppl.discovery.screening.variants import variants_of
from npdr_ppl.discovery.search.alternatives import log_prior
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.models.effects import GoalResolution, GoalSpeedLimit, ServoDeadBand


@pytest.fixture(scope="module")
def rounded(tmp_path_factory):
    """A case, and a searcher with the fit of the user's file to its first rollout."""
    file = tmp_path_factory.mktemp("arm") / "arm.xml"
    file.write_text(servo_law_rigs.mjcf())
    case = servo_law_rigs.make_case("coarse_goal", 1000)
    effects = (GoalResolution("servo"), GoalSpeedLimit("servo"), ServoDeadBand("servo"))
    options = npdr.DiscoveryOptions(effects=effects)
    searcher = Searcher(resolve_model(str(file)), case.rollouts[[0]], options)
    return case, searcher, searcher.fit_base()


@pytest.mark.slow
def test_the_strongest_step_is_the_hidden_one(rounded):
    case, _, base = rounded
    found = responses(base)
    step = strongest_rounding(Projection(base), found, "servo", "hinge_torque", 0.02)
    assert step == pytest.approx(case.values["step"], rel=5e-4)


@pytest.mark.slow
def test_only_the_whole_step_is_screened_and_comes_first(rounded):
    case, searcher, base = rounded
    projection = Projection(base)
    every = list(variants_of(searcher.options.effects, projection, responses(base)))
    hinted = [variant for variant in every if variant.is_hinted]
    assert [variant.effect.id for variant in hinted] == ["goal_resolution"]
    best = screen(projection, every)[0]
    assert best.name == "servo.goal_resolution" and best.sizes.tolist() == pytest.approx(
        [1.0], abs=1e-5
    )
    assert best.variant.values["step"] == pytest.approx(case.values["step"], rel=5e-4)


@pytest.mark.slow
def test_a_fit_that_begins_there_finds_the_step(rounded):
    case, searcher, base = rounded
    best = screen(
        Projection(base), variants_of(searcher.options.effects, Projection(base), responses(base))
    )[0]
    start = best.variant.parameters(best.sizes)
    found = searcher.trials.refitted(base, (best.variant.effect,), start=start)
    step = float(found.parameters["servo.goal_resolution.step"])
    assert step == pytest.approx(case.values["step"], rel=1e-3)
    # One of many steps explains something by chance.
    assert log_prior(found) == log_prior(base) - math.log(GENERIC_LAWS.num_roundings)


def test_a_constant_command_has_no_step(rounded):
    _, _, base = rounded
    found = responses(base)
    held = torch.full_like(found.channels["servo"], 0.3)
    still = replace(found, channels={**found.channels, "servo": held})
    assert strongest_rounding(Projection(base), still, "servo", "hinge_torque", 0.02) is None


@pytest.mark.slow
def test_the_same_law_at_three_servos_is_weighed_with_found_steps(rounded):
    _, searcher, base = rounded
    projection = Projection(base)
    best = screen(projection, variants_of(searcher.options.effects, projection, responses(base)))[
        0
    ]
    three = [
        replace(best, variant=replace(best.variant, effect=GoalResolution(f"servo_{k}")))
        for k in range(3)
    ]
    groups = ranked_laws(projection, three)
    assert all(len(group.members) >= 2 for group in groups)
