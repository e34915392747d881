"""`npdr fit` that continues in a folder that was edited: a result, or one sentence."""

import random
import shutil

import pytest
from fuzz_files import damage, edit_json

from tests.helpers.command_line import run_for_module
from tests.helpers.pendulum_recordings import swinging

BACKEND = "snpe-c(hidden=(8,), transforms=1, epochs=2, members=1)"


@pytest.mark.slow
def test_files_that_a_fit_reads_again_may_be_damaged(tmp_path):
    swinging(rollouts=2, steps=60).to_csv(tmp_path / "recording.csv")
    words = ["fit", "pendulum", "--data", tmp_path / "recording.csv", "--backend", BACKEND,
             "--rounds", 1, "--simulations", 60, "--quiet", "--out"]  # fmt: skip
    whole, copy = tmp_path / "whole", tmp_path / "copy"
    assert run_for_module(*words, whole)[0] == 0
    (whole / "fit.json").unlink()  # a finished fit is not continued
    rng = random.Random(0)
    for name in ("run.json", "round_0.json", "round_0.safetensors", "correction.safetensors"):
        file = whole / "run" / name
        shutil.copytree(whole, copy)
        data = file.read_bytes()
        edited = edit_json(rng, data) if file.suffix == ".json" else damage(rng, data)
        (copy / "run" / name).write_bytes(edited)
        code, _, errors = run_for_module(*words, copy)
        is_sentence = errors.startswith("npdr: ") and errors.count("\n") == 1
        assert code == 0 or (code == 2 and is_sentence), (name, errors)
        shutil.rmtree(copy)
