"""Writes a run's parameters with intervals, correlations and draws as YAML or JSON."""

import json
from typing import Any

from npdr_ppl.posterior.run_draws import RunDraws

__all__ = ["range_file"]

FORMAT = "npdr-ranges-1"


def range_file(draws: RunDraws, *, as_json: bool) -> str:
    """Returns the text of a file of ranges.

    Args:
        draws: What the run knows of its parameters.
        as_json: Whether to write JSON instead of YAML.
    """
    names = list(draws.means)
    parameters = {
        name: {
            "unit": draws.units.get(name),
            "mean": draws.means[name],
            "sd": draws.sds[name],
            "interval_94": list(draws.intervals[name]),
        }
        for name in names
    }
    content: dict[str, Any] = {
        "format": FORMAT,
        "made_by": f"npdr {draws.source}",
        "parameters": parameters,
        "names": names,
        "correlations": [[round(float(c), 4) for c in row] for row in draws.correlations],
        "draws": draws.values.tolist(),
    }
    if as_json:
        return json.dumps(content, ensure_ascii=False, indent=1) + "\n"
    return _yaml(content)


_NOTES = {
    "parameters": "Posterior means, standard deviations and 94 % intervals, in these units.",
    "names": "The order of the parameters in the following tables.",
    "correlations": "Correlations of the draws.",
    "draws": "Draws of the posterior, one in a line. They keep the correlations.",
}


def _yaml(content: dict[str, Any]) -> str:
    """Returns YAML. Names and numbers are written as in JSON, which YAML includes."""
    lines = []
    for key, value in content.items():
        if key in _NOTES:
            lines.append(f"# {_NOTES[key]}")
        if isinstance(value, dict):
            lines.append(f"{key}:")
            for name, record in value.items():
                lines.append(f"  {_json(name)}:")
                lines += [f"    {k}: {_json(v)}" for k, v in record.items()]
        elif isinstance(value, list) and value and isinstance(value[0], list):
            lines += [f"{key}:", *(f"  - {_json(row)}" for row in value)]
        else:
            lines.append(f"{key}: {_json(value)}")
    return "\n".join(lines) + "\n"


def _json(value: Any) -> str:
    """Returns a value as JSON whose numbers are numbers in YAML 1.1, too: ``1.0e-05``."""
    if isinstance(value, list):
        return f"[{', '.join(map(_json, value))}]"
    text = json.dumps(value, ensure_ascii=False)
    if isinstance(value, float) and "." not in text:
        return text.replace("e", ".0e")
    return text
