"""Effects that may be added to a hypothesis, with priors that suit the recording's time step."""

import numpy as np
import pyro
import pytest
from pyro.distributions import HalfNormal, LogNormal, Normal, Uniform

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.language.channels import Port
from npdr_ppl.models.effects import (
    ActuatorLag,
    CoulombFriction,
    InputDelay,
    QuadraticDrag,
    ViscousFriction,
)
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


def test_coefficients_of_slow_joints_may_be_larger():
    port = Port("hinge", "force", "N m", rated=2.0, rated_speed=20.0)
    drag = QuadraticDrag("hinge")
    own, slow = (e.priors(port)["drag"].variance.sqrt() for e in (drag, drag.at_speed(port, 2.0)))
    assert float(slow / own) == pytest.approx(100.0)
    assert drag.at_speed(port, 30.0) is drag
    given = QuadraticDrag("hinge", priors={"drag": HalfNormal(1e-3)})
    assert given.at_speed(port, 2.0) is given
    dry = CoulombFriction("hinge")
    assert dry.at_speed(port, 2.0) is dry


def test_a_search_takes_the_speed_of_a_robots_joints_from_the_recording(tmp_path):
    """Its file says how much torque a motor has, but not how fast the joint moves."""
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 0 1"/>
      <geom size="0.1" mass="1"/></body></worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
    (tmp_path / "robot.xml").write_text(xml)
    robot = npdr.MujocoSimulator(tmp_path / "robot.xml", {"mass": "body body_1 mass"})

    def model(inputs):
        mass = pyro.sample("mass", Uniform(0.5, 2.0))
        return npdr.simulate("trajectory", robot, {"mass": mass}, inputs)

    time = 0.01 * np.arange(81)
    rollouts = Rollouts.from_arrays(
        readings=np.stack([0.2 * np.sin(6.0 * time)], -1)[None],
        actions=np.zeros((1, 80, 1)), channel_names=("hinge",),
        action_names=tuple(action.name for action in robot.actions), time_step=0.01,
    )  # fmt: skip
    hypothesis = fit_hypothesis(model, rollouts, DataOptions(None, 20), max_steps=0)
    port = robot.port("hinge_torque")
    assert port.rated_speed > 20.0
    drag = next(
        e for e in candidates_at(hypothesis, npdr.DiscoveryOptions()) if e.id == "quadratic_drag"
    )
    # The recording reaches 1.2 rad/s.
    expected = HalfNormal(0.1 * port.rated / 1.2**2)
    ratio = drag.priors(port)["drag"].variance.sqrt() / expected.variance.sqrt()
    assert 0.8 < float(ratio) < 1.5


def test_damping_that_a_robots_model_holds_may_be_corrected_downwards(tmp_path):
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 0 1" damping="0.1"/>
      <geom size="0.1" mass="1"/></body></worldbody>
      <actuator><position name="servo" joint="hinge" kp="10" kv="1"/></actuator></mujoco>"""
    (tmp_path / "robot.xml").write_text(xml)
    rollouts = Rollouts.from_arrays(
        readings=np.zeros((1, 41, 1)), actions=np.zeros((1, 40, 1)), channel_names=("hinge",),
        action_names=("servo",), time_step=0.01,
    )  # fmt: skip

    def prior(held, **given):
        robot = npdr.MujocoSimulator(
            tmp_path / "robot.xml", {"kv": "actuator servo kv"}, held=held
        )

        def model(inputs):
            kv = pyro.sample("kv", Uniform(0.5, 2.0))
            return npdr.simulate("trajectory", robot, {"kv": kv}, inputs)

        fitted = fit_hypothesis(model, rollouts, DataOptions(None, 20, "estimated"), max_steps=0)
        options = npdr.DiscoveryOptions(effects=(ViscousFriction("hinge_torque", **given),))
        (effect,) = candidates_at(fitted, options)
        return effect.priors(robot.port("hinge_torque"))["damping"]

    known, uncertain = prior(()), prior(["joint hinge damping"])
    assert isinstance(known, HalfNormal) and isinstance(uncertain, Normal)
    assert float(uncertain.mean) == 0.0 and uncertain.cdf(known.scale) > 0.84
    given = HalfNormal(0.02)
    assert prior(["joint hinge damping"], priors={"damping": given}) is given
