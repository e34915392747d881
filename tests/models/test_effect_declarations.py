"""What effects declare: classes, ports, units, probes; the registry; where they may attach."""

import doctest
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import get_args

import mujoco
import pytest

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effect_context import Excitation
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.effects import (
    EQUIVALENCE_CLASSES,
    Bias,
    Cogging,
    CoulombFriction,
    Spring,
    Tilt,
    Unbalance,
    candidate_effects,
    effect_class,
    effects,
)
from npdr_ppl.models.effects.registry import GROUP
from npdr_ppl.models.furuta import Furuta


def test_the_catalogue_has_all_effects_with_what_discovery_needs():
    catalogue = effects()
    assert len(catalogue) == 42
    for name, effect in catalogue.items():
        assert effect.id == name
        assert effect.law and effect.reference
        names = {parameter.name for parameter in effect.parameters}
        assert set(effect.strength) <= names
        assert {effect.wave} - {""} <= names - set(effect.strength)
        assert effect.excitation in get_args(Excitation)
        for kind in effect.equivalence:
            assert any(name in member.split(" + ") for member in kind.members)


def test_equivalence_classes_and_effects_name_each_other():
    catalogue = effects()
    for kind in EQUIVALENCE_CLASSES:
        ids = [part for member in kind.members for part in member.split(" + ")]
        known = [name for name in ids if name in catalogue]
        assert known
        assert all(kind in catalogue[name].equivalence for name in known)
        outside = [name for name in ids if name not in catalogue]
        assert not [name for name in outside if "_" in name], "an effect was renamed"


def test_wrong_ports_are_named():
    with pytest.raises(ModelError, match="kind force"):
        Furuta().with_effects(CoulombFriction("voltage"))
    with pytest.raises(ModelError, match="no port 'elbow'"):
        Furuta().with_effects(CoulombFriction("elbow"))
    with pytest.raises(ModelError, match="attached to Furuta already"):
        Furuta().with_effects(CoulombFriction("arm"), CoulombFriction("arm"))


def test_units_are_those_of_the_port():
    port = Furuta().port("arm")
    assert CoulombFriction("arm").units(port) == {"magnitude": "N m"}


def test_candidates_are_where_they_make_sense():
    names = {effect.name for effect in candidate_effects(Furuta())}
    assert "arm.backlash" in names and "pole.backlash" not in names
    assert {n.removesuffix(".sensor_delay") for n in names if n.endswith("sensor_delay")} == {
        "arm_angle,arm_velocity",
        "pole_angle,pole_velocity",
        "arm_velocity,pole_velocity",
        "arm_angle,pole_angle,arm_velocity,pole_velocity",
    }
    assert {"arm_velocity,pole_velocity.sensor_low_pass", "arm_velocity.sensor_low_pass"} < names
    assert {"arm_angle,pole_angle.quantisation", "arm_angle.quantisation"} < names
    assert "arm_angle,pole_angle,arm_velocity,pole_velocity.quantisation" not in names
    assert "arm_angle,pole_angle.encoder_bias" not in names
    assert "arm_velocity.encoder_bias" not in names
    assert {"gravity.tilt", "payload.payload", "clock.clock_skew"} < names
    assert "gravity.payload" not in names and "payload.tilt" not in names
    assert "motor_resistance.parameter_drift" in names
    assert not {"pole_mass.parameter_drift", "gravity.parameter_drift"} & names
    on_rails = {effect.name for effect in candidate_effects(CartPole())}
    assert {"cart_velocity.quantisation", "pole_velocity.quantisation"} < on_rails
    assert "cart_velocity,pole_velocity.quantisation" not in on_rails
    assert "hinge.unbalance" in on_rails and "rail.unbalance" not in on_rails
    attached = Furuta().with_effects(*candidate_effects(Furuta())[:3])
    assert len(candidate_effects(attached)) == len(names) - 3


def test_servos_have_their_own_candidates():
    text = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size="0.1"/></body>
    </worldbody><actuator><position name="goal" joint="j" kp="4"/>
    <velocity name="speed" joint="j" kv="1"/><motor name="motor" joint="j"/></actuator></mujoco>"""
    arm = MujocoSimulator(mujoco.MjModel.from_xml_string(text))
    assert [arm.port(name).kind for name in ("goal", "speed", "motor")] == [
        "servo",
        "servo",
        "action",
    ]
    names = {effect.name for effect in candidate_effects(arm)}
    assert {"goal.servo_gain", "speed.servo_gain", "motor.dead_zone"} < names
    assert not {"motor.servo_gain", "goal.dead_zone", "goal.actuator_gain"} & names
    assert {"goal.input_delay", "speed.input_delay", "goal,speed.input_delay"} < names
    assert "goal,speed,motor.input_delay" not in names


def test_laws_that_make_no_sense_at_a_port_are_refused():
    with pytest.raises(ModelError, match="unbalance makes no sense at the port 'rail'"):
        CartPole().with_effects(Unbalance("rail"))
    with pytest.raises(ModelError, match="tilt makes no sense at the port 'payload'"):
        CartPole().with_effects(Tilt("payload"))
    with pytest.raises(ModelError, match="at least one period"):
        Cogging("arm", order=0)


def test_units_follow_the_joint():
    assert Spring("rail").units(CartPole().port("rail")) == {"stiffness": "N/m", "rest": "m"}
    assert Spring("hinge").units(CartPole().port("hinge"))["stiffness"] == "N m/rad"


def test_other_packages_add_effects_by_an_entry_point(monkeypatch):
    home = "npdr_ppl.models.effects.forces"
    added = [
        EntryPoint("spring", "elsewhere:Spring", GROUP),
        EntryPoint("magnet", f"{home}:Bias", GROUP),
        EntryPoint("nothing", "elsewhere:Nothing", GROUP),
    ]
    monkeypatch.setattr(
        "npdr_ppl.registry.entry_points", lambda group: added if group == GROUP else []
    )
    assert effect_class("spring") is Spring
    with pytest.raises(ModelError, match="'magnet' .* whose id is 'bias'"):
        effect_class("magnet")
    monkeypatch.setattr(Bias, "id", "magnet")
    assert effect_class("magnet") is Bias
    with pytest.raises(ModelError, match="Effect 'nothing' cannot be loaded"):
        effect_class("nothing")
    with pytest.raises(ModelError, match="did you mean 'coulomb_friction'"):
        effect_class("coulomb_frction")


@pytest.mark.parametrize("name", ["candidates", "registry"])
def test_docstring_examples_run(name):
    found = doctest.testmod(import_module(f"npdr_ppl.models.effects.{name}"))
    assert found.attempted and not found.failed
