"""Equations of motion with a mistake in them: one sentence says how to mend it."""

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import ModelError


class Cart(npdr.ODESimulator):
    """A cart on a rail, pushed by a force."""

    states = sensors = (npdr.Channel("x", "m"), npdr.Channel("v", "m/s", rate_of="x"))
    actions = (npdr.Channel("push", "N"),)
    parameters = (npdr.Parameter("mass", "kg", 2.0),)
    joints = ("rail",)
    ports = (npdr.Port("rail", "force", "N", coordinate="m"),)
    time_step = 0.01

    def accelerations(self, positions, velocities, actions, forces, constants):
        return ((actions[0] + forces[0]) / constants["mass"],)


def changed(**attributes):
    return type("Cart", (Cart,), attributes)


def simulated(simulator):
    inputs = npdr.Inputs.single(
        torch.ones(3, 1, dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
        action_names=("push",),
        state_names=("x", "v"),
        time_step=0.01,
    )
    return simulator.simulate({"mass": torch.tensor(2.0)}, inputs)


@pytest.mark.parametrize(
    ("attributes", "sentence"),
    [
        ({"joints": ()}, "Cart declares no joints; name its force ports"),
        ({"joints": ("x",)}, "The joint 'x' of Cart is not among its ports of kind force; those"),
        ({"ports": ()}, "The joint 'rail' of Cart is not .*; it has none. Declare npdr.Port"),
        ({"states": Cart.states[::-1]}, "its states are 1 positions and then .*; got v, x"),
        ({"states": Cart.states[:1]}, "its states are 1 positions and then .*; got x"),
    ],
)
def test_a_declaration_that_does_not_fit_is_refused(attributes, sentence):
    with pytest.raises(ModelError, match=sentence):
        changed(**attributes)()


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (lambda *a: (a[3][0] / a[5]["weight"],), "asks for the constant 'weight'; it has mass"),
        (lambda *a: (a[3][0] / a[5]["mass"],), r"ignores the force at rail; add forces\[0\]"),
        (lambda *a: (a[4][0], a[4][0]), "returns 2 accelerations for 1 joints"),
    ],
)
def test_accelerations_are_tried_out_before_the_first_simulation(law, sentence):
    simulator = changed(accelerations=law)()
    with pytest.raises(ModelError, match=sentence):
        simulated(simulator)


def test_other_faults_of_accelerations_are_seen_in_the_simulation():
    with pytest.raises(KeyError, match="gain"):
        simulated(changed(accelerations=lambda *a: ({}["gain"],))())


def test_a_correct_system_is_simulated():
    assert float(simulated(Cart())[0, -1, 1]) == pytest.approx(0.015)
