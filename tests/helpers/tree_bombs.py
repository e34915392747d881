"""Small recordings that describe huge ones, as NetCDF and pickle; each writes one file."""

import struct

import h5netcdf
import h5py
import numpy as np

from tests.helpers.deflated import deflated_zeros

ROLLOUT = b"cpyrado.sampling.step_sequence\nStepSequence\n"
F8 = b"cnumpy\ndtype\nX\x02\x00\x00\x00f8K\x00K\x01\x87R"


def _file(path, **options):
    return h5py.File(path, "w", **options)


def nc_of_chunks_that_are_not_stored(path):
    with _file(path) as file:
        file.create_dataset("angle", (1, 10**10), "f8", chunks=(1, 1000))


def nc_of_zeros(path):
    with _file(path) as file:
        file.create_dataset("angle", data=np.zeros((1, 40_000_000)), compression="gzip",
                            compression_opts=1)  # fmt: skip


def nc_of_almost_too_much(path):
    """Readings and time stamps of 62 MB together."""
    count = 3_900_000
    dimensions = {"rollout": 1, "step": count}
    with h5netcdf.File(path, "w") as file:
        file.dimensions = dimensions
        for name, values in (("time", np.arange(count) * 0.1), ("angle", np.zeros(count))):
            data = file.create_variable(
                name, tuple(dimensions), "f8", compression="gzip", compression_opts=1
            )
            data[...] = values[None]
            data.attrs["kind"] = "time" if name == "time" else "channel"
        file.create_variable("num_steps", ("rollout",), data=np.array([count - 1]))


def nc_of_small_integers(path):
    with _file(path) as file:
        values = np.zeros((1, 60_000_000), np.int8)
        file.create_dataset("angle", data=values, compression="gzip")


def nc_of_a_chunk_that_is_larger_than_stated(path):
    with _file(path) as file:
        data = file.create_dataset("angle", (10,), "f8", chunks=(10,), compression="gzip")
        data.id.write_direct_chunk((0,), deflated_zeros(800))


def nc_of_a_huge_chunk(path):
    with _file(path) as file:
        data = file.create_dataset(
            "angle", (10,), "f8", chunks=(90_000_000,), maxshape=(None,), compression="gzip"
        )
        data.id.write_direct_chunk((0,), deflated_zeros(720))


def nc_of_text_that_many_share(path):
    with _file(path) as file:
        words = np.array(["x" * 1_000_000] + ["y"] * 5_000, dtype=object)
        data = file.create_dataset("channel", data=words, dtype=h5py.string_dtype())
        offset, size = data.id.get_offset(), data.id.get_storage_size()
    content = bytearray(path.read_bytes())
    content[offset : offset + size] = content[offset : offset + 16] * (size // 16)
    path.write_bytes(content)


def nc_of_wide_text(path):
    with _file(path) as file:
        file.create_dataset("channel", (4,), "S1000000000", chunks=(1,))


def nc_of_groups_in_each_other(path):
    with _file(path) as file:
        group = file
        for _ in range(40):
            inner = group.create_group("a")
            group["b"] = inner
            group = inner


def nc_of_nested_groups(path):
    with _file(path, libver="latest") as file:
        group = file
        for _ in range(3_000):
            group = group.create_group("g")


def nc_of_many_data_sets(path):
    with _file(path, libver="latest") as file:
        for index in range(12_000):
            file.create_group(f"{index}")


def nc_of_long_attributes(path):
    with _file(path, libver="latest") as file:
        for index in range(100):
            file.attrs[f"{index}"] = np.zeros(100_000)


def nc_of_many_dimensions(path):
    with _file(path) as file:
        file.create_dataset("angle", (9,) * 32, "f8", chunks=(1,) * 32)


def _program(*parts):
    return b"\x80\x02" + b"".join(parts) + b"."


def _text(word):
    return b"X" + struct.pack("<I", len(word)) + word


def _array_state(shape, content, dtype=F8):
    return b"(K\x01" + shape + dtype + b"\x89" + content + b"tb"


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"


def pickle_of_a_nested_shape(path):
    nested = b"K\x01" + b"".join(b"q%ch%c\x86" % (k, k) for k in range(60))
    path.write_bytes(b"\x80\x03" + ARRAY + _array_state(nested, b"C\x01x") + b".")


def pickle_of_long_labels(path):
    labels = b"](" + _text(b"x" * 50_000) + b"q\x00" + b"h\x00" * 20_000 + b"e"
    label_type = b"cnumpy\ndtype\nX\x02\x00\x00\x00O8K\x00K\x01\x87R"
    path.write_bytes(
        b"\x80\x03" + ARRAY + _array_state(b"M\x21\x4e\x85", labels, label_type) + b"."
    )


def pickle_of_fields_set_again(path):
    fields = b"}(" + b"".join(_text(b"%d" % k) + b"K\x00" for k in range(20_000)) + b"uq\x00"
    path.write_bytes(_program(fields, ROLLOUT, b")\x81", b"h\x00b" * 200_000))


def pickle_of_text_encoded_again(path):
    text = _text(b"x" * 1_000_000) + b"q\x00"
    encode = b"c_codecs\nencode\nh\x00" + _text(b"latin1") + b"\x86R"
    path.write_bytes(_program(b"](", text, encode * 3_000, b"e"))


def pickle_of_many_instructions(path):
    path.write_bytes(_program(b"](", b"]" * 5_000_000, b"e"))


def pickle_of_nested_lists(path):
    path.write_bytes(_program(b"]" * 400_000, b"a" * 399_999))


def _rollouts(count, kind, length):
    """Returns a list of the same rollout, whose fields are views of the same bytes."""
    dtype = b"cnumpy\ndtype\n" + _text(kind) + b"K\x00K\x01\x87R"

    def values(rows):
        size = rows * int(kind[1:])
        content = b"B" + struct.pack("<I", size) + (bytes(range(256)) * (size // 256 + 1))[:size]
        return ARRAY + _array_state(b"J" + struct.pack("<i", rows) + b"\x85", content, dtype)

    # A rollout has one more measurement than actions.
    fields = _text(b"time") + values(length) + b"q\x00" + _text(b"observations") + b"h\x00"
    fields += _text(b"actions") + values(length - 1) + b"q\x02" + _text(b"rewards") + b"h\x02"
    rollout = ROLLOUT + b")\x81}(" + fields + b"ubq\x01"
    return b"\x80\x03](" + rollout + b"h\x01" * (count - 1) + b"e."


def pickle_of_the_same_rollout(path):
    path.write_bytes(_rollouts(9_000, b"u1", 100_000))


def pickle_of_almost_too_many_rollouts(path):
    path.write_bytes(_rollouts(10_000, b"u1", 100))


def pickle_of_many_rollouts(path):
    path.write_bytes(_rollouts(300_000, b"u1", 2))


def pickle_of_small_integers(path):
    path.write_bytes(_rollouts(1, b"u1", 30_000_000))


def pickle_of_a_long_number(path):
    number = b"\x8b" + struct.pack("<i", 10_000_000) + b"\x7f" * 10_000_000
    path.write_bytes(b"\x80\x03" + ARRAY + _array_state(number + b"\x85", b"C\x01x") + b".")


def pickle_of_a_huge_array(path):
    shape = b"J\xff\xff\xff\x7fJ\xff\xff\xff\x7f\x86"
    path.write_bytes(b"\x80\x03" + ARRAY + _array_state(shape, b"C\x01x") + b".")


BOMBS = {
    suffix: {name: make for name, make in globals().items() if name.startswith(f"{suffix}_of")}
    for suffix in ("nc", "pickle")
}
