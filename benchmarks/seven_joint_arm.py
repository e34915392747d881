"""An arm of seven hinges with torque motors, as a MJCF file of one's own; recorded in PyBullet.

The arm hangs from a ceiling, and its hinges turn about the vertical and about the horizontal in
turn. :func:`write_arm` writes what a user has: ``arm.xml`` and ``arm_model.py``.
:func:`write_recording` writes a recording of the same arm, simulated by PyBullet from a URDF file
in finer steps, with noise. So the recording is not made by the engine that is fitted to it.
"""

import math
import tempfile
from pathlib import Path

import numpy as np

import npdr_ppl as npdr

__all__ = ["write_arm", "write_recording"]

NUM_JOINTS = 7

JOINTS = tuple(f"joint_{i}" for i in range(1, NUM_JOINTS + 1))

LENGTHS = 0.2, 0.25, 0.2, 0.25, 0.2, 0.15, 0.1
"""Distances between a link's hinge and the next one, m."""

MASSES = 3.0, 3.0, 2.5, 2.5, 1.5, 1.5, 0.5
"""Nominal masses of the links, kg."""

TRUE_MASSES = 3.0, 3.0, 2.5, 2.5, 1.5, 1.5, 0.8
"""Masses of the links in the recording, kg; the hand is heavier than nominal."""

TRUE_DAMPING = 1.2, 1.0, 0.9, 1.1, 0.5, 0.4, 0.3
"""Damping of the hinges in the recording, N m s/rad."""

TORQUES = 2.0, 6.0, 1.5, 3.0, 0.6, 1.0, 0.3
"""Amplitudes of each of the three sines of a motor's torque, N m."""

LIMITS = 10.0, 20.0, 10.0, 10.0, 5.0, 5.0, 2.0
"""Greatest torques of the motors, N m."""

RADIUS = 0.04
"""Radius from which the links' inertias follow, m: that of solid cylinders."""

ARMATURE = 0.02
"""Moment of inertia about its own axis, kg m², that each link has in addition. A real arm has that
of its motors."""

NOISE = 1e-3, 1e-2
"""Standard deviations of the recording's angles, rad, and velocities, rad/s."""

TIME_STEP = 1e-3
"""Seconds."""

SUBSTEPS = 4, 8
"""Steps of PyBullet per step of the recording, extrapolated to steps of length zero. The error of
its integrator is of first order: 1.4e-4 rad after 0.2 s with 8 steps, a seventh of the noise.
100 000 measurements would show that."""

MODEL = '''"""The arm of arm.xml; the hand's mass and the damping of the hinges are unknown."""

from pathlib import Path

import npdr_ppl as npdr
import pyro
import pyro.distributions as dist

JOINTS = [f"joint_{i}" for i in range(1, 8)]

arm = npdr.MujocoSimulator(
    Path(__file__).with_name("arm.xml"),
    {"hand_mass": "body link_7 mass"} | {f"damping_{j}": f"joint {j} damping" for j in JOINTS},
)


def model(inputs):
    parameters = {"hand_mass": pyro.sample("hand_mass", dist.Uniform(0.2, 1.5))}  # kg
    for joint in JOINTS:  # N m s/rad
        name = f"damping_{joint}"
        parameters[name] = pyro.sample(name, dist.Uniform(0.0, 2.0))
    return npdr.simulate("trajectory", arm, parameters, inputs)
'''
"""The user's program."""


def write_arm(folder: Path) -> str:
    """Writes ``arm.xml`` and ``arm_model.py`` to a folder; returns the model's name for ``npdr``.

    Args:
        folder: The folder.
    """
    (folder / "arm.xml").write_text(_mjcf())
    (folder / "arm_model.py").write_text(MODEL)
    return f"{folder / 'arm_model.py'}:model"


def write_recording(path: Path, seconds: float, *, has_velocities: bool = True) -> None:
    """Writes two rollouts, the second a tenth as long, to be held out; readings in rad and rad/s.

    Args:
        path: File of the recording.
        seconds: Duration of the first.
        has_velocities: Whether the velocities are recorded, as well as the positions.
    """
    rng = np.random.default_rng(0)
    readings, actions = [], []
    for duration in (seconds, 0.1 * seconds):
        torque = _torques(rng, round(duration / TIME_STEP))
        coarse, fine = (_simulated(torque, substeps) for substeps in SUBSTEPS)
        state = fine + (fine - coarse) / (SUBSTEPS[1] / SUBSTEPS[0] - 1.0)
        state += rng.standard_normal(state.shape) * np.repeat(NOISE, NUM_JOINTS)
        readings.append(state if has_velocities else state[:, :NUM_JOINTS])
        actions.append(torque)
    names = [*JOINTS, *(f"{joint}_velocity" for joint in JOINTS)]
    npdr.Rollouts.from_arrays(
        readings=readings,
        actions=actions,
        channel_names=names if has_velocities else names[:NUM_JOINTS],
        action_names=[f"motor_{joint}" for joint in JOINTS],
        time_step=TIME_STEP,
    ).to_npz(path)


def _torques(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Returns sums of three sines of 0.2 to 1.5 Hz, ``(steps, 7)``, in N m."""
    frequency = rng.uniform(0.2, 1.5, (3, NUM_JOINTS))
    phase = rng.uniform(0.0, 2.0 * math.pi, (3, NUM_JOINTS))
    times = TIME_STEP * np.arange(steps)[:, None, None]
    return np.array(TORQUES) * np.sin(2.0 * math.pi * frequency * times + phase).sum(1)


def _simulated(torque: np.ndarray, substeps: int) -> np.ndarray:
    """Returns positions and velocities in PyBullet under torques, ``(steps + 1, 14)``."""
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(pybullet.DIRECT)
    client.setGravity(0.0, 0.0, -9.81)
    client.setTimeStep(TIME_STEP / substeps)
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "arm.urdf"
        urdf.write_text(_urdf())
        arm = client.loadURDF(
            str(urdf), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
        )
    links = list(range(NUM_JOINTS))
    for link in (-1, *links):
        client.changeDynamics(arm, link, linearDamping=0.0, angularDamping=0.0)
    # PyBullet's joints have motors that hold them unless their force is set to 0.
    client.setJointMotorControlArray(
        arm, links, pybullet.VELOCITY_CONTROL, forces=[0.0] * NUM_JOINTS
    )

    def state() -> np.ndarray:
        joints = client.getJointStates(arm, links)
        return np.array([j[0] for j in joints] + [j[1] for j in joints])

    states = [state()]
    for now in torque.tolist():
        for _ in range(substeps):
            client.setJointMotorControlArray(arm, links, pybullet.TORQUE_CONTROL, forces=now)
            client.stepSimulation()
        states.append(state())
    client.disconnect()
    return np.array(states)


def _inertia(link: int, mass: float) -> tuple[float, float, float]:
    """Returns a link's moments of inertia about its centre of mass, kg m²."""
    across = mass * (LENGTHS[link] ** 2 / 12.0 + RADIUS**2 / 4.0) + ARMATURE
    return across, across, mass * RADIUS**2 / 2.0 + ARMATURE


def _axis(link: int) -> str:
    return "0 1 0" if link % 2 else "0 0 1"


def _mjcf() -> str:
    """Returns the arm with nominal masses."""
    bodies, ends = "", ""
    for link, mass in enumerate(MASSES):
        place = f"0 0 {-LENGTHS[link - 1]}" if link else "0 0 2"
        moments = " ".join(f"{moment:.9g}" for moment in _inertia(link, mass))
        bodies += (
            f'<body name="link_{link + 1}" pos="{place}">\n'
            f'<joint name="{JOINTS[link]}" type="hinge" axis="{_axis(link)}" damping="1"/>\n'
            f'<inertial pos="0 0 {-LENGTHS[link] / 2}" mass="{mass}" diaginertia="{moments}"/>\n'
        )
        ends += "</body>\n"
    motors = "".join(
        f'<motor name="motor_{joint}" joint="{joint}" ctrllimited="true" '
        f'ctrlrange="{-limit} {limit}"/>\n'
        for joint, limit in zip(JOINTS, LIMITS, strict=True)
    )
    return (
        f'<mujoco model="arm">\n<option timestep="{TIME_STEP}"/>\n<worldbody>\n{bodies}{ends}'
        f"</worldbody>\n<actuator>\n{motors}</actuator>\n</mujoco>\n"
    )


def _urdf() -> str:
    """Returns the arm with the masses and the damping of the recording."""
    parts = [
        '<link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    ]
    for link, mass in enumerate(TRUE_MASSES):
        place = f"0 0 {-LENGTHS[link - 1]}" if link else "0 0 2"
        # A mass that differs from its nominal value scales the inertia, as in MuJoCo's model.
        scale = mass / MASSES[link]
        x, y, z = (scale * moment for moment in _inertia(link, MASSES[link]))
        parts.append(
            f'<link name="link_{link + 1}"><inertial>'
            f'<origin xyz="0 0 {-LENGTHS[link] / 2}"/><mass value="{mass}"/>'
            f'<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{JOINTS[link]}" type="continuous">'
            f'<parent link="{f"link_{link}" if link else "base"}"/>'
            f'<child link="link_{link + 1}"/><origin xyz="{place}"/>'
            f'<axis xyz="{_axis(link)}"/><dynamics damping="{TRUE_DAMPING[link]}" friction="0"/>'
            "</joint>"
        )
    return f'<robot name="arm">{"".join(parts)}</robot>'
