"""The shell completes names, at once."""

import os
import subprocess
import sys

import pytest

from npdr_ppl.cli import names
from npdr_ppl.inference.registry import backends
from npdr_ppl.loop.control_task import control_tasks
from npdr_ppl.models import targets, zoo
from npdr_ppl.models.effects import effects
from npdr_ppl.policies.search_registry import policy_searches


def completed(*words):
    """Returns what a bash offers for the last word, and the processor time it took."""
    # typer looks at the name of the program, as which -c does not serve.
    program = "import sys; sys.argv[0] = 'npdr'; from npdr_ppl.cli.main import main; main()"
    line = " ".join(("npdr", *words))
    before = sum(os.times()[2:4])
    shown = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", program],
        capture_output=True,
        text=True,
        env={
            **os.environ,
            "_NPDR_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(words)),
        },
    )
    assert "| torch" not in shown.stderr
    return shown.stdout.split(), sum(os.times()[2:4]) - before


def test_the_names_are_those_of_the_registries():
    assert set(names.MODELS) == set(zoo())
    assert set(names.TARGETS) == set(targets())
    assert set(names.TASKS) == set(control_tasks())
    assert set(names.BACKENDS) == set(backends())
    assert set(names.SEARCHES) == set(policy_searches())
    assert set(names.EFFECTS) == set(effects())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("fit", "furuta_"), ["furuta_paper"]),
        (("fit", "furuta", "--backend", "snpe"), ["snpe-a", "snpe-c"]),
        (("fit", "furuta", "--effect", "arm.cou"), ["arm.coulomb_friction"]),
        (("discover", "furuta", "--candidates", "arm.cogging,voltage.inp"),
         ["arm.cogging,voltage.input_delay"]),
        (("compare", "furuta", "--backends", "abc,nr"), ["abc,nre"]),
        (("train", "furuta", "--target", "furuta-h"), ["furuta-hard"]),
        (("train", "furuta", "--target", "furuta-hard", "--search", "c"), ["cma-es"]),
        (("train", "furuta", "--target", "furuta-hard", "--task", ""), ["furuta-swing-up"]),
        (("fit", "furuta", "--embedding", "sc"), ["score"]),
        (("reproduce", "missing"), ["missing-effect"]),
    ],
)  # fmt: skip
def test_names_are_completed_without_torch(words, expected):
    assert completed(*words)[0] == expected


def test_what_is_no_name_is_left_to_the_shell():
    # bash then completes files, by the default of the script that --show-completion prints.
    assert completed("fit", "path/to/mi")[0] == []


@pytest.mark.slow
def test_completion_is_quick():
    assert min(completed("fit", "fur")[1] for _ in range(3)) < 1.0
