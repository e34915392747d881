"""Streams of zlib that inflate to many zeros."""

import struct
import zlib


def deflated_zeros(num_millions):
    """Returns a stream that inflates to so many million zero bytes: one block, repeated."""
    compressor = zlib.compressobj(9, wbits=-zlib.MAX_WBITS)
    million = compressor.compress(bytes(1_000_000)) + compressor.flush(zlib.Z_FULL_FLUSH)
    checksum = (num_millions * 1_000_000 % 65_521) << 16 | 1  # Adler-32 of zeros
    return b"\x78\xda" + million * num_millions + compressor.flush() + struct.pack(">I", checksum)
