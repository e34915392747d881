"""Forces with a memory get the motion of their joint before a segment."""

from dataclasses import replace

import pytest
import torch
from hidden_rigs import make_case
from hidden_rigs.rigs import RIGS
from pyro.distributions import Normal

from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.effects import ForceEffect


class Witness(ForceEffect):
    """An effect without a force, which keeps the past motion that it gets."""

    id = "witness"
    needs_past = True
    needs_joint = True
    parameters = (Parameter("nothing", "1", 0.0, "not used"),)

    def default_priors(self, port):
        return {"nothing": Normal(0.0, 1.0)}

    def initial_memory(self, position, velocity, start):
        self.start, self.others = start, None

    def begin_step(self, joint, parameters, memory, time_step):
        self.others = self.others or joint.others
        return memory


@pytest.mark.parametrize("rig", ["furuta", "furuta_mujoco"])
def test_displacements_are_those_of_the_recorded_positions(rig):
    rollouts = make_case("furuta", "null", seed=3).fit
    inputs = rollouts.inputs(100)
    witness = Witness("pole")
    simulator = RIGS[rig].simulator().with_effects(witness)
    simulator.simulate({"pole.witness.nothing": torch.zeros(3)}, inputs)
    start, column = witness.start, inputs.channel_names.index("pole_angle")
    moved = torch.stack(start.displacements, dim=-1).reshape(3, inputs.num_segments, -1)
    assert torch.equal(moved[0], moved[2])
    stride = round(start.interval / inputs.time_step)
    for segment in (1, 7, inputs.num_segments - 1):
        readings = rollouts.readings[int(inputs.rollout[segment])][:, column]
        first = int(inputs.start[segment])
        for back in (1, 3):
            expected = readings[first] - readings[max(0, first - back * stride)]
            assert float(moved[0, segment, -back:].sum()) == pytest.approx(expected, abs=1e-9)
    assert not moved[0, 0].any()  # nothing is known before a rollout begins
    assert set(witness.others) == {"arm"}


@pytest.mark.parametrize("rig", ["furuta", "furuta_mujoco"])
def test_the_past_of_a_segment_is_the_same_among_other_segments(rig):
    inputs = make_case("furuta", "null", seed=3).fit.inputs(100)
    witness = Witness("pole")
    simulator = RIGS[rig].simulator().with_effects(witness)
    given = {"pole.witness.nothing": torch.zeros(())}
    simulator.simulate(given, inputs)
    every = witness.start
    some = inputs.segments([5, 2])
    assert int(some.start.max()) < int(inputs.start.max())
    simulator.simulate(given, some)
    assert witness.start.interval == every.interval
    for own, among in zip(
        reversed(witness.start.displacements), reversed(every.displacements), strict=False
    ):
        assert torch.equal(own, among[[5, 2]])
    num = len(witness.start.displacements)
    assert not any(bool(moved[[5, 2]].any()) for moved in every.displacements[:-num])


def test_nothing_is_told_where_no_recording_is():
    inputs = make_case("furuta", "null", seed=3).fit.inputs(100)
    witness = Witness("pole")
    simulator = RIGS["furuta"].simulator().with_effects(witness)
    simulator.simulate(
        {"pole.witness.nothing": torch.zeros(1)}, replace(inputs, recorded_readings=None)
    )
    assert witness.start.displacements == ()
