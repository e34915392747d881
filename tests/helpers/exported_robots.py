"""Robots, effects, and how far an exported file with its Python is from the fitted model."""

import dataclasses
import runpy

import mujoco
import numpy as np
import torch

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.inputs import Inputs
from tests.helpers.mujoco_files import GYMNASIUM, ROOT

CONTROL_STEP = 0.01
"""Seconds between commands; robots take several engine steps in between."""

ARM = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <geom name="floor" type="plane" pos="0 0 -5" size="5 5 0.1"/>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.2" frictionloss="{friction}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01" {spring}/>
        <geom name="palm" type="capsule" fromto="0 0 -0.05 0 0 -0.2" size="0.02"/>
        <site name="tip" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" gear="2" ctrlrange="-3 3"/>
    <position name="servo" joint="elbow" kp="4" kv="0.1" ctrlrange="-1 1"/>
  </actuator>
  <sensor><jointpos name="encoder" joint="elbow"/><gyro name="gyro" site="tip"/></sensor>
</mujoco>
"""

RAIL = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5" range="-2 2"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" gear="5" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def write_robots(folder):
    """Returns the paths of ten robots; those that Gymnasium ships only if it is installed."""
    variants = {
        "arm": ("Euler", 0.0, ""),
        "arm_rk4": ("RK4", 0.0, ""),
        "arm_implicit": ("implicitfast", 0.0, ""),
        "arm_with_friction_and_spring": ("Euler", 0.05, 'stiffness="0.3"'),
    }
    texts = {
        name: ARM.format(integrator=i, friction=f, spring=s)
        for name, (i, f, s) in variants.items()
    }
    texts["rail"] = RAIL
    texts["furuta"] = (ROOT / "models" / "furuta.xml").read_text()
    texts["two_link_arm"] = (ROOT / "models" / "two_link_arm.xml").read_text()
    if GYMNASIUM is not None:
        for name in ("hopper", "half_cheetah", "swimmer"):
            texts[name] = (GYMNASIUM / f"{name}.xml").read_text()
    paths = {}
    for name, text in texts.items():
        paths[name] = folder / f"{name}.xml"
        paths[name].write_text(text)
    return paths


def attachable(simulator, effect_class):
    """Returns an effect at the last port that it suits; ``None`` if there is none."""
    rates = [s.name for s in simulator.states if s.rate_of]
    pairs = [f"{s.rate_of},{s.name}" for s in simulator.states if s.rate_of]
    names = [p.name for p in simulator.ports]
    for name in [*reversed(pairs), *rates, *reversed(names), "clock"]:
        try:
            port = simulator.port(name)
            effect = effect_class(name)
            if port.kind not in effect.port_kinds or not effect.suits(port):
                continue
            simulator.with_effects(effect)
        except ModelError:
            continue
        if effect.id in ("encoder_bias", "encoder_scale") and "," in name:
            continue
        return effect
    return None


def probed(simulator, effect):
    """Returns values of an effect's parameters by site, as strong as is typical."""
    values = effect.probe(simulator.port(effect.port))
    changes = {"delay": 0.0137, "backward": 0.4 * values.get("backward", 0.0), "roll": 0.02}
    if effect.id == "tilt":
        values["pitch"] = -0.05
    values |= {name: number for name, number in changes.items() if name in values}
    return {f"{effect.name}.{name}": number for name, number in values.items()}


def commands_of(simulator, num_steps):
    """Returns commands that change often, ``(steps, actuators)``; the first one is zero."""
    time = CONTROL_STEP * np.arange(num_steps)
    columns = []
    for i, action in enumerate(simulator.actions):
        size = min(action.upper, 3.0)
        wave = 0.7 * np.sin((5.0 + i) * time) + 0.3 * np.sign(np.sin((11.0 - i) * time + 0.3))
        columns.append(size * np.where(time > 0.0, wave, 0.0))
    return np.stack(columns, axis=-1)


def refusals(simulator, values):
    """Returns why effects are not exported, by their names."""
    given = {n: torch.tensor(float(v), dtype=torch.float64) for n, v in values.items()}
    return export_mjcf(simulator, given, time_step=CONTROL_STEP).refused


def difference(simulator, values, folder, *, seconds=1.0, velocity=0.0, in_operation=False):
    """Returns how far the exported robot is from the model, how much the effects matter, and how.

    Args:
        simulator: The simulator with effects, at rest in the pose of its file.
        values: Values of their parameters.
        folder: Folder of the new files.
        seconds: Time to simulate.
        velocity: Velocity of every joint at the start.
        in_operation: Whether the first command was held before the start.
    """
    num_steps = round(seconds / CONTROL_STEP)
    given = {n: torch.tensor(float(v), dtype=torch.float64) for n, v in values.items()}
    commands = commands_of(simulator, num_steps)
    found = export_mjcf(simulator, given, time_step=CONTROL_STEP)
    assert not found.refused, found.refused
    path = folder / "identified.xml"
    path.write_text(found.text)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    runner = None
    if found.callbacks is not None:
        file = folder / "identified_effects.py"
        file.write_text(found.callbacks.text)
        runner = runpy.run_path(str(file))["Effects"](model)

    data.qvel[:] = velocity

    def place(component):
        return float((data.qvel if component.is_velocity else data.qpos)[component.address])

    first = {component.channel.name: place(component) for component in simulator.components}
    measured = {} if runner is None else runner.reset(data, commands[0] if in_operation else None)
    start = [measured.get(name, value) for name, value in first.items()]
    rows = []
    for command in commands:
        if runner is None:
            data.ctrl[:] = command
            mujoco.mj_step(model, data, simulator.num_substeps(CONTROL_STEP))
            rows.append([place(component) for component in simulator.components])
        else:
            measured = runner.step(data, command)
            rows.append([measured[sensor.name] for sensor in simulator.sensors])
    inputs = Inputs.single(
        torch.tensor(commands),
        torch.tensor(start, dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(state.name for state in simulator.states),
        time_step=CONTROL_STEP,
    )
    inputs = dataclasses.replace(inputs, began_in_operation=in_operation)
    wanted = simulator.simulate(given, inputs)[0].numpy()
    sensors = [sensor.name for sensor in simulator.sensors]
    plain = MujocoSimulator(simulator.file, sensors=sensors).simulate({}, inputs)[0].numpy()
    error = float(np.abs(np.array(rows) - wanted).max())
    return error, float(np.abs(wanted - plain).max()), "file" if runner is None else "Python"
