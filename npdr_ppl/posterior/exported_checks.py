"""Checks of an estimator and a model that do not use the posterior's own draws.

The checks travel with the exported posterior, as JSON in the attribute ``checks``, so that
:func:`npdr_ppl.diagnose` needs only the export::

    estimator   how the learnt posterior compares with the simulator, and whether it was corrected
    model       whether the recording shows anything that no parameters explain; without a p-value
                if it is too short for this test
    priors      sentences about priors that end before the recording's parameters
"""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from npdr_ppl.posterior.estimator_check import EstimatorCheck
    from npdr_ppl.posterior.prepare import Preparation

__all__ = ["ATTRIBUTE", "checks_of"]

ATTRIBUTE = "checks"
"""Name of the exported object's attribute."""


def checks_of(
    preparation: "Preparation | None", estimator: "EstimatorCheck | None"
) -> dict[str, Any]:
    """Returns the checks as JSON-serialisable values; empty if none were made.

    Args:
        preparation: The preparation of the recording.
        estimator: How the learnt posterior compares with the simulator.
    """
    result: dict[str, Any] = {}
    if estimator is not None:
        result["estimator"] = estimator.to_dict()
    if preparation is None or preparation.hypothesis is None:
        return result
    result["priors"] = [str(end) for end in preparation.ends]
    alarm = preparation.alarm
    result["model"] = {
        "p_value": None if alarm is None else alarm.p_value,
        "fired": alarm is not None and alarm.fired,
        "strongest": "" if alarm is None else alarm.strongest,
        "misfit": preparation.misfit if math.isfinite(preparation.misfit) else None,
    }
    return result
