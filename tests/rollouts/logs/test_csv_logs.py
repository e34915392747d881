"""CSV files as programs write them: comments, rows of units, spaces, Latin-1."""

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import read_log

TIME = 10.0 * np.arange(100)
ANGLE = 50.0 * np.sin(0.01 * TIME)
RATE = np.cos(0.01 * TIME)
ROWS = list(zip(TIME.tolist(), ANGLE.tolist(), RATE.tolist(), strict=True))


def written(path, head, separator=",", encoding="utf-8"):
    text = head + "".join(separator.join(map(repr, row)) + "\n" for row in ROWS)
    path.write_bytes(text.encode(encoding))
    return path


@pytest.fixture
def expected(tmp_path):
    return Rollouts.load(
        written(tmp_path / "plain.csv", "time [ms],angle,rate\n"),
        {"channels": {"angle": {"signal": "angle", "unit": "deg"}, "rate": {"signal": "rate"}}},
    )


PLAIN = {"channels": {"angle": {"signal": "angle"}, "rate": {"signal": "rate"}}}


@pytest.mark.parametrize("units", ["ms,deg,rad/s", "[ms],[°],", "(msec), (deg), ticks"])
def test_a_row_of_units_is_used(units, expected, tmp_path):
    path = written(tmp_path / "log.csv", f"time,angle,rate\n{units}\n")
    read = Rollouts.load(path, PLAIN)
    assert np.array_equal(read.readings[0], expected.readings[0])
    assert read.time_step == pytest.approx(0.01) and read.channel_units[0] == "rad"
    assert "the row below the header has the units." in read.notes


def test_a_row_of_other_text_is_no_row_of_units(tmp_path):
    # North and ampere are not told apart by their letters.
    (tmp_path / "log.csv").write_text("t,to,x\n2023-11-14 22:13,N,A\n2023-11-14 22:14,N,A\n")
    with pytest.raises(DataError, match="has no signals"):
        read_log(tmp_path / "log.csv")
    (tmp_path / "log.csv").write_text("t,to,x\n1,N,A\n2,N,A\n")
    with pytest.raises(DataError, match="has no signals"):
        read_log(tmp_path / "log.csv")


def test_comments_are_skipped(expected, tmp_path):
    head = "# arm 3; run, 7\n#\ntime,angle,rate\n# begin\nms,deg,\n"
    read = Rollouts.load(written(tmp_path / "log.csv", head), PLAIN)
    assert np.array_equal(read.readings[0], expected.readings[0])


@pytest.mark.parametrize("separator", [" ", "   ", ","])
def test_the_header_may_be_a_comment(separator, expected, tmp_path):
    head = f"# an arm\n# {separator.join(('time', 'angle', 'rate'))}\n"
    read = read_log(written(tmp_path / "log.txt", head, separator))
    assert [signal.name for signal in read.signals] == ["angle", "rate"]
    assert np.array_equal(read.by_name["rate"].values, RATE)


@pytest.mark.parametrize(
    "head", ["time  angle rate\n", " time [ms]   angle (deg)  rate [rad/s]\n"]
)
def test_spaces_separate_cells(head, tmp_path):
    log = read_log(written(tmp_path / "log.txt", head, "  "))
    angle, rate = log.signals
    assert angle.name.startswith("angle") and rate.name.startswith("rate")
    assert np.array_equal(angle.values, ANGLE) and np.array_equal(rate.values, RATE)
    assert angle.time[-1] == pytest.approx(0.99)


def test_latin_1_is_read(expected, tmp_path):
    head = "time;angle;rate\nms;°;\n"
    read = Rollouts.load(written(tmp_path / "log.csv", head, ";", "latin-1"), PLAIN)
    assert np.array_equal(read.readings[0], expected.readings[0])
    assert "the text is not UTF-8; taken as Latin-1." in read.notes


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"time,x\n" + bytes(range(1, 256)))
    with pytest.raises(DataError, match="is not UTF-8 text"):
        read_log(tmp_path / "log.csv")
