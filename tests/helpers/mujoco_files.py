"""MJCF files, inputs and bindings that the tests of MujocoSimulator share."""

import importlib.util
from pathlib import Path

import mujoco
import pytest
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.furuta import Furuta

ROOT = Path(__file__).parents[2]
FURUTA_XML = ROOT / "models" / "furuta.xml"


def shipped(package, folder):
    """Returns a folder of files that another installed package ships."""
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        return None
    path = Path(found.submodule_search_locations[0]) / folder
    return path if path.is_dir() else None


GYMNASIUM = shipped("gymnasium", "envs/mujoco/assets")
needs_gymnasium = pytest.mark.skipif(GYMNASIUM is None, reason="gymnasium is not installed")


ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="{integrator}" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.2" frictionloss="{friction}" {solver}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" contype="0" conaffinity="0"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01" stiffness="0.5"
               range="-2 2"/>
        <geom type="capsule" fromto="0 0 0 0.05 0 -0.2" size="0.02" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" gear="2" ctrlrange="-3 3"/>
    <position joint="elbow" kp="4" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <jointpos name="encoder" joint="shoulder"/>
    <gyro name="gyro" site="tip"/>
    <accelerometer name="imu" site="tip"/>
  </sensor>
  <keyframe><key name="raised" qpos="0.4 -0.3"/></keyframe>
</mujoco>
"""

ROLLING = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" condim="6"/>
    <body name="wheel" pos="0 0 0.049">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="turn" axis="0 1 0"/>
      <geom type="sphere" size="0.05" condim="6" friction="0.5 0.005 0.002"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="turn" ctrlrange="-0.1 0.1"/></actuator>
</mujoco>
"""

# The hardest dry friction that MuJoCo admits at its time step of 2 ms.
HARD = 'solreffriction="0.004 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"'


def arm(*, integrator="Euler", friction=0.0, solver="", **options):
    text = ARM.format(integrator=integrator, friction=friction, solver=solver)
    return MujocoSimulator(mujoco.MjModel.from_xml_string(text), **options)


def random_inputs(simulator, *, num_segments=3, num_steps=30, seed=0, past=6):
    """Segments about the file's pose; the second is shorter, the third a single step."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    scale = [min(action.upper, 10.0) for action in simulator.actions]
    states = 0.1 * draw(num_segments, len(simulator.states))
    for i, component in enumerate(simulator.components):
        if not component.is_velocity:
            states[:, i] += float(simulator.initial_positions[component.address])
    lengths = torch.tensor([num_steps, num_steps - 5, 1])[:num_segments, None]
    num_actions = len(simulator.actions)
    return Inputs(
        actions=torch.tensor(scale).double() * draw(num_segments, num_steps, num_actions),
        action_names=tuple(action.name for action in simulator.actions),
        initial_readings=states + 0.01 * draw(*states.shape),
        initial_values=states,
        initial_rates=None,
        channel_names=tuple(state.name for state in simulator.states),
        past_actions=draw(num_segments, past, num_actions),
        time_step=simulator.time_step,
        mask=torch.arange(num_steps) < lengths,
        rollout=torch.arange(num_segments),
        start=torch.tensor([0, num_steps, 0])[:num_segments],
    )


def value(number):
    return torch.tensor(number, dtype=torch.float64)


def furuta_in_mujoco(**options):
    """The Furuta pendulum's parameters, bound to its file."""
    info = {parameter.name: parameter for parameter in Furuta.parameters}

    def rod(mass, length):
        return lambda p: p[mass] * p[length] ** 2 / 12.0

    def gain(p):
        return p["motor_constant"] / p["motor_resistance"]

    return MujocoSimulator(
        FURUTA_XML,
        {
            "gravity": "option gravity",
            "motor_resistance": info["motor_resistance"],
            "motor_constant": info["motor_constant"],
            "arm_mass": "body arm mass",
            "arm_length": "body pole position x",
            "pole_mass": "body pole mass",
            "pole_length": info["pole_length"],
            "arm_damping": "joint arm damping",
            "pole_damping": "joint pole damping",
        },
        derived={
            "body arm inertia y": rod("arm_mass", "arm_length"),
            "body arm inertia z": rod("arm_mass", "arm_length"),
            "joint pole armature": rod("pole_mass", "pole_length"),
            # A point mass, as far as the engine admits one.
            "body pole inertia": lambda p: 1e-14 * torch.ones_like(p["pole_mass"]),
            "body pole centre z": lambda p: -0.5 * p["pole_length"],
            "actuator voltage gain": gain,
            "actuator voltage bias velocity": lambda p: -gain(p) * p["motor_constant"],
        },
        states={
            "arm_angle": "arm",
            "pole_angle": "pole",
            "arm_velocity": "arm_velocity",
            "pole_velocity": "pole_velocity",
        },
        units={"voltage": "V"},
        bounds={state.name: (state.lower, state.upper) for state in Furuta.states},
        time_step=Furuta.time_step,
        **options,
    )


def furuta_inputs(num_steps=250):
    time = 0.002 * torch.arange(num_steps, dtype=torch.float64)
    return Inputs.single(
        5.0 * torch.sin(9.0 * time)[:, None],
        torch.tensor([0.2, 1.3, -0.5, 2.0], dtype=torch.float64),
        action_names=("voltage",),
        state_names=tuple(state.name for state in Furuta.states),
        time_step=0.002,
        history=20,
    )


def furuta_domains(num_domains=4):
    generator = torch.Generator().manual_seed(3)
    factors = 1.0 + 0.2 * torch.randn(9, num_domains, generator=generator).double()
    return {p.name: p.nominal * f for p, f in zip(Furuta.parameters, factors, strict=True)}


def no_strength(effect, shape=()):
    return {
        site: torch.full(shape, parameter.nominal, dtype=torch.float64)
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
    }
