"""Joint quantities that force effects need before a step."""

import mujoco
import mujoco.batch
import numpy as np
import pytest

from npdr_ppl.engines.mujoco.joints import JointStates
from tests.helpers.mujoco_files import arm


@pytest.fixture
def simulator():
    return arm()


def test_inverse_inertias_are_those_of_the_full_matrix(simulator):
    model, ports = simulator.model, simulator.force_ports
    batch = mujoco.batch.Batch(model, 5, 1)
    states = JointStates(batch, ports)
    rng = np.random.default_rng(0)
    batch.qpos[:] = rng.uniform(-1.0, 1.0, batch.qpos.shape)
    batch.forward()
    found = states.read((None,) * len(ports), (None,) * len(ports))
    for k in range(5):
        full = np.zeros((model.nv, model.nv))
        data = batch.get_data(k)
        mujoco.mj_forward(model, data)  # get_data has the state alone
        mujoco.mj_fullM(model, data, full)
        inverse = np.linalg.inv(full)
        for port, joint in zip(ports, found, strict=True):
            expected = inverse[port.velocity, port.velocity]
            assert float(joint.inverse_inertia[k]) == pytest.approx(expected, rel=1e-10)


def test_a_simulation_without_inertia_leaves_the_others_as_they_are(simulator):
    ports = simulator.force_ports
    batch = mujoco.batch.Batch(simulator.model, 2, 1)
    states = JointStates(batch, ports)
    batch.forward()
    none = (None,) * len(ports)
    alone = [joint.inverse_inertia[1] for joint in states.read(none, none)]
    states._inertia = states._inertia.copy()
    states._inertia[0] = 0.0
    beside = [joint.inverse_inertia for joint in states.read(none, none)]
    assert [b[1] for b in beside] == alone
    assert not any(b[0].isfinite() for b in beside)
