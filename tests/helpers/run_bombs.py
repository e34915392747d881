"""Run folders that look like a small run and cost much to report on; each writes one folder."""

import json
import struct

from tests.helpers.tree_bombs import (
    nc_of_chunks_that_are_not_stored,
    nc_of_groups_in_each_other,
    nc_of_text_that_many_share,
)

INTERVAL = {"mean": 1.0, "sd": 0.1, "hdi_94": [0.8, 1.2]}
FIT = {"backend": "abc", "parameters": {"mass": INTERVAL}, "diagnosis": {}}


def _folder(path, name="fit", content=FIT):
    path.mkdir()
    text = content if isinstance(content, str) else json.dumps(content)
    (path / f"{name}.json").write_text(text)


def _sparse(path, size=8 * 2**30):
    with path.open("wb") as file:
        file.truncate(size)


def run_of_nested_json(path):
    _folder(path, content='{"backend": ' + "[" * 5_000_000)


def run_of_nested_records(path):
    _folder(path, content='{"a":' * 190 + "[1]" + "}" * 190)


def run_of_many_lists(path):
    _folder(path, content='{"backend": "a", "parameters": {}, "x": [' + "[]," * 2_300_000 + "[]]}")


def run_of_many_parameters(path):
    _folder(path, content=FIT | {"parameters": {f"m{k}": INTERVAL for k in range(80_000)}})


def run_of_almost_too_many_parameters(path):
    _folder(path, content=FIT | {"parameters": {f"m{k}": INTERVAL for k in range(15_000)}})


def run_of_almost_too_many_iterations(path):
    decision = {"decision": "accept", "reason": "", "action": "trained"}
    iteration = {"real_return": 1, "decisions": [decision], "internal_model": {}, "parameters": {}}
    _folder(path, "train", {"iterations": [iteration] * 11_000})


def run_of_a_long_number(path):
    _folder(path, content='{"backend": "a", "parameters": {}, "x": ' + "9" * 7_000_000 + "}")


def run_of_a_long_vector(path):
    interval = {"mean": [0.0] * 300_000, "sd": [0.0] * 300_000, "hdi_94": [[0, 1]] * 300_000}
    _folder(path, content=FIT | {"parameters": {"mass": interval}})


def run_of_many_iterations(path):
    decision = {"decision": "accept", "reason": "", "action": "trained"}
    iteration = {"real_return": 1, "decisions": [decision], "internal_model": {}, "parameters": {}}
    _folder(path, "train", {"iterations": [iteration] * 50_000})


def run_of_a_large_posterior(path):
    _folder(path)
    nc_of_chunks_that_are_not_stored(path / "posterior.nc")


def run_of_a_posterior_with_shared_text(path):
    _folder(path)
    nc_of_text_that_many_share(path / "posterior.nc")


def run_of_a_posterior_in_a_circle(path):
    _folder(path)
    nc_of_groups_in_each_other(path / "posterior.nc")


def run_of_a_large_recording(path):
    _folder(path)
    (path / "run").mkdir()
    _sparse(path / "run" / "data_trajectory.nc")


def run_of_a_large_picture(path):
    _folder(path, "discovery", {"verdict": "none"})
    _sparse(path / "where.png")


def run_of_a_large_source(path):
    _folder(path, "discovery", {"verdict": "named", "model": {"source": "a\nb\n" * 10_000}})
    (path / "revised_model.py").write_text("b\na\n" * 10_000)


def run_of_many_recordings(path):
    _folder(path)
    for index in range(20_000):
        (path / f"data_{index}").write_bytes(struct.pack("<I", index))


BOMBS = {"run": {name: make for name, make in globals().items() if name.startswith("run_of")}}
