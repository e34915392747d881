"""Files and recordings of many small parts: refused early, or checked together as one by one."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import Rollouts, rollout_checks
from npdr_ppl.rollouts.io.parquet_sizes import check_footer
from npdr_ppl.rollouts.logs import read_log

HEADER = "rollout,time,angle\n"


def written(tmp_path, text):
    path = tmp_path / "data.csv"
    path.write_text(text)
    return path


def test_a_blank_line_after_each_row_is_read(tmp_path):
    rows = "".join(f"0,{k},1\n\n" for k in range(LIMITS.blank_lines + 10))
    assert Rollouts.load(written(tmp_path, HEADER + rows)).lengths == (LIMITS.blank_lines + 9,)


@pytest.mark.parametrize("read", [Rollouts.load, read_log])
def test_blank_lines_only_are_refused(read, tmp_path):
    with pytest.raises(DataError, match=r"100000 more blank lines than rows"):
        read(written(tmp_path, HEADER + "\n" * (LIMITS.blank_lines + 1)))


def test_rollouts_are_counted_across_blocks(tmp_path):
    rows = "".join(f"{k},{t},1\n" for k in range(LIMITS.rollouts + 1) for t in range(4))
    with pytest.raises(DataError, match=r"more than 10000 rollouts"):
        Rollouts.load(written(tmp_path, HEADER + rows))


@pytest.mark.parametrize("bad", [0.0, 0.5, 1.3, np.inf])
@pytest.mark.parametrize("place", [0, 7, 149])
def test_times_of_rollouts_are_checked_together_as_alone(bad, place):
    times = [np.arange(2 + k % 5, dtype=np.float64) for k in range(150)]
    rollout_checks.check_times(times)
    times[place] = np.array([0.0, 1.0, 2.0, 2.0 + bad])
    with np.errstate(invalid="ignore"):
        for check in (
            lambda: rollout_checks.check_times(times),
            lambda: rollout_checks.check_time(times[place], f"rollout {place}"),
        ):
            with pytest.raises(DataError, match=f"in rollout {place}[ ;]"):
                check()


@pytest.mark.parametrize("place", [0, 80, 149])
def test_values_of_rollouts_are_checked_together_as_alone(place):
    values = [np.zeros((2 + k % 5, 2)) for k in range(150)]
    rollout_checks.check_values(values, ("a", "b"))
    values[place][1, 1] = np.nan
    with pytest.raises(DataError, match=f"b is nan at step 1 of rollout {place},"):
        rollout_checks.check_values(values, ("a", "b"))


def test_vectors_of_different_lengths(tmp_path):
    cells = ["[1]", "", "[1, 2, 3]", "[1, 2]", "[1, 2, 3, 4, 5, 6, 7]"]
    rows = "".join(f'{k},"{cell}"\n' for k, cell in enumerate(cells))
    log = read_log(written(tmp_path, "t,x\n" + rows))
    assert [s.values.tolist() for s in log.signals[:3]] == [[1, 1, 1, 1], [2, 2, 2], [3, 3]]
    assert len(log.signals) == 7


def test_vectors_of_too_many_numbers_are_refused(tmp_path):
    row = '"[' + "0," * 900 + '0]"\n'
    with pytest.raises(DataError, match=r"words or numbers"):
        read_log(written(tmp_path, "t,x\n" + "".join(f"{k},{row}" for k in range(7_500))))


def test_a_parquet_footer_of_one_endless_number_is_refused():
    content = b"\x15" + b"\xff" * 100_000
    data = content + len(content).to_bytes(4, "little") + b"PAR1"
    with pytest.raises(ValueError, match="64 bits"):
        check_footer(io.BytesIO(data))


def test_a_parquet_footer_with_statistics_of_another_type_is_refused(tmp_path):
    # pyarrow ends the whole process when it meets one.
    path = tmp_path / "data.parquet"
    table = pa.table({"time": np.arange(30.0), "x": np.sin(np.arange(30.0))})
    pq.write_table(table, path)
    data = path.read_bytes()
    check_footer(io.BytesIO(data))
    assert read_log(path)
    # The column's repetition, "optional", before the length of its name and the name.
    optional = b"\x25\x02\x18\x01x"
    assert data.count(optional) == 1
    path.write_bytes(data.replace(optional, b"\x25\x00\x18\x01x"))
    for read in (Rollouts.load, read_log):
        with pytest.raises(DataError, match="statistics of a column contradict its type"):
            read(path)


def test_robots_of_too_many_attributes_are_refused(tmp_path):
    from npdr_ppl.engines.common.robot_files import read_robot

    path = tmp_path / "robot.urdf"
    path.write_text("<robot " + 'a="1" ' * (LIMITS.robot_attributes + 1) + "/>")
    with pytest.raises(ModelError, match="more than 100000 attributes"):
        read_robot(path)
