"""A point mass on a body, against a second body in the file that is welded to the first."""

import mujoco
import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco.isaac_lab import isaac_lab_file
from npdr_ppl.engines.mujoco.randomised import randomised_fields
from npdr_ppl.language.reference import quantile
from npdr_ppl.models.effects import OffsetPayload, Payload, candidate_effects
from tests.helpers.mujoco_files import random_inputs, value

ARM = """
<mujoco><option timestep="0.002" integrator="RK4"/><worldbody>
  <body name="upper"><joint name="a" axis="0 1 0"/>
    <inertial pos="0.15 0 0" mass="1.5" diaginertia="0.002 0.014 0.013"/>
    <body name="middle" pos="0.3 0 0" quat="0.8 0.1 0.3 -0.5"><joint name="b" axis="0 0 1"/>
      <inertial pos="0.05 0.02 0" mass="0.6" diaginertia="0.002 0.003 0.004"/>
      <body name="hand" pos="0.2 0 0"><joint name="c" axis="1 0 0"/>
        <inertial pos="0.04 0 0.02" mass="{mass}" quat="0.9 -0.2 0.1 0.4"
          diaginertia="{inertia} {inertia} {least}"/>{load}</body></body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>
"""

PLACE = 0.1, -0.03, 0.05


def arm(mass: float = 0.3, inertia: float = 0.001, load: str = "") -> npdr.MujocoSimulator:
    """Returns an arm of three links."""
    text = ARM.format(mass=mass, inertia=inertia, least=0.7 * inertia, load=load)
    return npdr.MujocoSimulator(mujoco.MjModel.from_xml_string(text))


@pytest.mark.parametrize("hand", [(0.3, 0.001), (0.02, 1e-4)])
def test_it_moves_as_a_body_that_is_welded_on(hand: tuple[float, float]) -> None:
    """Mass, centre and inertia follow the parallel axis theorem, also of a light hand."""
    at = np.array([0.04, 0.0, 0.02]) + PLACE
    place = " ".join(map(str, at))
    load = f'<body pos="{place}"><inertial pos="0 0 0" mass="0.4" diaginertia="0 0 0"/></body>'
    effect = OffsetPayload("payload")
    inputs = random_inputs(arm(*hand), num_steps=100)
    numbers = dict(zip(("mass", "x", "y", "z"), (0.4, *PLACE), strict=True))
    given = {f"{effect.name}.{name}": value(number) for name, number in numbers.items()}
    found = arm(*hand).with_effects(effect).simulate(given, inputs)
    expected = arm(*hand, load).simulate({}, inputs)
    assert (expected - arm(*hand).simulate({}, inputs)).abs().max() > 0.1
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-8)


def test_at_the_centre_it_is_a_payload() -> None:
    """The simpler law is contained."""
    inputs = random_inputs(arm(), num_steps=50)
    found, expected = (
        arm().with_effects(effect).simulate({f"{effect.name}.mass": value([0.0, 0.3])}, inputs)
        for effect in (OffsetPayload("payload"), Payload("payload"))
    )
    torch.testing.assert_close(found, expected, atol=1e-10, rtol=0.0)


def test_priors_scale_with_the_whole_arm() -> None:
    """Loads are heavier than last links: 20 % of all that moves, a tenth of its length away."""
    (effect,) = (e for e in candidate_effects(arm()) if e.id == "offset_payload")
    priors = effect.priors(arm().port("payload"))
    assert float(priors["mass"].scale) == pytest.approx(0.2 * 2.4)
    length = 0.3 + 0.2 + float(np.hypot(0.04, 0.02))
    assert float(quantile(priors["x"], torch.tensor(0.975))) == pytest.approx(
        1.96 * 0.1 * length, rel=1e-3
    )


def test_a_hand_without_a_mass_of_its_own_can_carry_one() -> None:
    """Its mass may be that of a body that is welded on."""
    text = ARM.format(mass=0.3, inertia=0.001, least=0.0007, load="")
    start, end = text.index('<inertial pos="0.04'), text.index("</body></body></body>")
    text = f"{text[:start]}<body>{text[start:end]}</body>{text[end:]}"
    bare = npdr.MujocoSimulator(mujoco.MjModel.from_xml_string(text))
    effect = OffsetPayload("payload")
    loaded = bare.with_effects(effect)
    inputs = random_inputs(bare, num_steps=20)
    assert torch.equal(loaded.simulate({}, inputs), bare.simulate({}, inputs))
    given = {f"{effect.name}.mass": value([0.0, 0.2]), f"{effect.name}.x": value(0.1)}
    assert loaded.simulate(given, inputs).isfinite().all()


def test_an_impossible_mass_costs_only_its_own_simulation() -> None:
    """The others are as they would be alone."""
    effect = OffsetPayload("payload")
    loaded = arm().with_effects(effect)
    inputs = random_inputs(loaded, num_steps=20)
    found, alone = (
        loaded.simulate({f"{effect.name}.mass": value(m), f"{effect.name}.x": value(0.1)}, inputs)
        for m in ([0.2, float("nan")], [0.2])
    )
    assert torch.equal(found[0], alone[0])


@pytest.mark.parametrize(
    ("joint", "least"), [("<freejoint/>", 0.2), ('<joint type="slide" axis="1 0 0"/>', 0.2)]
)
def test_a_load_can_be_anywhere_on_a_large_body(joint: str, least: float) -> None:
    """Its centre of mass is close to the origin."""
    text = f"""<mujoco><worldbody><body>{joint}
      <geom type="box" size="0.3 0.1 0.05" mass="8" pos="0.002 0 0"/>
      </body></worldbody></mujoco>"""
    port = npdr.MujocoSimulator(mujoco.MjModel.from_xml_string(text)).port("payload")
    assert port.rated == 8.0 and port.rated_position > least


def test_isaac_lab_is_said_to_lack_the_inertia_of_a_load() -> None:
    """It only scales inertia with the mass."""
    effect = OffsetPayload("payload")
    values = {"mass": [0.1, 0.2], "x": [0.1, 0.12]}
    draws = {f"{effect.name}.{name}": value(numbers) for name, numbers in values.items()}
    loaded = arm().with_effects(effect)
    found = randomised_fields(loaded, draws)
    text, refused = isaac_lab_file(loaded.model, found, module="events", robot="arm.xml")
    assert "randomize_rigid_body_com" in text
    assert list(refused) == ["inertia of hand"]
