"""A small edition of benchmarks/fuzz_csv.py, and a search by hypothesis."""

import importlib.util
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "fuzz_csv.py"


@pytest.fixture(scope="module")
def fuzz_csv():
    specification = importlib.util.spec_from_file_location("fuzz_csv", BENCHMARK)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_malformed_files_are_read_or_refused_with_a_sentence(fuzz_csv):
    outcomes, sentences, failures = fuzz_csv.fuzz(seed=1, first=0, last=2000)
    assert not failures
    assert set(outcomes) == {"read", "refused"} and outcomes["read"] > 100
    assert len(sentences) > 25


def test_a_failure_would_be_seen(fuzz_csv, tmp_path, monkeypatch):
    def broken(path, actions=None):
        raise KeyError(path)

    monkeypatch.setattr(Rollouts, "from_csv", broken)
    assert fuzz_csv.outcome(tmp_path / "fuzz.csv", None)[0] == "traceback"


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
