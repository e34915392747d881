"""Reads MCAP files, and the bags of ROS 2 in both of their formats, SQLite and MCAP.

Files are decompressed piece by piece, with limits. A database is opened read-only, and only its
two tables of topics and messages are read.
"""

import io
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import msgspec

from npdr_ppl.errors import DataError, DependencyError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.folders import files_in
from npdr_ppl.rollouts.logs.formats.messages import Messages
from npdr_ppl.rollouts.logs.formats.ros_messages import (
    MAX_VALUES,
    Definitions,
    Layout,
    TooManyValuesError,
    decode,
    definitions,
    layout,
    short_name,
)
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["read_bag_folder", "read_db3_log", "read_mcap_log"]

Decoder = Callable[[bytes], tuple[Any, int]]
"""Returns the fields of a message, and how many values were read."""

MAX_LAYOUTS = 8
"""Layouts that are made for a topic. The messages of a robot's state have the same one all along;
those with text that changes have a new one each, which is of no use."""

INSTALL = "install the readers of ROS bags with pip install npdr-ppl[logs]."

BYTES_OF_JSON = 4
"""Bytes of JSON text that count as one value; the work of reading a message is counted by this."""

MAX_TYPES = 500
"""Largest count of message types in a log."""

MAX_WINDOW = 2**27
"""Largest memory in bytes that decompression of a chunk may use for itself."""

STEPS_PER_CALL = 100_000
"""Instructions of SQLite between two looks at their number; a row takes about ten."""

BYTES_PER_CALL = 10_000
"""Bytes of a file that allow one more look; a thousand rows take more. In a damaged file the pages
of a table can form a circle, which would be read for ever."""


def read_mcap_log(path: Path, settings: LogSettings) -> Log:
    """Reads an MCAP file with messages of ROS 2, or in JSON.

    Args:
        path: The file.
        settings: How to read it.

    Raises:
        DataError: It is damaged, or has no readable messages.
        DependencyError: The package ``mcap`` is not installed.
    """
    messages = Messages(path.stat().st_size)
    _add_mcap(path, messages)
    return messages.log(path.name, use_stamps=settings.time != "log")


def read_db3_log(path: Path, settings: LogSettings) -> Log:
    """Reads a SQLite file of a ROS 2 bag."""
    messages = Messages(path.stat().st_size)
    _add_db3(path, messages)
    return messages.log(path.name, use_stamps=settings.time != "log")


def read_bag_folder(path: Path, settings: LogSettings) -> Log:
    """Reads all files of a ROS 2 bag, in the order of their names."""
    files = [*files_in(path, ".db3"), *files_in(path, ".mcap")]
    if not files:
        compressed = [f.name for f in path.iterdir() if f.suffix == ".zstd"]
        raise DataError(
            "its files are compressed; run `ros2 bag convert` to store them without compression."
            if compressed
            else "the bag has no .db3 or .mcap files."
        )
    messages = Messages(sum(file.stat().st_size for file in files))
    for file in files:
        rollout_checks.check_file(file)
        with rollout_checks.named(file):
            (_add_db3 if file.suffix.lower() == ".db3" else _add_mcap)(file, messages)
    return messages.log(path.name, use_stamps=settings.time != "log")


# -- Messages --------------------------------------------------------------------------------


@dataclass
class _Topic:
    """A topic of a log.

    Attributes:
        name: Its name.
        kind: Name of the type of its messages.
        decoder: Reads a message; ``None`` if its messages are not read.
        layout: The layout of the latest message, if it has one.
        num_layouts: How many layouts were made.
    """

    name: str
    kind: str
    decoder: Decoder | None
    layout: Layout | None = None
    num_layouts: int = 0


@dataclass(frozen=True)
class _CdrDecoder:
    """Reads messages in CDR of one type."""

    name: str
    types: Definitions

    def __call__(self, data: bytes) -> tuple[Any, int]:
        return decode(data, self.name, self.types)

    def layout(self, data: bytes) -> Layout:
        return layout(data, self.name, self.types)


class _Topics:
    """Makes the topics of a log; those with messages of the same type share a decoder."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._known: dict[tuple[str, str, str, bytes], Decoder | None] = {}

    def make(self, name: str, encoding: str, kind: str, schema: str, text: bytes) -> _Topic:
        """Returns a topic.

        Args:
            name: Its name.
            encoding: How messages are encoded, ``"cdr"`` or ``"json"``.
            kind: Name of their type.
            schema: Language of its definition, ``"ros2msg"``.
            text: Its definition; empty for a type that comes with ROS.
        """
        if len(name) > 200 or not name.isprintable():
            raise DataError(f"a topic is called {rollout_checks.shown(name)}.")
        key = (encoding, kind, schema, text)
        if key not in self._known:
            if len(self._known) >= MAX_TYPES:
                raise DataError(f"it has more than {MAX_TYPES} types of messages.")
            self._known[key] = self._made(encoding, kind, schema, text)
        found = self._known[key]
        if found is None:
            self._messages.remark(
                f"{rollout_checks.shown(name)} was left out: messages of the type "
                f"{rollout_checks.shown(kind)} in {rollout_checks.shown(encoding)} are not read."
            )
        return _Topic(name.rstrip("/"), kind, found)

    def _made(self, encoding: str, kind: str, schema: str, text: bytes) -> Decoder | None:
        if encoding == "json":
            read = msgspec.json.Decoder().decode
            return lambda data: (read(data), len(data) // BYTES_OF_JSON)
        if encoding != "cdr" or schema != "ros2msg":
            return None
        if len(text) > LIMITS.text_bytes:
            raise DataError("the definition of a message is too long.")
        written = text.decode(errors="replace") if text.strip() else _standard(kind)
        if written is None:
            return None
        return _CdrDecoder(short_name(kind), definitions(kind, written))


def _standard(kind: str) -> str | None:
    """Returns the definition of a type that comes with ROS, ``None`` if it is another one."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DependencyError(
            f"A bag that does not define its messages needs the package rosbags; {INSTALL}"
        ) from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    return store.generate_msgdef(kind, ros_version=2)[0] if kind in store.fielddefs else None


def _add(messages: Messages, topic: _Topic, nanoseconds: int, data: bytes) -> None:
    """Adds a message, unless messages of its topic are not read."""
    if topic.decoder is None:
        messages.charge(1)
        return
    if topic.layout is not None and (numbers := topic.layout.numbers(data)) is not None:
        messages.charge(1 + topic.layout.count)
        messages.add_alike(topic.name, nanoseconds, topic.layout, numbers)
        return
    try:
        message, count = topic.decoder(data)
    except TooManyValuesError:
        topic.decoder = None
        messages.remark(
            f"{rollout_checks.shown(topic.name)} was left out: a message has more than "
            f"{MAX_VALUES} values."
        )
        return
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise DataError(
            f"a message of {rollout_checks.shown(topic.name)} is not valid JSON."
        ) from None
    messages.charge(1 + count)
    messages.add(topic.name, topic.kind, nanoseconds, message)
    if isinstance(topic.decoder, _CdrDecoder) and topic.num_layouts < MAX_LAYOUTS:
        topic.layout = topic.decoder.layout(data)
        topic.num_layouts += 1


# -- MCAP ------------------------------------------------------------------------------------


def _add_mcap(path: Path, messages: Messages) -> None:
    """Adds the messages of an MCAP file, also of one whose end is missing."""
    try:
        from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader
    except ImportError:
        raise DependencyError(f"MCAP files need the package mcap; {INSTALL}") from None
    size = path.stat().st_size
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    makes = _Topics(messages)
    topics: dict[int, _Topic] = {}
    total = 0

    def take(record: Any) -> None:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
            topics.pop(record.id, None)
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic is None:
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise DataError("a message belongs to no channel.")
                schema = schemas.get(channel.schema_id)
                kind, language = (schema.name, schema.encoding) if schema else ("", "")
                text = schema.data if schema else b""
                encoding = channel.message_encoding
                topic = makes.make(channel.topic, encoding, kind, language, text)
                topics[record.channel_id] = topic
            _add(messages, topic, record.log_time, record.data)
        if len(schemas) > LIMITS.parts or len(channels) > LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} channels.")

    with path.open("rb") as file:
        whole: Any = _WholeReads(file)
        reader = StreamReader(whole, emit_chunks=True, record_size_limit=size)
        try:
            for record in reader.records:
                if not isinstance(record, Chunk):
                    take(record)
                    continue
                data = _decompressed(record, size)
                total += len(data)
                # Chunks come one after another, so this bounds the time and not the memory.
                if total > max(LIMITS.free_bytes, LIMITS.expansion * size):
                    raise DataError("its chunks decompress to much more than such a log holds.")
                for inner in _records(data):
                    take(inner)
        except (EndOfFile, RecordLengthLimitExceeded):
            messages.fault("the file ends in the middle; what comes before was read.")


class _WholeReads:
    """A file that raises ``EndOfFile`` instead of returning fewer bytes than were asked for."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, length: int) -> bytes:
        """Reads exactly so many bytes."""
        from mcap.exceptions import EndOfFile

        data = self._file.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _records(data: bytes) -> Iterator[Any]:
    """Yields the schemas, channels and messages in a decompressed chunk."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    position = others = 0
    while position + 9 <= len(data):
        opcode, length = (
            data[position],
            int.from_bytes(data[position + 1 : position + 9], "little"),
        )
        position += 9
        if position + length > len(data):
            raise DataError("a chunk ends within a record.")
        stream = ReadDataStream(io.BytesIO(data[position : position + length]))
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            others += 1
            if others > LIMITS.parts:
                raise DataError(f"a chunk has more than {LIMITS.parts} unknown records.")
        position += length


def _decompressed(chunk: Any, file_bytes: int) -> bytes:
    """Returns the content of a chunk, after checking its size.

    Raises:
        DataError: It is too large, of another size than stated, or compressed in an unknown way.
    """
    size = chunk.uncompressed_size
    check_expansion(size, file_bytes)
    if chunk.compression == "":
        data = chunk.data
    elif chunk.compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        with decompressor.stream_reader(io.BytesIO(chunk.data)) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise DataError(
            f"a chunk is compressed by {rollout_checks.shown(chunk.compression)}, which is not "
            "read."
        )
    if len(data) != size:
        raise DataError("a chunk has another size than it states.")
    return data


# -- SQLite ----------------------------------------------------------------------------------

_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
    "message_definitions": ("topic_type", "encoding", "encoded_message_definition"),
}


def _add_db3(path: Path, messages: Messages) -> None:
    """Adds the messages of a SQLite file."""
    if path.stat().st_size >= 18:
        with path.open("rb") as file:
            head = file.read(20)
        if head[:16] != b"SQLite format 3\0":
            raise DataError("it is not a SQLite file.")
    # Immutable: no journal beside the file is looked for, and nothing is locked or written.
    address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    connection = sqlite3.connect(address, uri=True, isolation_level=None)
    try:
        _restrict(connection, path.stat().st_size)
        tables = _tables(connection)
        for needed in ("topics", "messages"):
            if needed not in tables:
                raise DataError(f"it has no table {needed}, so it is no bag of ROS 2.")
        _add_rows(connection, messages, tables, path.stat().st_size)
    except (sqlite3.Error, sqlite3.Warning) as error:
        raise DataError(f"not a readable ROS bag ({type(error).__name__}).") from None
    finally:
        connection.close()


def _restrict(connection: sqlite3.Connection, size: int) -> None:
    """Lets a connection read plain columns of plain tables only, in bounded steps."""
    connection.execute("PRAGMA trusted_schema=OFF")
    connection.execute("PRAGMA cell_size_check=ON")
    connection.execute("PRAGMA mmap_size=0")
    connection.execute("PRAGMA temp_store=MEMORY")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, 10_000))
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    connection.text_factory = lambda raw: raw.decode(errors="replace")
    allowed = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)

    def authorize(action: int, *_: object) -> int:
        # Views, triggers and functions of the file's own could compute anything.
        return sqlite3.SQLITE_OK if action in allowed else sqlite3.SQLITE_DENY

    left = iter(range(20 + size // BYTES_PER_CALL))
    connection.set_authorizer(authorize)
    connection.set_progress_handler(lambda: next(left, None) is None, STEPS_PER_CALL)


def _tables(connection: sqlite3.Connection) -> set[str]:
    """Returns the names of the plain tables that are read."""
    found = set()
    query = "SELECT type, name, sql FROM sqlite_master"
    for number, (kind, name, text) in enumerate(connection.execute(query)):
        if number > LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} tables.")
        words = str(text).upper().split()
        if kind == "table" and name in _COLUMNS:
            if words[:2] != ["CREATE", "TABLE"] or "GENERATED" in words or "AS" in words:
                raise DataError(f"its table {name} is not a plain one.")
            found.add(name)
    return found


def _rows(connection: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:
    """Yields the rows of a table in the order of the file."""
    return connection.execute(f"SELECT {', '.join(_COLUMNS[table])} FROM {table}")


def _add_rows(
    connection: sqlite3.Connection, messages: Messages, tables: set[str], size: int
) -> None:
    texts: dict[str, tuple[str, bytes]] = {}
    if "message_definitions" in tables:
        for kind, language, text in _rows(connection, "message_definitions"):
            if len(texts) >= MAX_TYPES:
                raise DataError(f"it has more than {MAX_TYPES} types of messages.")
            if language == "ros2msg" and isinstance(text, str):
                texts[str(kind)] = ("ros2msg", text.encode(errors="replace"))
    makes = _Topics(messages)
    topics: dict[int, _Topic] = {}
    for number, name, kind, encoding in _rows(connection, "topics"):
        if len(topics) >= LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} topics.")
        language, text = texts.get(str(kind), ("ros2msg", b""))
        topics[number] = makes.make(str(name), str(encoding), str(kind), language, text)
    for _, number, nanoseconds, data in _rows(connection, "messages"):
        topic = topics.get(number)
        if topic is None or type(nanoseconds) is not int or not isinstance(data, bytes):
            raise DataError("a row of its messages is damaged.")
        size -= len(data)
        if size < 0:
            raise DataError("its messages have more bytes than the file.")
        _add(messages, topic, nanoseconds, data)
