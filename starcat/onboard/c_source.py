"""An onboard image as C99 source, for who links it into a program.

The image is an array of 64-bit words, which a compiler aligns as the image has to be. The words
are those that a machine of the image's byte order has to hold to have the bytes of the image, so
the source is for such machines only; compilers that say their byte order refuse the other one.
"""

from __future__ import annotations

import re

import numpy as np

from starcat.onboard.layout import ByteOrder, in_order

_WORDS_A_LINE = 4


def c_symbol(name: str) -> str:
    """Return the name of the array: that of the database, with ``_`` for what C does not allow."""
    return "starcat_" + re.sub("[^0-9a-z]", "_", name.lower())


def c_header(name: str, size_bytes: int) -> str:
    """Return the header that declares the array."""
    symbol = c_symbol(name)
    guard = f"{symbol.upper()}_H"
    return f"""\
/* The onboard image {name}: starcat_open_image(&image, {symbol}, sizeof {symbol}, 0). */
#ifndef {guard}
#define {guard}

#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

extern const uint64_t {symbol}[{size_bytes // 8}];

#ifdef __cplusplus
}}
#endif
#endif
"""


def c_source(name: str, data: bytes, byte_order: ByteOrder, header_name: str) -> str:
    """Return the source that defines the array."""
    words = [f"0x{word:016X}u" for word in np.frombuffer(data, in_order("u8", byte_order)).tolist()]
    lines = ",\n".join(
        "    " + ", ".join(words[n : n + _WORDS_A_LINE])
        for n in range(0, len(words), _WORDS_A_LINE)
    )
    order = f"__ORDER_{byte_order.upper()}_ENDIAN__"
    return f"""\
/* The onboard image {name}, {len(data)} bytes, for {byte_order}-endian machines. */
#include "{header_name}"

#if defined(__BYTE_ORDER__) && defined({order})
#if __BYTE_ORDER__ != {order}
#error "this onboard image is {byte_order}-endian: export it with the other --endian"
#endif
#endif

const uint64_t {c_symbol(name)}[{len(words)}] = {{
{lines}
}};
"""
