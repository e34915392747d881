"""Generic laws detect sensor errors and resonances that no catalogue needs to hold."""

import math

import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.generic_laws import reading_laws, ringing_laws
from npdr_ppl.discovery.screening.permutation_tests import LargestStatistic
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import ALARM
from npdr_ppl.discovery.segment_options import segment_options


def test_a_sensor_error_that_depends_on_the_measurement_is_detected(quiet):
    projection = Projection(quiet)
    laws = reading_laws(projection)
    groups = [law.change for law in laws]
    assert min(LargestStatistic(projection, seed=0).p_values(groups)) > 0.01
    names = [law.name for law in laws]
    own = projection.projected(groups[names.index("angle: error of sin 2 angle")])[..., 0]
    projection.residual = projection.residual + 10.0 * own / own.norm()
    values = LargestStatistic(projection, seed=0).p_values(groups)
    assert names[values.index(min(values))].startswith("angle: error of ")
    assert min(values) < 0.01


@pytest.mark.slow
def test_a_resonance_is_detected_at_its_frequency(quiet):
    hidden = make_case(
        "pendulum", "one", (("hinge", "joint_elasticity"),), strength=1.0, seed=2001
    )
    data_options = segment_options(hidden.fit)
    ringing = Projection(fit_hypothesis(hidden.model, hidden.fit, data_options))

    def heard(projection):
        laws = ringing_laws(projection)
        values = LargestStatistic(projection, seed=0).p_values([law.change for law in laws])
        gains = [projection.scores(law.change).gain(slice(None)) for law in laws]
        return min(values), laws[gains.index(max(gains))].name

    from_which_on = ALARM.ringing_share * npdr.DiscoveryOptions().false_alarm_rate
    assert heard(Projection(quiet))[0] > from_which_on
    p_value, strongest = heard(ringing)
    assert p_value <= from_which_on
    (true,) = hidden.truth
    frequency = 1.0 / (2.0 * math.pi * true.parameters["time_constant"])
    found = float(strongest.removeprefix("angle: ringing at ").removesuffix(" Hz"))
    # The next frequency that is tried is a ninth away.
    assert found == pytest.approx(frequency, rel=0.15)
