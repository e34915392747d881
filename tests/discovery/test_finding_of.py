"""What a discovery says about an effect follows from the search's alternatives."""

from types import SimpleNamespace

from npdr_ppl.discovery.finding_of import finding_of
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.models.effects import ActuatorGain


def told(alternatives):
    effect = ActuatorGain("left")
    added = Added(effect, effect.name, 0.3, alternatives)
    final = SimpleNamespace(
        names=(effect.name,), simulator=SimpleNamespace(corrected_number=lambda effect: "")
    )
    search = SimpleNamespace(missing=[added], is_approximate=False, final=final)
    return finding_of(added, search, {}, (), None, [])


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
