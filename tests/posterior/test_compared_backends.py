"""Candidates are read from text as they are meant, and nonsense is refused with one sentence."""

import pytest

from npdr_ppl.errors import BackendError, NpdrError
from npdr_ppl.inference.registry import backend
from npdr_ppl.posterior.comparison.compared_backends import (
    Candidate,
    available,
    candidates,
    folder_name,
    requested,
    split_candidates,
)


def read(text):
    return candidates(split_candidates(text))


def test_names_options_and_labels():
    found = read("snpe-c, snpe-c(flow=maf, members=1), small = snpe-c(hidden=(32, 16)),")
    assert list(found) == ["snpe-c", "snpe-c(flow=maf, members=1)", "small"]
    assert found["snpe-c"] == Candidate(backend("snpe-c"))
    assert found["snpe-c(flow=maf, members=1)"].backend == backend("snpe-c", flow="maf", members=1)
    assert found["small"].backend == backend("snpe-c", hidden=(32, 16))


def test_features_of_their_own():
    found = read("snpe-c(embedding=all/10, epochs=3)")
    assert next(iter(found.values())) == Candidate(backend("snpe-c", epochs=3), "all/10")


def test_objects_and_labels_in_python():
    method = backend("snpe-c", flow="maf")
    assert candidates([method]) == {"snpe-c": Candidate(method)}
    assert candidates({"a": method, "b": "snpe-c"}) == {
        "a": Candidate(method), "b": Candidate(backend("snpe-c"))
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "at least one"),
        ("snpe-c, snpe-c", "cannot be told apart"),
        ("snpec", "did you mean 'snpe-c'"),
        ("snpe-c(flw=maf)", "did you mean 'flow'"),
        ("snpe-c(flow=glow)", "flow must be one of"),
        ("snpe-c(members=many)", "option of the wrong type"),
        ("snpe-c(flow)", "option=value is expected"),
        ("snpe-c(flow=maf", "leaves a parenthesis open"),
        ("snpe-c)", "did not open"),
        ("snpe-c(flow=maf) twice", "closing parenthesis"),
        ("snpe-c(embedding=everything)", "everything"),
    ],
)
def test_nonsense_is_refused(text, sentence):
    with pytest.raises(NpdrError, match=sentence) as raised:
        read(text)
    assert len(str(raised.value).splitlines()) == 1


def test_labels_become_folders_that_differ():
    names = {folder_name(label) for label in read("snpe-c, snpe-c(flow=maf), ../a = snpe-c")}
    assert len(names) == 3
    assert all("/" not in name and not name.startswith(".") for name in names)
    with pytest.raises(BackendError, match="cannot be told apart"):
        candidates({"a b": "snpe-c", "a_b": "snpe-c"})


def test_absent_backends_are_skipped_with_a_reason():
    found, skipped = available({"here": "snpe-c", "there": "no-such-method"})
    assert list(found) == ["here"]
    assert "no-such-method" in skipped["there"]


def test_usual_candidates_are_requested_by_their_labels():
    usual = {"small": "snpe-c(hidden=(8,))", "gone": "no-such-method"}
    found, skipped = requested(["small", "snpe-c"], usual)
    assert found == candidates(["small = snpe-c(hidden=(8,))", "snpe-c"])
    assert skipped == {}
    found, skipped = requested(None, usual)
    assert (list(found), list(skipped)) == (["small"], ["gone"])
    with pytest.raises(BackendError, match="no-such-method"):
        requested(["gone"], usual)
