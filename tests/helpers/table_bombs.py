"""Small recordings that describe huge ones, as CSV, Parquet and NPZ; each writes one file."""

import io
import struct
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

HEADER = b"rollout,time,angle\n"


def csv_of_many_columns(path):
    path.write_bytes(b"rollout,time," + b"x," * 5_000_000 + b"x\n")


def csv_of_columns_in_several_lines(path):
    path.write_bytes(b"rollout,time," + b'"\n",' * 2_000_000 + b"x\n")


def csv_of_one_long_row(path):
    path.write_bytes(HEADER + b"1," * 5_000_000)


def csv_of_a_row_in_many_lines(path):
    path.write_bytes(HEADER + b'"1\n",' * 3_000_000)


def csv_of_one_long_cell(path):
    path.write_bytes(HEADER + b'0,0,"' + b"x" * 30_000_000)


def csv_of_quotes(path):
    path.write_bytes(HEADER + b'"' * 10_000_000)


def csv_of_blank_lines(path):
    path.write_bytes(HEADER + b"\n" * 5_000_000)


def csv_of_long_numbers(path):
    rows = (b"0,%d," % k + b"9" * 100_000 + b"\n" for k in range(100))
    path.write_bytes(HEADER + b"".join(rows))


def csv_of_many_rollouts(path):
    rows = (b"%d,0,1\n%d,1,1\n" % (k, k) for k in range(200_000))
    path.write_bytes(HEADER + b"".join(rows))


def csv_of_almost_too_many_rollouts(path):
    rows = (b"%d,0,1\n%d,1,1\n" % (k, k) for k in range(10_000))
    path.write_bytes(HEADER + b"".join(rows))


def csv_of_long_names(path):
    path.write_bytes(b"rollout,time," + b",".join(b"n%d" % k * 50 for k in range(400)))


def _parquet(path, columns, **options):
    table = {"rollout": np.zeros(2), "time": np.array([0.0, 0.1]), **columns}
    length = max(len(values) for values in table.values())
    padded = {
        name: values if len(values) == length else np.arange(length) * 0.1
        for name, values in table.items()
    }
    pq.write_table(pa.table(padded), path, **options)


def parquet_of_zeros(path):
    table = {name: np.zeros(15_000_000) for name in ("rollout", "time", "x", "y")}
    pq.write_table(pa.table(table), path, compression="zstd", use_dictionary=False)


def parquet_of_almost_too_much(path):
    """Three columns of 62 MB together."""
    count = 2_600_000
    time = np.round(np.arange(count) * 0.001, 3)
    pq.write_table(pa.table({"rollout": np.zeros(count), "time": time, "x": time}), path)


def parquet_of_one_value(path):
    pq.write_table(pa.table({"rollout": np.zeros(40_000_000, dtype=np.int8)}), path)


def parquet_of_a_page_that_is_larger_than_stated(path):
    """One page of 400 MB, of which the footer says that it has a few bytes."""
    values = pa.table({"x": np.zeros(50_000_000)})
    options = {"compression": "zstd", "use_dictionary": False, "write_statistics": False}
    pq.write_table(values, path, data_page_size=2**30, row_group_size=len(values), **options)
    data = bytearray(path.read_bytes())
    group = pq.ParquetFile(path).metadata.row_group(0)
    stated = {len(values), group.total_byte_size, group.column(0).total_uncompressed_size}
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    for value in stated:
        before, after = _varint(value), bytearray(_varint(2))
        while len(after) < len(before):
            after[-1] |= 128
            after.append(0)
        data[footer:] = data[footer:].replace(before, bytes(after))
    path.write_bytes(data)


def _varint(value):
    value, result = 2 * value, bytearray()
    while value > 127:
        result.append(value & 127 | 128)
        value >>= 7
    return bytes([*result, value])


def parquet_of_many_columns(path):
    _parquet(path, {f"x{k}": np.zeros(2) for k in range(3_000)})


def parquet_of_long_text(path):
    ends = pa.array(range(0, 500_000_000, 100_000_000), pa.int32())
    text = pa.StringArray.from_buffers(4, ends.buffers()[1], pa.py_buffer(b"x" * 400_000_000))
    pq.write_table(pa.table({"rollout": text}), path, compression="zstd", write_statistics=False)


def parquet_of_many_row_groups(path):
    _parquet(path, {"x": np.zeros(6_000)}, row_group_size=1)


def parquet_of_almost_too_many_row_groups(path):
    _parquet(path, {"x": np.zeros(3_000)}, row_group_size=1)


def parquet_of_nested_lists(path):
    kind = pa.float64()
    for _ in range(300):
        kind = pa.list_(kind)
    pq.write_table(pa.table({"x": pa.array([None, None], kind)}), path)


def _parquet_with_metadata(path, text):
    table = pa.table({"rollout": [0, 0], "time": [0.0, 0.1], "x": [1.0, 2.0]})
    pq.write_table(table.replace_schema_metadata({"npdr_ppl": text}), path)


def parquet_of_long_units(path):
    _parquet_with_metadata(path, '{"units": {"x": "' + "m" * 10_000_000 + '"}}')


def parquet_of_nested_metadata(path):
    _parquet_with_metadata(path, '{"units": ' * 50_000)


def parquet_of_many_rollouts(path):
    rows = {"rollout": np.arange(2_000_000) // 2, "time": np.arange(2_000_000) % 2 * 0.1}
    pq.write_table(pa.table(rows | {"x": np.zeros(2_000_000)}), path)


def _npz(path, **changes):
    content = {
        "readings": np.zeros((1, 3, 1)),
        "actions": np.zeros((1, 2, 0)),
        "time": np.array([[0.0, 0.1, 0.2]]),
        "lengths": np.array([2]),
        "time_step": np.array(0.1),
        "channel_names": np.array(["x"]),
        "action_names": np.array([], dtype=np.str_),
        "channel_units": np.array([""]),
        "action_units": np.array([], dtype=np.str_),
    } | changes
    # As NumPy does it, but with little effort: the weakest compression is many times faster.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in content.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(values))


def _npz_member(path, name, data, compression=zipfile.ZIP_DEFLATED):
    _npz(path)
    with zipfile.ZipFile(path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    with zipfile.ZipFile(path, "w", compresslevel=1) as archive:
        for member, content in (members | {f"{name}.npy": data}).items():
            archive.writestr(member, content, compression)


def _npy(header, data=b"", version=1):
    text = header.encode() + b" " * (-len(header) % 64) + b"\n"
    length = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + length + text + data


def npz_of_zeros(path):
    _npz(path, readings=np.zeros((1, 60_000_000, 1)), time=np.zeros((1, 60_000_000)))


def npz_of_almost_too_much(path):
    """Readings and time stamps of 62 MB together."""
    count = 3_900_000
    time = (np.arange(count) * 0.1)[None]
    _npz(path, readings=np.zeros((1, count, 1)), time=time, actions=np.zeros((1, count - 1, 0)),
         lengths=np.array([count - 1]))  # fmt: skip


def npz_of_almost_too_many_rollouts(path):
    count = 10_000
    _npz(
        path,
        readings=np.zeros((count, 2, 1)),
        actions=np.zeros((count, 1, 0)),
        time=np.tile([0.0, 0.1], (count, 1)),
        lengths=np.ones(count, dtype=int),
    )


def npz_of_small_integers(path):
    _npz(path, readings=np.zeros((1, 60_000_000, 1), np.int8))


def npz_of_a_huge_shape(path):
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 10000000000000, 2), }"
    _npz_member(path, "readings", _npy(header))


def npz_of_empty_words(path):
    header = "{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000000,), }"
    _npz_member(path, "channel_names", _npy(header))


def npz_of_long_words(path):
    _npz(path, channel_names=np.array(["x" * 20_000_000, "y"]))


def npz_of_many_rollouts(path):
    count = 2_000_000
    _npz(
        path,
        readings=np.zeros((count, 2, 1)),
        actions=np.zeros((count, 1, 0)),
        time=np.tile([0.0, 0.1], (count, 1)),
        lengths=np.ones(count, dtype=int),
    )


def npz_of_a_nested_header(path):
    _npz_member(path, "readings", _npy("(" * 9_000 + ")" * 900))


def npz_of_a_long_header(path):
    _npz_member(path, "readings", _npy(" " * 30_000_000, version=2))


def npz_of_many_members(path):
    _npz(path)
    with zipfile.ZipFile(path, "a") as archive:
        for index in range(60_000):
            archive.writestr(f"{index}", b"")


def npz_of_strong_compression(path):
    _npz_member(path, "readings", _npy("x") + bytes(200_000_000), zipfile.ZIP_BZIP2)


def npz_of_a_member_that_is_larger_than_stated(path):
    file = io.BytesIO()
    np.save(file, np.zeros((1, 30_000_000, 1)))
    _npz_member(path, "readings", file.getvalue())
    data = path.read_bytes()
    path.write_bytes(data.replace(struct.pack("<I", len(file.getvalue())), struct.pack("<I", 300)))


BOMBS = {
    suffix: {name: make for name, make in globals().items() if name.startswith(f"{suffix}_of")}
    for suffix in ("csv", "parquet", "npz")
}
