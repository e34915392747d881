"""Small logs that describe much, or lead out of their folder; each writes one file or folder."""

import json
import sqlite3
import struct

import numpy as np

from tests.helpers.deflated import deflated_zeros


def csv_of_a_long_vector(path):
    path.write_bytes(b't,x\n0,"[' + b"0," * 100_000 + b'0]"\n' * 1)


def csv_of_many_vectors(path):
    row = b'%d,"[' + b"0," * 900 + b'0]"\n'
    path.write_bytes(b"t,x\n" + b"".join(row % k for k in range(10_000)))


def csv_of_long_brackets(path):
    path.write_bytes(b"t,x\n" + b"".join(b"%d,[%s\n" % (k, b"1 " * 50_000) for k in range(50)))


def csv_of_many_columns(path):
    path.write_bytes(b"t" + b",x" * 200_000 + b"\n")


def parquet_of_long_lists(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    lists = pa.FixedSizeListArray.from_arrays(np.zeros(20_000_000), 100_000)
    pq.write_table(pa.table({"t": np.arange(200.0), "x": lists}), path)


def h5_of_a_huge_shape(path):
    import h5py

    with h5py.File(path, "w") as file:
        file["t"] = np.arange(9.0)
        file.create_dataset("x", (9, 10**9), "f8", chunks=(1, 1000), compression="gzip")


def _tag(kind, body):
    return struct.pack("<II", kind, len(body)) + body + b"\0" * (-len(body) % 8)


def _matrix(code, shape, name, rest):
    head = _tag(6, struct.pack("<II", code, 0)) + _tag(5, struct.pack(f"<{len(shape)}i", *shape))
    return _tag(14, head + _tag(1, name) + rest)


def _mat(path, *elements):
    path.write_bytes(
        b"MATLAB 5.0".ljust(124) + struct.pack("<H", 0x100) + b"IM" + b"".join(elements)
    )


def _packed(body):
    return struct.pack("<II", 15, len(body)) + body


def mat_that_inflates(path):
    _mat(path, _packed(deflated_zeros(300)))


def mat_that_inflates_often(path):
    _mat(path, *[_packed(deflated_zeros(5))] * 100)


def mat_of_a_huge_struct(path):
    rest = _tag(5, struct.pack("<i", 8)) + _tag(1, b"field\0\0\0" * 4)
    _mat(path, _matrix(2, (2**31 - 1, 2**31 - 1), b"s", rest))


def mat_of_a_huge_shape(path):
    _mat(path, _matrix(6, (2**31 - 1, 2**31 - 1), b"x", _tag(9, b"\0" * 8)))


def mat_of_deep_structs(path):
    body = _matrix(6, (1, 1), b"", _tag(9, b"\0" * 8))
    for _ in range(2000):
        rest = _tag(5, struct.pack("<i", 8)) + _tag(1, b"field\0\0\0") + body
        body = _matrix(2, (1, 1), b"", rest)
    _mat(path, body)


def mat_of_many_variables(path):
    _mat(path, *[_matrix(6, (1, 1), b"x%d" % k, _tag(9, b"\0" * 8)) for k in range(50_000)])


def _mcap(path, definition, data, *, count=1, kind="a/B", encoding="cdr", topics=1):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        for topic in range(topics):
            channel = writer.register_channel(f"/t{topic}", encoding, schema)
            for index in range(count):
                writer.add_message(channel, index, data, index)
        writer.finish()


HEAD = b"\0\1\0\0"


def mcap_of_a_long_sequence(path):
    _mcap(path, "a/E[] x\n" + "=" * 80 + "\nMSG: a/E\n", HEAD + struct.pack("<I", 2**32 - 1))


def mcap_of_a_huge_array(path):
    _mcap(path, "float64[99999999999999] x", HEAD + b"\0" * 64)


def mcap_of_types_that_contain_each_other(path):
    _mcap(path, "a/B x\n", HEAD + b"\0" * 64)


def mcap_of_types_that_grow(path):
    parts = [f"a/C{k + 1}[9] x\n" + "=" * 80 + f"\nMSG: a/C{k + 1}\n" for k in range(12)]
    _mcap(path, "".join(parts) + "uint8 x\n", HEAD + b"\0" * 1_000_000)


def mcap_of_many_numbers(path):
    _mcap(path, "uint8[100] x", HEAD + b"\0" * 100, count=12_000)


def mcap_of_many_topics(path):
    _mcap(path, "uint8 x", HEAD + b"\0", topics=20_000)


def mcap_of_deep_json(path):
    _mcap(path, "", b"[" * 200_000 + b"]" * 200_000, encoding="json")


def mcap_of_wide_json(path):
    text = json.dumps({f"x{k}": 0 for k in range(100_000)}).encode()
    _mcap(path, "", text, encoding="json", count=5)


def _chunk(compression, size, data):
    word = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(word)) + word
    body += struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


MAGIC = b"\x89MCAP0\r\n"


def mcap_that_inflates_by_zstd(path):
    import zstandard

    data = zstandard.ZstdCompressor().compress(b"\0" * 300_000_000)
    path.write_bytes(MAGIC + _chunk("zstd", 300_000_000, data) + _chunk("zstd", 100, data))


def mcap_that_inflates_more_than_it_says(path):
    import zstandard

    data = zstandard.ZstdCompressor().compress(b"\0" * 300_000_000)
    path.write_bytes(MAGIC + _chunk("zstd", 100, data))


def mcap_that_inflates_by_lz4(path):
    import lz4.frame

    data = lz4.frame.compress(b"\0" * 300_000_000)
    path.write_bytes(MAGIC + _chunk("lz4", 100, data))


def mcap_of_many_chunks(path):
    import zstandard

    data = zstandard.ZstdCompressor().compress(b"\0" * 50_000_000)
    path.write_bytes(MAGIC + _chunk("zstd", 50_000_000, data) * 100)


def mcap_of_a_long_record(path):
    path.write_bytes(MAGIC + b"\x05" + struct.pack("<Q", 2**62) + b"\0" * 100)


TOPICS = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)"
MESSAGES = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"


def _db3(path, *statements):
    connection = sqlite3.connect(path)
    for statement in (TOPICS, *statements):
        connection.execute(statement)
    connection.execute("INSERT INTO topics VALUES (1, '/x', 'std_msgs/msg/Float64', 'cdr')")
    connection.commit()
    connection.close()


ENDLESS = (
    "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) "
    "SELECT k AS id, 1 AS topic_id, k AS timestamp, zeroblob(9) AS data FROM n"
)


def db3_of_an_endless_view(path):
    _db3(path, f"CREATE VIEW messages AS {ENDLESS}")


def db3_of_a_computed_column(path):
    _db3(
        path,
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, "
        "data AS (zeroblob(900000000)))",
        "INSERT INTO messages VALUES (1, 1, 1)",
    )


def db3_of_many_rows(path):
    rows = (
        "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < 300000) "
        "INSERT INTO messages SELECT k, 1, k, x'000100000000000000000000' FROM n"
    )
    _db3(path, MESSAGES, rows)


def db3_with_a_journal(path):
    _db3(path, MESSAGES, "INSERT INTO messages VALUES (1, 1, 1, x'0001000000000000')")
    path.with_name(path.name + "-journal").write_bytes(b"\xd9\xd5\x05\xf9 \xa1c\xd7" + b"\0" * 600)


def lerobot_of_a_link(path):
    (path / "meta").mkdir(parents=True)
    (path / "data" / "chunk-000").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "features": {}}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    (path / "data" / "chunk-000" / "file-000.parquet").symlink_to("/etc/hostname")
    (path / "data" / "chunk-001").symlink_to("/")


def lerobot_of_deep_json(path):
    (path / "meta").mkdir(parents=True)
    (path / "meta" / "info.json").write_text('{"features":' + "[" * 500_000)


def folder_of_a_link(path):
    path.mkdir()
    (path / "x.csv").symlink_to("/etc/passwd")


def toml_of_many_tables(path):
    path.write_text("".join(f"[channels.x{k}]\nsignal='a'\n" for k in range(8_000)))


def toml_of_deep_tables(path):
    path.write_text("[" + ".".join("a" * 50_000) + "]\n")


def _named(prefix):
    return {n: f for n, f in globals().items() if n.startswith(f"{prefix}_")}


BOMBS = {
    "log_csv": _named("csv"),
    "log_parquet": _named("parquet"),
    **{kind: _named(kind) for kind in ("h5", "mat", "mcap", "db3", "lerobot", "folder", "toml")},
}
