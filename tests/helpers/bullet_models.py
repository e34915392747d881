"""Scenes for the tests of BulletSimulator; in a module of their own, because workers import it."""

import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_ppl.engines.bullet import BulletSettings, BulletSimulator, Command, Sensor
from npdr_ppl.language.channels import Channel, Parameter

ROD = """<?xml version="1.0"?>
<robot name="pendulum">
  <link name="base"/>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/>
      <mass value="1.0"/>
      <inertia ixx="{moment}" iyy="{moment}" izz="1e-6" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/>
    <child link="rod"/>
    <axis xyz="0 -1 0"/>
    <limit effort="4.5" velocity="5"/>
    <dynamics damping="{damping}" friction="0"/>
  </joint>
</robot>
"""

SENSORS = (
    Sensor(Channel("angle", "rad"), "joint hinge position"),
    Sensor(Channel("velocity", "rad/s", rate_of="angle"), "joint hinge velocity", rated=5.0),
)
TORQUE = Command(Channel("torque", "N m", -4.5, 4.5), "joint hinge torque", rated=4.5)


def pendulum_urdf(folder):
    """A uniform rod of 1 kg and 1 m, angle 0 hanging, as in the zoo."""
    file = folder / "pendulum.urdf"
    file.write_text(ROD.format(moment=1 / 12, damping=0.02))
    return file


def bullet_pendulum(file, substeps=1, **changed):
    options = {
        "parameters": {
            "mass": "link rod mass",
            "damping": "joint hinge damping",
            "gravity_strength": "world gravity",
        },
        "actions": (TORQUE,),
        "sensors": SENSORS,
        "settings": BulletSettings(time_step=0.02, substeps=substeps),
    }
    return BulletSimulator(file, **{**options, **changed})


def drop(client, parameters):
    """A ball above a plate, as code; the ball's radius is the builder's business."""
    ground = client.createCollisionShape(client.GEOM_BOX, halfExtents=[1.0, 1.0, 0.05])
    ball = client.createCollisionShape(client.GEOM_SPHERE, radius=parameters["radius"])
    return {
        "plate": client.createMultiBody(0.0, ground, basePosition=[0.0, 0.0, -0.05]),
        "ball": client.createMultiBody(0.1, ball, basePosition=[0.0, 0.0, 0.5]),
    }


class Drop(BulletSimulator):
    """A ball that falls on a plate."""

    def __init__(self, states=("z",)):
        super().__init__(
            drop,
            parameters={
                "radius": Parameter("radius", "m", 0.05),
                "restitution": "body ball restitution",
                "plate_restitution": "body plate restitution",
                "shift": "body ball x_offset",
            },
            sensors=(
                Sensor(Channel("z", "m"), "body ball z"),
                Sensor(Channel("vz", "m/s", rate_of="z"), "body ball vz"),
                Sensor(Channel("x", "m"), "body ball x"),
            ),
            states=states,
            settings=BulletSettings(
                time_step=0.01, substeps=4, contact_breaking_threshold=1e-5, contact_erp=0.0
            ),
        )


class PendulumModel:
    """A Pyro model of the rod's mass and the hinge's damping."""

    def __init__(self, file):
        self.simulator = bullet_pendulum(file)

    def __call__(self, inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))  # kg
        damping = pyro.sample("damping", dist.Uniform(0.0, 0.4))  # N m s/rad
        parameters = {"mass": mass, "damping": damping}
        return npdr.simulate("trajectory", self.simulator, parameters, inputs)
