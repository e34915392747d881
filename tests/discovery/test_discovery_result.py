"""Results of discovery as JSON."""

import json
import math

import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.models.effects import QuadraticDrag
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import OverlayRecord


@pytest.mark.slow
def test_saving_writes_json_with_the_documented_names(tmp_path):
    case = make_case("pendulum", "null", (), seed=2001)
    options = npdr.DiscoveryOptions(effects=(QuadraticDrag("hinge"),))
    found = npdr.discover(case.model, case.fit, holdout=case.holdout, search=options)
    found.save(tmp_path)
    written = json.loads((tmp_path / "discovery.json").read_text())
    assert written["verdict"] == "none"
    assert {"alarm", "where", "effects", "ranking", "gap", "next_experiment"} <= set(written)
    assert {"before", "after", "noise_floor", "closed"} == set(written["gap"]["rmse"])
    assert {"rollout", "time_span", "channel", "region", "z"} == set(written["where"][0])
    overlays = read_json(tmp_path / "overlays.json", OverlayRecord)
    assert overlays["channels"] == ["angle", "velocity"] and overlays["is_held_out"]


def test_an_infinite_estimate_is_null_in_json():
    estimate = Estimate(math.inf, 1.0, (0.0, math.inf), "m")
    assert estimate.to_dict() == {"mean": None, "sd": 1.0, "hdi_94": [0.0, None], "unit": "m"}
