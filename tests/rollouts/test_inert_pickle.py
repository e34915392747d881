"""Files made to run code, to exhaust memory or to confuse the reader: refused, nothing happens."""

import io
import os
import pickle
import struct
import tracemalloc
from collections import OrderedDict

import joblib
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.io.inert_pickle import Record, read_pickle

RECORD = f"{__name__} Plain"


class Plain:
    """Stands for a class of the program that wrote the file."""

    def __init__(self, **fields):
        self.__dict__.update(fields)


Plain.__module__ = __name__


def written(value, protocol=4, with_joblib=True):
    file = io.BytesIO()
    if with_joblib:
        joblib.dump(value, file, protocol=protocol)
    else:
        pickle.dump(value, file, protocol=protocol)
    return file.getvalue()


@pytest.mark.parametrize("with_joblib", [True, False])
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_arrays_and_records_are_read(protocol, with_joblib):
    """Protocol 5 has instructions for out-of-band arrays that older writers never used."""
    rng = np.random.default_rng(0)
    value = {
        "f8": rng.normal(size=(5, 3)),
        "fortran": np.asfortranarray(rng.normal(size=(4, 2))),
        "big": np.arange(4, dtype=">i4"),
        "bool": np.array([True, False]),
        "empty": np.zeros((0, 3), dtype=np.float32),
        "labels": np.array(["x", "y"], dtype=object),
        "plain": [1, -(2**40), 2.5, None, True, "θ", b"raw", (1, (2,)), OrderedDict(a=1)],
        "scalar": np.float64(3.25),
    }
    data = written(value, protocol, with_joblib)
    if protocol == 5 and not with_joblib:
        with pytest.raises(DataError):
            read_pickle(data, ())
        return
    result = read_pickle(data, ())
    for name in ("f8", "fortran", "big", "bool", "empty"):
        np.testing.assert_array_equal(result[name], value[name])
        assert result[name].dtype == value[name].dtype
    assert result["labels"].tolist() == ["x", "y"] and result["labels"].dtype.kind == "U"
    assert result["plain"] == value["plain"] and result["scalar"] == 3.25


def test_records_have_fields_and_no_behaviour():
    value = Plain(__class__=3, __reduce__="x", array=np.arange(3))
    result = read_pickle(written({"inner": value}), (RECORD,))["inner"]
    assert type(result) is Record and result.kind == RECORD
    assert set(result.fields) == {"__class__", "__reduce__", "array"}
    with pytest.raises(DataError, match="no known record"):
        read_pickle(written(value), ())


class Exploit:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def canary(path):
    raise AssertionError(f"code of the pickle was run: {path}")


def exploits(marker):
    shell = f"touch {marker}"
    return {
        "system": Exploit(os.system, shell),
        "eval": Exploit(eval, f"open({str(marker)!r}, 'w')"),
        "exec": Exploit(exec, f"open({str(marker)!r}, 'w')"),
        "getattr": Exploit(getattr, Plain, "__init__"),
        "open": Exploit(open, str(marker), "w"),
        "nested": [{"a": (1, Exploit(os.system, shell))}],
        "in a record": Plain(state=Exploit(os.system, shell)),
        "object array": np.array([Exploit(os.system, shell), None], dtype=object),
        "numpy load": Exploit(np.load, str(marker)),
        "numpy fromfile": Exploit(np.fromfile, "/etc/passwd"),
        "type": Exploit(type, "X", (object,), {}),
        "import": Exploit(__import__, "antigravity"),
        "own function": Exploit(canary, str(marker)),
    }


@pytest.mark.parametrize("with_joblib", [True, False])
@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("name", exploits(""))
def test_nothing_is_run(name, protocol, with_joblib, tmp_path):
    marker = tmp_path / "executed"
    data = written(exploits(marker)[name], protocol, with_joblib)
    with pytest.raises(DataError) as caught:
        read_pickle(data, (RECORD,))
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")
    assert not marker.exists()


def program(*parts):
    return b"\x80\x02" + b"".join(parts) + b"."


def text(word):
    return b"X" + struct.pack("<I", len(word)) + word.encode()


NDARRAY = b"cnumpy\nndarray\n"
RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
F8 = b"cnumpy\ndtype\n" + text("f8") + b"K\x00K\x01\x87R"
WRAPPER = b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81"
PLAIN = f"c{__name__}\nPlain\n".encode()


def wrapper(shape, dtype=F8, padding=b"N"):
    fields = text("subclass") + NDARRAY + text("shape") + shape + text("order") + text("C")
    fields += text("dtype") + dtype + text("numpy_array_alignment_bytes") + padding
    return program(WRAPPER, b"}(", fields, b"ub")


BAD_PROGRAMS = {
    "empty": b"",
    "not a pickle": b"rollout,time\n0,0\n",
    "unknown global": program(b"cposix\nsystem\n", text("true"), b"\x85R"),
    "stack global": b"\x80\x04" + text("posix") + text("system") + b"\x93.",
    "reduce of a record": program(PLAIN, b")\x81)R"),
    "reduce of a class": program(PLAIN, b")R"),
    "reduce of ndarray": program(NDARRAY, b")R"),
    "reduce of text": program(text("system"), b")R"),
    "reduce of a list": program(b"])R"),
    "reconstruct another class": program(RECONSTRUCT, PLAIN, b"K\x00\x85", b"\x87R"),
    "attributes of a class": program(PLAIN, b"}", text("x"), b"K\x01sb"),
    "attributes of a function": program(RECONSTRUCT, b"}", text("x"), b"K\x01sb"),
    "attributes of a dictionary": program(b"}}", text("update"), b"K\x01sb"),
    "slots": program(PLAIN, b")\x81}}", text("x"), b"K\x01s\x86b"),
    "bytes of a size": program(b"cbuiltins\nbytes\nJ\xff\xff\xff\x7f\x85R"),
    "dictionary of entries": program(b"ccollections\nOrderedDict\n]\x85R"),
    "use before building": program(WRAPPER, b"b"),
    "state that is no dictionary": program(PLAIN, b")\x81K\x01b"),
    "new object of a function": program(b"c_codecs\nencode\n)\x81"),
    "new array": program(NDARRAY, b"(M\xff\xffM\xff\xfft\x85\x81"),
    "other encodings": program(b"c_codecs\nencode\n", text("x"), text("zlib"), b"\x86R"),
    "object dtype": program(b"cnumpy\ndtype\n", text("V8"), b"\x85R"),
    "structured dtype": program(F8, b"(K\x03", text("|"), b"N(t}J\xff\xff\xff\xfftb"),
    "instance": program(b"(iposix\nsystem\n"),
    "object": program(b"(" + PLAIN + b"o"),
    "persistent": program(b"K\x01Q"),
    "extension": program(b"\x82\x01"),
    "new object with keywords": b"\x80\x04" + PLAIN + b")}\x92.",
    "decimal number": program(b"I" + b"9" * 10_000 + b"\n"),
    "memory of nothing": program(b"h\x05"),
    "no mark": program(b"t"),
    "mark as a result": program(b"("),
    "mark in a list": program(b"](a"),
    "underflow": program(b"\x86"),
    "no stop": b"\x80\x02]",
    "huge text": b"\x80\x04\x8d" + struct.pack("<Q", 2**62) + b"x.",
    "huge bytes": b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.",
    "key that takes for ever": program(b"})" + b"2\x86" * 100 + b"K\x01s"),
    "array of terabytes": wrapper(b"J\xff\xff\xff\x7fJ\xff\xff\xff\x7f\x86"),
    "array of negative size": wrapper(b"J\xff\xff\xff\xff\x85"),
    "array of many dimensions": wrapper(b"(" + b"K\x00" * 40 + b"t"),
    "array of fractional size": wrapper(b"G" + struct.pack(">d", 2.0) + b"\x85"),
    "array of boolean size": wrapper(b"\x88\x85"),
    "array without bytes": wrapper(b"K\x02\x85"),
    "array without dtype": wrapper(b"K\x02\x85", b"N"),
    "array padded beyond the end": wrapper(b"K\x02\x85", F8, b"K\x10"),
    "zero size times huge": wrapper(b"K\x00J\xff\xff\xff\x7f\x86", b"N"),
    "nested pickle": wrapper(b"K\x01\x85", F8.replace(b"f8", b"O8")) + b"cposix\nsystem\n)R.",
}


@pytest.mark.parametrize("name", BAD_PROGRAMS)
def test_hand_made_programs_are_refused(name):
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            read_pickle(BAD_PROGRAMS[name], (RECORD,))
        assert tracemalloc.get_traced_memory()[1] < 2**21
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def test_joblib_arrays_need_their_bytes():
    whole = wrapper(b"K\x02\x85")[:-1] + struct.pack("<2d", 1.5, 2.5) + b"."
    assert read_pickle(whole, ()).tolist() == [1.5, 2.5]


GOOD = written({"a": np.arange(6.0).reshape(2, 3), "b": [Plain(x=1), "text"]}, 3)


def test_truncated_files():
    for end in range(len(GOOD)):
        with pytest.raises(DataError):
            read_pickle(GOOD[:end], (RECORD,))


@settings(max_examples=300, deadline=None)
@example(edits=[(15, 92)])  # a bad escape, about which the standard library warns
@given(edits=st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), max_size=8))
def test_damaged_files_are_read_or_refused(edits):
    damaged = bytearray(GOOD)
    for position, value in edits:
        damaged[position] = value
    try:
        read_pickle(bytes(damaged), (RECORD,))
    except DataError as error:
        assert "\n" not in str(error)
