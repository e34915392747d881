"""A small edition of benchmarks/fuzz_files.py, and a search by hypothesis."""

import file_outcomes
import fuzz_files
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts

NUMBERS = {"csv": 1500, "parquet": 150, "npz": 150, "nc": 150, "pickle": 300, "mjcf": 150,
           "urdf": 100, "run": 40, "resume": 150,
           **dict.fromkeys(file_outcomes.LOGS, 100)}  # fmt: skip
"""Files by format."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.slow
@pytest.mark.parametrize("kind", file_outcomes.FORMATS)
def test_damaged_files_are_read_or_refused_with_a_sentence(kind, folder):
    outcomes, sentences, failures = fuzz_files.fuzz(kind, 1, 0, NUMBERS[kind], folder)
    assert not failures
    assert set(outcomes) == {"read", "refused"}
    assert outcomes["refused"] > 0.2 * NUMBERS[kind] and len(sentences) > 2


def test_a_failure_would_be_seen(tmp_path, monkeypatch):
    def broken(path):
        raise KeyError(path)

    monkeypatch.setattr(Rollouts, "load", broken)
    assert file_outcomes.outcome("csv", tmp_path / "fuzz.csv")[0] == "traceback"


cells = st.sampled_from(
    ["0", "1", "0.1", "0.2", "0.3", "", "rollout", "time", "x", "nan", '"', "é"]
)


@settings(
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(rows=st.lists(st.lists(cells, min_size=1, max_size=5), max_size=6), random=st.binary())
def test_any_bytes_are_read_or_refused(rows, random, tmp_path):
    path = tmp_path / "x.csv"
    for content in (
        "\n".join(["rollout,time,x", *map(",".join, rows)]).encode(),
        b"rollout,time,x\n" + random,
        random,
    ):
        path.write_bytes(content)
        try:
            Rollouts.from_csv(path)
        except DataError as error:
            assert str(error).isprintable()
