"""HDF5 files that take their data from elsewhere are refused before any data are read."""

import h5py
import numpy as np
import pytest

from npdr_ppl.arviz_module import from_netcdf
from npdr_ppl.errors import DataError
from npdr_ppl.hdf5_checks import check_self_contained
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import read_log

SECRET = np.arange(21.0)


@pytest.fixture
def elsewhere(tmp_path):
    SECRET.tofile(tmp_path / "secret.bin")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = SECRET
    return tmp_path


def external_storage(file, folder):
    file.create_dataset(
        "angle", (21,), "f8", external=[(str(folder / "secret.bin"), 0, h5py.h5f.UNLIMITED)]
    )


def external_link(file, folder):
    file["angle"] = h5py.ExternalLink(str(folder / "other.h5"), "secret")


def soft_link(file, folder):
    file["angle"] = h5py.SoftLink("/somewhere")


def virtual_data_set(file, folder):
    layout = h5py.VirtualLayout((21,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "secret", (21,))
    file.create_virtual_dataset("angle", layout)


def link_in_a_group(file, folder):
    external_link(file.create_group("deep/deeper"), folder)


@pytest.mark.parametrize("read", [Rollouts.from_netcdf, from_netcdf, Rollouts.load])
@pytest.mark.parametrize(
    "write",
    [external_storage, external_link, soft_link, virtual_data_set, link_in_a_group],
    ids=lambda function: function.__name__,
)
def test_a_file_that_takes_data_from_elsewhere_is_refused(elsewhere, write, read):
    path = elsewhere / "recording.nc"
    with h5py.File(path, "w") as file:
        write(file, elsewhere)
    with pytest.raises(DataError, match=r"recording\.nc: 'angle' .*not read"):
        read(path)


def test_groups_that_contain_each_other_are_refused(tmp_path):
    with h5py.File(tmp_path / "circle.nc", "w") as file:
        file.create_group("a")["b"] = file
    with pytest.raises(DataError, match="'b' is a second name of another part"):
        check_self_contained(tmp_path / "circle.nc")


def test_a_damaged_posterior_gets_one_sentence(tmp_path):
    (tmp_path / "posterior.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(DataError, match="not a readable NetCDF file"):
        from_netcdf(tmp_path / "posterior.nc")


@pytest.mark.parametrize("size", [0, 8])
def test_texts_that_the_library_would_read_for_ever_are_refused(tmp_path, size):
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.attrs["names"] = np.array(["a", "b"], dtype=h5py.string_dtype())
    data = bytearray(path.read_bytes())
    free = data.index(b"GCOL") + 16 + 2 * 24
    assert data[free : free + 2] == b"\0\0"
    data[free + 8 : free + 16] = size.to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(DataError, match="texts are damaged"):
        check_self_contained(path)


def test_lists_are_refused_in_netcdf_and_left_out_of_logs(tmp_path):
    path = tmp_path / "x.h5"
    lists = h5py.vlen_dtype(np.uint8)
    with h5py.File(path, "w") as file:
        file["time"], file["angle"] = np.arange(20) * 0.1, np.arange(20.0)
        ragged = np.array([np.zeros(2, "u1"), np.zeros(3, "u1")], dtype=object)
        file["angle"].attrs.create("units", ragged, dtype=lists)
    with pytest.raises(DataError, match="the attribute 'units' holds lists"):
        check_self_contained(path)
    with h5py.File(path, "a") as file:
        del file["angle"].attrs["units"]
        file.create_dataset("lists", (3,), lists)[0] = np.arange(4)
    with pytest.raises(DataError, match="'lists' holds lists"):
        check_self_contained(path)
    assert [signal.name for signal in read_log(path).signals] == ["angle"]
