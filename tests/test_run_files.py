"""Folders of results: one process at a time, and nothing lost if the disk is full."""

import os
import resource
import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest
import safetensors.torch
import torch

from npdr_ppl.arviz_module import from_dict, from_netcdf, to_netcdf
from npdr_ppl.atomic_files import remove_unfinished, replacing
from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import (
    claimed,
    holds_this_run,
    load_tensors,
    read_json,
    save_tensors,
    write_json,
)
from npdr_ppl.run_records import FitRecord

HOLD = """
import sys
from pathlib import Path
from npdr_ppl.run_files import claimed

with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other_process(tmp_path):
    """A process that has claimed the folder ``run`` until it is killed."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "run")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout.readline() == "claimed\n"
        yield process
        process.kill()


def test_a_folder_in_use_is_refused_with_the_other_process_named(tmp_path, other_process):
    with (
        pytest.raises(DataError, match=f"in use by process {other_process.pid};"),
        claimed(tmp_path / "run"),
    ):
        pass


def test_a_killed_process_gives_its_folder_back(tmp_path, other_process):
    other_process.kill()
    other_process.wait()
    with claimed(tmp_path / "run"):
        pass


def test_a_process_may_claim_a_folder_twice(tmp_path):
    with claimed(tmp_path), claimed(tmp_path), claimed(None):
        pass
    with claimed(tmp_path):
        pass


def test_temporary_files_of_a_killed_process_are_removed(tmp_path):
    (tmp_path / "run").mkdir()
    leftovers = [tmp_path / ".fit.json.a8_d2x1z.tmp", tmp_path / "run" / ".z.nc.abcdefgh.tmp"]
    others = [tmp_path / "fit.json", tmp_path / ".notes.tmp", tmp_path / "run" / "a.abcdefgh.tmp"]
    for file in leftovers + others:
        file.touch()
    with claimed(tmp_path):
        assert not any(file.exists() for file in leftovers)
        assert all(file.exists() for file in others)


def test_leftovers_are_those_of_our_own_temporary_files(tmp_path):
    with suppress(KeyboardInterrupt), replacing(tmp_path / "fit.json") as temporary:
        name = temporary.name
        raise KeyboardInterrupt
    (tmp_path / name).touch()  # as if nobody had been there to remove it
    remove_unfinished(tmp_path)
    assert os.listdir(tmp_path) == []


def test_an_error_names_the_file_that_was_to_be_written(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write_json(tmp_path / "deleted" / "fit.json", {})
    assert caught.value.filename == str(tmp_path / "deleted" / "fit.json")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"backend": 1, "parameters": {}}', "Expected str, got int"),
        ('{"parameters": {}}', "missing required field backend"),
        ('{"backend": "a", "parameters": {"m": {"mean": "x", "sd": 1, "hdi_94": []}}}', "got str"),
        ('{"backend": "\\u001b[2J", "parameters": {}}', "control characters"),
        ('{"backend": "a", "parameters": {}, "x": 9223372036854775809999}', "too large"),
        ('{"x": ' + "[" * 300 + "]" * 300 + "}", "more than 200 deep"),
        ('{"x": ' + "[" * 99_999 + "]" * 99_999 + "}", "too deeply nested"),
        ("[]", "Expected object, got array"),
        ('{"backend": "a"', "truncated"),
        ("", "truncated"),
    ],
)
def test_json_of_another_type_gets_one_sentence(text, sentence, tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(text)
    with pytest.raises(DataError, match=sentence) as caught:
        read_json(path, FitRecord)
    assert str(caught.value).isprintable() and str(caught.value).endswith(".")


def test_keys_for_other_programs_are_kept(tmp_path):
    content = {"backend": "a", "parameters": {}, "mine": [1]}
    write_json(tmp_path / "fit.json", content)
    assert read_json(tmp_path / "fit.json", FitRecord) == content


def test_tensors_that_were_changed_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"a": torch.arange(6.0), "b": torch.zeros(0), "c": torch.tensor(True)})
    assert set(load_tensors(path, "a", "b")) == {"a", "b", "c"}
    whole = path.read_bytes()
    path.write_bytes(whole[:-2] + b"\x01" + whole[-1:])
    with pytest.raises(DataError, match="was changed"):
        load_tensors(path)
    path.write_bytes(whole)
    with pytest.raises(DataError, match="lacks d"):
        load_tensors(path, "d")
    safetensors.torch.save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(DataError, match="was changed"):
        load_tensors(path)


def write_rollouts(path, size):
    angle = np.random.default_rng(0).normal(size=(size, 1))
    rollouts = Rollouts.from_arrays(
        readings=[angle], actions=[angle[1:]], channel_names=("angle",),
        action_names=("torque",), time_step=0.1,
    )  # fmt: skip
    rollouts.to_netcdf(path)


def write_posterior(path, size):
    to_netcdf(
        from_dict({"posterior": {"mass": np.random.default_rng(0).normal(size=(1, size))}}), path
    )


WRITERS = {
    "run.json": (lambda path, size: write_json(path, {"a": ["x"] * size}), read_json),
    "state.safetensors": (lambda p, size: save_tensors(p, {"a": torch.rand(size)}), load_tensors),
    "data.nc": (write_rollouts, Rollouts.from_netcdf),
    "posterior.nc": (write_posterior, from_netcdf),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_says_which_it_is(tmp_path, name):
    write, read = WRITERS[name]
    path = tmp_path / name
    write(path, 20)
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    generator = np.random.default_rng(0)
    for size in (0, *generator.integers(1, 30_000, 24).tolist()):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            with pytest.raises(OSError) as caught:
                write(path, 20_000)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert caught.value.filename == str(path)
        assert path.read_bytes() == before
        assert os.listdir(tmp_path) == [name]
    read(path)


def test_names_in_an_edited_description_are_printable(tmp_path):
    description = {"options": {"length": 1}}
    write_json(tmp_path / "run.json", {"options": {"length": 1, "\u202eb" + 60 * "c": 2}})
    (tmp_path / "result.json").touch()
    with pytest.raises(DataError, match=r"differs in .\\u202ebc+…;") as raised:
        holds_this_run(tmp_path / "run.json", description)
    assert str(raised.value).isprintable()


def test_computed_values_may_differ_by_rounding(tmp_path):
    write_json(tmp_path / "run.json", {"features": [0.25, -3.0], "length": 0.25})
    (tmp_path / "result.json").touch()
    file = tmp_path / "run.json"
    assert holds_this_run(file, {"features": [0.25 + 1e-9, -3.0 - 1e-6], "length": 0.25})
    for other in ({"features": [0.26, -3.0]}, {"features": [0.25]}, {"length": 0.25 + 1e-9}):
        with pytest.raises(DataError, match="differs in"):
            holds_this_run(file, other)
