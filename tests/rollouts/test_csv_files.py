import re

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts

GOOD = """rollout,time,angle,rate,voltage
0,0.0,0.1,0.0,1.5
0,0.1,0.2,1.0,-1e0
0,0.2,0.3,1.0,
1,0.0,0.5,0.0,2
1,0.1,0.6,1.0,
"""


def read(tmp_path, content, **options):
    path = tmp_path / "data.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return Rollouts.from_csv(path, **options)


def test_the_layout(tmp_path):
    rollouts = read(tmp_path, GOOD)
    assert rollouts.channel_names == ("angle", "rate") and rollouts.action_names == ("voltage",)
    assert rollouts.lengths == (2, 1) and rollouts.time_step == 0.1
    assert rollouts.actions[0].ravel().tolist() == [1.5, -1.0]
    assert rollouts.readings[1].tolist() == [[0.5, 0.0], [0.6, 1.0]]


@pytest.mark.parametrize(
    "content",
    [
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        "\ufeff" + GOOD,
        GOOD.replace("rollout,time", '"rollout", time'),
        GOOD.replace("0.3", '"0.3"').replace("0.6", " +6.0E-1\t"),
        GOOD + "\n\n",
        GOOD.replace("\n1,0.0", "\n\n7.0,0.0").replace("\n1,", "\n7,"),
        GOOD[:-1],
    ],
)
def test_variants_that_mean_the_same(tmp_path, content):
    assert read(tmp_path, content) == read(tmp_path, GOOD)


def test_columns_may_come_in_any_order_and_rewards_are_rewards(tmp_path):
    rollouts = read(tmp_path, "time,u,x,reward,rollout\n0,1,2,3,0\n1,,4,,0\n")
    assert rollouts.channel_names == ("x",) and rollouts.action_names == ("u",)
    assert rollouts.rewards is not None and rollouts.rewards[0].tolist() == [3]


def test_actions_by_name(tmp_path):
    full = GOOD.replace("1.0,\n", "1.0,9\n")
    assert read(tmp_path, full).action_names == ()
    assert read(tmp_path, full, actions=["voltage"]) == read(tmp_path, GOOD)
    assert read(tmp_path, GOOD, actions=["voltage"]) == read(tmp_path, GOOD)
    with pytest.raises(DataError, match="no column volts to be an action"):
        read(tmp_path, GOOD, actions=["volts"])


def edit(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "the file is empty"),
        ("\n\n \n", "no header line"),
        (GOOD.splitlines()[0], "there are 0 rows of data"),
        ("\n".join(GOOD.splitlines()[:2]), "there are 1 rows of data"),
        (edit("rollout,", "trial,"), "no column rollout; the header is 'trial,time"),
        (edit("time,", "t,"), "no column time"),
        (edit("rate", "angle"), "the column 'angle' appears twice"),
        (edit("rate", ""), "column 4 has no name"),
        (edit("rate", "rate/2"), "column 4 is called 'rate/2', but names"),
        (GOOD.split("\n", 1)[1], "the first line holds numbers"),
        (GOOD.replace(",", ";"), "separated by semicolons, but commas"),
        (GOOD.replace(",", "\t"), "separated by tabs"),
        (edit("0.3", "0,3"), "line 4 has 6 cells, but the header has 5"),
        (edit("0.3,", ""), "line 4 has 4 cells"),
        (edit("0.3", "-inf"), "angle is '-inf' in line 4"),
        (edit("0.3", "1e999"), "angle is too large in line 4"),
        (edit("0.3", "1e101"), "plausible size"),
        (edit("0.3", "fast"), "angle is 'fast' in line 4"),
        (edit("0.3", "0_3"), "angle is '0_3' in line 4"),
        (edit("0.3", "٣"), "in line 4, which is not a finite number"),
        (edit("0.3", "1e"), "angle is '1e' in line 4"),
        (edit("0.3", "0x1F"), "angle is '0x1F' in line 4"),
        (edit("0.3", '"0\n3"'), r"angle is '0\\n3' in line 5"),
        (edit("0.3", '"0.3'), "is not valid CSV"),
        (edit("1,0.1,0.6,1.0,", "1,0.1,0.6,1.0,3"), "last row of rollout 0 but not of rollout 1"),
        (edit("1,0.1", "2,0.1"), "rollout 1 has one row in line 5, but"),
        (edit("0,0.2", "0.5,0.2"), "rollout is 0.5 in line 4"),
        (edit("0,0.2", "-1,0.2"), "rollout is -1 in line 4"),
        (edit("0,0.2", ",0.2"), "rollout is empty in line 4"),
        (edit("0,0.1,", "2,0.1,"), "rollout 0 begins again in line 4"),
        (GOOD.encode("utf-16"), "encoded as UTF-16"),
        (GOOD.encode("utf-32-le"), "NUL bytes"),
        (edit("rate", "räte").encode("latin-1"), "line 1 is not UTF-8 text"),
        (GOOD.encode() + b"\x00", "NUL bytes"),
        (b"\x89HDF\r\n\x1a\n" + bytes(range(1, 256)), "is not UTF-8 text"),
        (GOOD.replace("0.1,", "1e-300,").replace("0.2,", "2e-300,"), "less than two measurements"),
        (edit("0.3", "x" * 200_000), "field larger than field limit"),
        (edit("angle", "a" * 101), "at most 100 characters"),
    ],
)
def test_bad_files_get_one_sentence(tmp_path, content, sentence):
    with pytest.raises(DataError, match=sentence) as caught:
        read(tmp_path, content)
    assert re.fullmatch(r"data\.csv: [^\n]{,300}\.", str(caught.value))


def test_odd_paths(tmp_path):
    for path in ("\0", "x" * 5000, "/dev/null", tmp_path):
        with pytest.raises(DataError) as caught:
            Rollouts.from_csv(path)
        assert str(caught.value).isprintable()


def test_huge_files_are_refused_unread(tmp_path):
    path = tmp_path / "huge.csv"
    with path.open("wb") as file:
        file.truncate(2**31)  # sparse: takes no space
    with pytest.raises(DataError, match=r"the file has 2.0 GiB, more than the 1 GiB"):
        Rollouts.from_csv(path)


def test_measured_files(shared):
    furuta = Rollouts.load(shared / "quanser_qube" / "swing_up_500hz_5s.csv")
    assert len(furuta) == 5 and furuta.lengths == (2500,) * 5 and furuta.time_step == 0.002
    assert furuta.action_names == ("voltage",)
    emps = Rollouts.load(shared / "emps" / "identification_1khz_25s.csv")
    assert emps.channel_names == ("position", "reference") and emps.time_step == 0.001
    golf = Rollouts.load(shared / "mini_golf" / "strike_100hz_8s.csv")
    assert len(golf.action_names) == 7 and len(golf.channel_names) == 9
    assert np.isclose(golf.readings[0][0, 0], 0.309159)
