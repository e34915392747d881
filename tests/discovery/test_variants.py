"""Effects that may be added to a hypothesis, with priors that suit the recording's time step."""

import numpy as np
import pytest
from pyro.distributions import LogNormal, Uniform

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.models.effects import ActuatorLag, InputDelay
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts


def sampled(time_step):
    """Returns a pendulum with 40 samples of a swing, at the middle of its priors."""
    time = time_step * np.arange(41)
    rollouts = Rollouts.from_arrays(
        readings=np.stack([np.sin(3.0 * time), 3.0 * np.cos(3.0 * time)], -1)[None],
        actions=np.zeros((1, 40, 1)), channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=time_step,
    )  # fmt: skip
    return fit_hypothesis(pendulum, rollouts, DataOptions(None, 20, "recorded"), max_steps=0)


def priors_of_times(hypothesis, options):
    """Returns the priors of all delays and time constants of the candidates."""
    return {
        site: effect.priors(hypothesis.simulator.port(effect.port))[parameter.name]
        for effect in candidates_at(hypothesis, options)
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
        if parameter.unit == "s"
    }


def upper_ends(priors):
    return {name: float(p.high) for name, p in priors.items() if isinstance(p, Uniform)}


def test_a_search_reaches_delays_and_lags_of_three_time_steps():
    options = npdr.DiscoveryOptions()
    slow = upper_ends(priors_of_times(sampled(0.05), options))
    kinds = {name.split(".", 1)[1] for name in slow}
    assert {"input_delay.delay", "sensor_delay.delay"} <= kinds
    assert {"actuator_lag.time_constant", "sensor_low_pass.time_constant"} <= kinds
    assert slow == pytest.approx(dict.fromkeys(slow, 0.15))
    # Priors that are longer than three steps are kept.
    fast = upper_ends(priors_of_times(sampled(0.005), options))
    assert set(fast) == set(slow) and min(fast.values()) > 0.015
    assert fast["torque.input_delay.delay"] == pytest.approx(0.03)


def test_priors_of_times_that_were_given_are_searched_as_they_are():
    given = InputDelay("torque", priors={"delay": Uniform(0.0, 0.02)}), ActuatorLag("torque")
    found = priors_of_times(sampled(0.05), npdr.DiscoveryOptions(effects=given))
    assert upper_ends(found) == {
        "torque.input_delay.delay": pytest.approx(0.02),
        "torque.actuator_lag.time_constant": pytest.approx(0.15),
    }
    given = (InputDelay("torque", priors={"delay": LogNormal(-4.0, 0.5)}),)
    found = priors_of_times(sampled(0.05), npdr.DiscoveryOptions(effects=given))
    assert found == {"torque.input_delay.delay": given[0].given_priors["delay"]}
