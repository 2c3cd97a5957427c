"""An onboard image as C99 source, for programs that link it in.

The image is an array of 64-bit words, so that a compiler gives it the right alignment. The words
have the bytes of the image only on a machine of the image's byte order, so the source is only for
such machines; compilers that define their byte order refuse the other one.
"""

from __future__ import annotations

import re
from dataclasses import asdict

import numpy as np

from starcat.database.onboard.layout import ByteOrder, in_order
from starcat.geometry.camera import Camera

_WORDS_A_LINE = 4


def c_symbol(name: str) -> str:
    """Return the name of the array: the database's name, with ``_`` for invalid characters."""
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


def c_camera(name: str, camera: Camera) -> str:
    """Return the header that defines a calibrated camera for the library."""
    symbol = f"{c_symbol(name)}_camera"
    lens, (x0_px, y0_px) = camera.distortion, camera.principal_point_px
    values = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "focal_length_px": camera.focal_length_px,
        "x0_px": x0_px,
        "y0_px": y0_px,
        **asdict(lens),
        "fold_radius": 0.0 if lens.is_none else lens.fold_radius,
    }
    lines = [f"    (starcat_real){float(value)!r}, /* {key} */" for key, value in values.items()]
    numbers = "\n".join(lines)
    return f"""\
/* The calibrated camera for {name}, in place of that of starcat_get_camera: camera = {symbol}; */
#ifndef {symbol.upper()}_H
#define {symbol.upper()}_H

#include "starcat.h"

static const starcat_camera {symbol} = {{
{numbers}
}};

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
