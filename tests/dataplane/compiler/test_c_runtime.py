"""Hashes of the C runtime are those of other implementations, whatever the length of the data."""

import zlib
from importlib.resources import files

from dataplane.compiler.c_build import compiled_library


def test_crc32_of_every_length():
    types = files("dataplane.compiler").joinpath("runtime_types.h").read_text()
    wrapper = "u64 crc_of(const u8 *d, u64 n) { hashes_start(); return hash_crc32(d, n); }"
    text = f"{types}\n{wrapper}"
    _, library = compiled_library(text, "uint64_t crc_of(const char *d, uint64_t n);")
    data = bytes(n * 37 & 255 for n in range(100))
    for first in range(3):
        for end in range(first, len(data)):
            assert library.crc_of(data[first:end], end - first) == zlib.crc32(data[first:end])
