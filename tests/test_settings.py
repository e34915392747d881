"""Settings are checked when they are made."""

import dataclasses

import pytest

from npdr_ppl.discovery import settings as discovery_settings
from npdr_ppl.discovery.proof import settings as proof_settings
from npdr_ppl.discovery.screening import settings as screening_settings
from npdr_ppl.discovery.search import settings as search_settings
from npdr_ppl.planning import settings as planning_settings
from npdr_ppl.posterior import settings as posterior_settings
from npdr_ppl.preparation import sampling_settings
from npdr_ppl.preparation import settings as preparation_settings
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING
from npdr_ppl.preparation.settings import SEGMENT_FIT

STAGES = [
    getattr(module, name)
    for module in (
        preparation_settings,
        sampling_settings,
        discovery_settings,
        screening_settings,
        search_settings,
        proof_settings,
        posterior_settings,
        planning_settings,
    )  # fmt: skip
    for name in module.__all__
    if name.isupper()
]


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: type(stage).__name__)
def test_every_setting_is_validated(stage):
    for field in dataclasses.fields(stage):
        value = getattr(stage, field.name)
        wrong = (-99,) * len(value) if isinstance(value, tuple) else -99
        with pytest.raises(ValueError, match="must lie in"):
            dataclasses.replace(stage, **{field.name: wrong})


def test_tuples_are_checked_element_by_element():
    with pytest.raises(ValueError, match=r"SegmentFitSettings.restart_distances must lie in .*-3"):
        dataclasses.replace(SEGMENT_FIT, restart_distances=(1.0, -3.0))
    with pytest.raises(ValueError, match="tails must lie in"):
        dataclasses.replace(IMPORTANCE_SAMPLING, tails=((0.5, 1.0), (0.5, -2.0)))


def test_every_setting_is_documented():
    for stage in STAGES:
        for field in dataclasses.fields(stage):
            assert f"        {field.name}: " in type(stage).__doc__
