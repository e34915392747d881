import warnings
import zipfile

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts

FORMATS = {"csv": "x.csv", "parquet": "x.parquet", "npz": "x.npz", "netcdf": "x.nc"}

names = st.from_regex(r"[A-Za-z_θα][A-Za-z0-9_ .\-]{0,6}", fullmatch=True).filter(
    lambda name: name == name.strip() and name not in ("rollout", "time", "reward", "step")
)
finite = st.floats(-1e100, 1e100)


@st.composite
def layouts(draw):
    """Rollouts of any layout, lengths and values."""
    lengths = draw(st.lists(st.integers(1, 5), min_size=1, max_size=3))
    columns = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    num_channels = draw(st.integers(1, len(columns)))
    time_step = draw(st.floats(1e-4, 10))
    units = draw(st.lists(st.sampled_from(["", "rad", "N m", "°C"]), min_size=4, max_size=4))

    def matrix(*shape):
        return draw(npst.arrays(np.float64, shape, elements=finite))

    num_actions = len(columns) - num_channels
    return Rollouts.from_arrays(
        [matrix(n + 1, num_channels) for n in lengths],
        [matrix(n, num_actions) for n in lengths],
        channel_names=columns[:num_channels],
        action_names=columns[num_channels:],
        time_step=time_step,
        rewards=[matrix(n) for n in lengths] if draw(st.booleans()) else None,
        channel_units=units[:num_channels],
        action_units=units[num_channels : len(columns)],
    )


def bits(rollouts):
    groups = (rollouts.readings, rollouts.actions, rollouts.time, rollouts.rewards or ())
    return [values.tobytes() for group in groups for values in group]


@pytest.mark.slow
@pytest.mark.parametrize("format_name", FORMATS)
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(rollouts=layouts())
def test_round_trip_keeps_every_bit(rollouts, format_name, tmp_path):
    path = tmp_path / FORMATS[format_name]
    getattr(rollouts, f"to_{format_name}")(path)
    loaded = Rollouts.load(path)
    assert bits(loaded) == bits(rollouts)
    assert loaded.channel_names == rollouts.channel_names
    assert loaded.action_names == rollouts.action_names
    assert loaded.time_step == rollouts.time_step
    if format_name != "csv":  # CSV is SI by convention and carries no units
        assert loaded == rollouts
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # no temporary file is left


def test_xarray_round_trip(small):
    dataset = small.to_xarray()
    assert dict(dataset.sizes) == {"rollout": 3, "step": 8}
    assert dataset["torque"].attrs["units"] == "N m"
    assert np.isnan(dataset["torque"].values[1, 4:]).all()
    assert Rollouts.from_xarray(dataset) == small


def test_netcdf_opens_in_plain_xarray_without_warnings(small, tmp_path):
    import xarray as xr

    small.to_netcdf(tmp_path / "x.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with xr.open_dataset(tmp_path / "x.nc") as dataset:
            np.testing.assert_array_equal(dataset["angle"].values[0], small.readings[0][:, 0])


def test_csv_is_what_pandas_reads(small, tmp_path):
    small.to_csv(tmp_path / "x.csv")
    frame = pd.read_csv(tmp_path / "x.csv")
    assert list(frame.columns) == ["rollout", "time", "angle", "rate", "torque", "reward"]
    assert frame.groupby("rollout").size().tolist() == [8, 5, 6]
    assert frame.groupby("rollout").tail(1)["torque"].isna().all()
    np.testing.assert_allclose(frame["angle"][:8], small.readings[0][:, 0], rtol=1e-15)


def test_a_failed_write_leaves_the_old_file(small, tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    small.to_npz(path)
    before = path.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda *a, **k: (_ for _ in ()).throw(OSError))
    with pytest.raises(OSError):
        small[0].to_npz(path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_measured_files_round_trip(shared, tmp_path):
    for path in sorted(shared.glob("*/*.csv")):
        rollouts = Rollouts.load(path)
        rollouts.to_csv(tmp_path / "x.csv")
        assert Rollouts.load(tmp_path / "x.csv") == rollouts


def test_unknown_suffix_and_missing_files(tmp_path):
    (tmp_path / "x.pkl").write_text("x")
    with pytest.raises(DataError, match=r"x.pkl: the suffix '.pkl' is unknown"):
        Rollouts.load(tmp_path / "x.pkl")
    for name in FORMATS.values():
        with pytest.raises(DataError, match=rf"{name}: cannot be opened \(No such file"):
            Rollouts.load(tmp_path / name)
        (tmp_path / name).mkdir()
        with pytest.raises(DataError, match=rf"{name}: is a directory"):
            Rollouts.load(tmp_path / name)
        (tmp_path / name).rmdir()
        (tmp_path / name).touch()
        with pytest.raises(DataError, match=rf"{name}: the file is empty"):
            Rollouts.load(tmp_path / name)


@pytest.mark.parametrize("format_name", ["parquet", "npz", "netcdf"])
def test_damaged_binary_files_get_one_sentence(format_name, small, tmp_path):
    path = tmp_path / FORMATS[format_name]
    getattr(small, f"to_{format_name}")(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for trial in range(60):
        damaged = bytearray(whole)
        if trial % 3 == 0:
            damaged = damaged[: rng.integers(1, len(whole))]
        else:
            for position in rng.integers(0, len(whole), 1 + trial % 7):
                damaged[position] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            Rollouts.load(path)
        except DataError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).endswith(".")
    assert refused > 20


def test_npz_pickles_and_bombs_are_refused(small, tmp_path):
    path = tmp_path / "x.npz"
    small.to_npz(path)
    with np.load(path) as arrays:
        content = dict(arrays)
    np.savez(path, **(content | {"readings": np.array([print, None], dtype=object)}))
    with pytest.raises(DataError, match="of type object"):
        Rollouts.load(path)
    np.savez(path, **{k: v for k, v in content.items() if k != "time"})
    with pytest.raises(DataError, match="no array time"):
        Rollouts.load(path)
    np.savez(path, **(content | {"lengths": np.array([7, 4, 99])}))
    with pytest.raises(DataError, match="lengths does not fit"):
        Rollouts.load(path)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 2, 2), }"
    header += b" " * (117 - len(header)) + b"\n"
    small.to_npz(path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["readings.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(DataError, match="shorter than its header says"):
        Rollouts.load(path)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("time_step", np.array("abc"), "time_step should hold numbers"),
        ("lengths", np.array([7.0, 4.0, 5.0]), "lengths should hold integers"),
        ("channel_names", np.array([1, 2]), "channel_names should hold text"),
        ("channel_units", np.array(["rad", "\x1b[2J"]), "the unit of rate is"),
        ("channel_names", np.array(["angle", "ra\x07te"]), r"is called 'ra\\x07te'"),
        ("channel_units", np.array(["rad", "x" * 31]), "at most 30 printable"),
        ("time_step", np.array(np.nan), "the time step is nan"),
    ],
)
def test_wrong_npz_arrays_get_one_sentence(name, value, sentence, small, tmp_path):
    path = tmp_path / "x.npz"
    small.to_npz(path)
    with np.load(path) as arrays:
        content = dict(arrays)
    np.savez(path, **(content | {name: value}))
    with pytest.raises(DataError, match=sentence) as caught:
        Rollouts.load(path)
    assert str(caught.value).isprintable()


def test_an_npz_with_a_code_point_that_does_not_exist(small, tmp_path):
    path = tmp_path / "x.npz"
    small.to_npz(path)
    with np.load(path) as arrays:
        content = dict(arrays)
    content["channel_names"] = np.array([2**31, 5], dtype="<u4").view("<U1")
    np.savez(path, **content)
    with pytest.raises(DataError, match="not a readable NPZ file"):
        Rollouts.load(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format_name", "steps", "channels"),
    [("csv", 60_000, 7), ("parquet", 10**6, 3), ("npz", 10**6, 3), ("netcdf", 10**6, 3)],
)
def test_long_recordings_are_within_the_limits(format_name, steps, channels, tmp_path):
    rng = np.random.default_rng(0)
    recording = Rollouts.from_arrays(
        [rng.normal(size=(steps + 1, channels))],
        [rng.normal(size=(steps, 1))],
        channel_names=[f"x{k}" for k in range(channels)],
        action_names=("u",),
        time_step=0.001,
    )
    path = tmp_path / FORMATS[format_name]
    getattr(recording, f"to_{format_name}")(path)
    assert Rollouts.load(path).lengths == (steps,)


def test_parquet_of_text_is_refused(tmp_path):
    frame = pd.DataFrame({"rollout": [0, 0], "time": [0.0, 0.1], "x": ["a", "b"]})
    frame.to_parquet(tmp_path / "x.parquet")
    with pytest.raises(DataError, match="x is of type"):
        Rollouts.load(tmp_path / "x.parquet")


def test_parquet_written_by_pandas_is_read(tmp_path):
    frame = pd.DataFrame(
        {"rollout": [0, 0, 0], "time": [0.0, 0.1, 0.2], "x": [1, 2, 3], "u": [5.0, 6.0, np.nan]}
    )
    frame.to_parquet(tmp_path / "x.parquet", index=False)
    rollouts = Rollouts.load(tmp_path / "x.parquet")
    assert rollouts.action_names == ("u",) and rollouts.readings[0].ravel().tolist() == [1, 2, 3]
