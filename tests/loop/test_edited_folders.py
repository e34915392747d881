"""A run of the loop that continues in a folder that was edited: a result, or one sentence."""

import random
import shutil

import pytest
from fuzz_files import damage, edit_json

from npdr_ppl.errors import NpdrError
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.small_loop import SMALL_DATA, HandmadePendulum, small_options, small_task

EDITS = 3
"""Edits of each file."""


def run(folder):
    return train(
        pendulum,
        HandmadePendulum(),
        small_task(),
        options=SMALL_DATA,
        loop=small_options(iterations=1),
        out=folder,
        progress=False,
    )


@pytest.mark.slow
def test_every_file_of_a_run_may_be_damaged(tmp_path):
    run(tmp_path / "whole")
    files = sorted(
        file.relative_to(tmp_path / "whole")
        for file in (tmp_path / "whole").rglob("*")
        if file.is_file() and file.name not in (".lock", "train.json")
    )
    rng = random.Random(0)
    refused = 0
    for file in files:
        for edit in range(EDITS):
            copy = tmp_path / "copy"
            shutil.copytree(tmp_path / "whole", copy)
            data = (copy / file).read_bytes()
            if edit % 2 or file.suffix != ".json":
                (copy / file).write_bytes(damage(rng, data))
            else:
                (copy / file).write_bytes(edit_json(rng, data))
            try:
                run(copy)
            except NpdrError as error:
                refused += 1
                assert str(error).endswith(".") and "\n" not in str(error), (file, edit)
            shutil.rmtree(copy)
    assert refused > len(files)
