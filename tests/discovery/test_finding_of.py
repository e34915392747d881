"""What a discovery says about an effect follows from the search's alternatives."""

from types import SimpleNamespace

import pytest

from npdr_ppl.discovery.finding_of import finding_of
from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.models.effects import ActuatorGain, SensorLowPass


def told(alternatives, share=0.3, *, effect=None, every=None, finer=None, **searched):
    effect = effect or ActuatorGain("left")
    added = Added(effect, effect.name, share, alternatives)
    simulator = SimpleNamespace(
        corrected_number=lambda effect: "", with_finer_steps=lambda: finer, time_step=0.005
    )
    final = SimpleNamespace(names=(effect.name,), model=simulator, simulator=simulator)
    other = Added(ActuatorGain("right"), "right.actuator_gain", 0.6, {})
    state = {"is_approximate": False, "has_stopped": False, "minor": frozenset()} | searched
    search = SimpleNamespace(missing=[added, other], final=final, **state)
    return finding_of(added, search, every or {}, (), None, [])


def test_the_same_law_elsewhere_is_told_by_its_whole_name():
    found = told(
        {
            "left.actuator_gain": 0.7,
            "right.actuator_gain": 0.17,
            "forward.viscous_friction": 0.1,
            "right.actuator_lag": 0.03,
        }
    )
    assert "right.actuator_gain" in found.equivalent_to
    assert "viscous_friction" in found.equivalent_to
    assert not {"actuator_gain", "actuator_lag", "right.actuator_lag"} & set(found.equivalent_to)


def test_a_small_effect_is_one_that_can_go_with_all_other_small_ones():
    """Each of a delay and a lag can go alone, because the other takes its place."""
    one = {"left.actuator_gain": 1.0}
    small = {"share": 0.02, "is_approximate": True}
    assert told(one, **small, minor=frozenset({"left.actuator_gain"})).is_minor
    assert not told(one, **small).is_minor


@pytest.mark.parametrize(
    ("milliseconds", "finer", "is_doubted"),
    [(1.0, None, True), (12.0, None, False), (1.0, "finer steps", False)],
)
def test_a_part_of_a_step_may_be_the_error_of_a_simulator_without_finer_ones(
    milliseconds, finer, is_doubted
):
    effect = SensorLowPass("angle")
    mean = 1e-3 * milliseconds
    every = {f"{effect.name}.time_constant": Estimate(mean, 1e-5, (0.9 * mean, 1.1 * mean), "s")}
    found = told({effect.name: 1.0}, effect=effect, every=every, finer=finer)
    assert found.may_be_step_error == is_doubted
    assert found.can_be_named != is_doubted
    assert ("simulator's own steps" in found.doubt) == is_doubted
