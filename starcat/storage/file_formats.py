"""Names of file formats that starcat does not read, for messages about files of users."""

from __future__ import annotations

from pathlib import Path

_BEGINNINGS: tuple[tuple[int, bytes, str], ...] = (
    (0, b"GIF8", "a GIF image"),
    (8, b"WEBP", "a WebP image"),
    (8, b"AVI ", "an AVI video"),
    (8, b"WAVE", "a WAVE sound"),
    (4, b"ftypavif", "an AVIF image"),
    (4, b"ftypcrx ", "a raw image of Canon (CR3)"),
    (4, b"ftyp", "an MP4 or QuickTime video"),
    (4, b"jP  \r\n", "a JPEG 2000 image"),
    (0, b"\xff\x4f\xff\x51", "a JPEG 2000 image"),
    (4, b"JXL \r\n", "a JPEG XL image"),
    (0, b"\xff\x0a", "a JPEG XL image"),
    (8, b"CR\x02", "a raw image of Canon (CR2)"),
    (0, b"IIU\0", "a raw image of Panasonic (RW2)"),
    (0, b"IIRO", "a raw image of Olympus (ORF)"),
    (0, b"IIRS", "a raw image of Olympus (ORF)"),
    (0, b"FUJIFILMCCD-RAW", "a raw image of Fujifilm (RAF)"),
    (0, b"XISF0100", "an XISF image"),
    (0, b"LUCAM-RECORDER", "an SER video"),
    (0, b"8BPS", "a Photoshop image"),
    (0, b"gimp xcf", "a GIMP image"),
    (0, b"v/1\x01", "an OpenEXR image"),
    (0, b"qoif", "a QOI image"),
    (0, b"P5", "a PGM image"),
    (0, b"P6", "a PPM image"),
    (0, b"\0\0\x01\0", "an icon (ICO)"),
    (0, b"%PDF", "a PDF document"),
    (0, b"PK", "a ZIP archive"),
    (0, b"PAR1", "a Parquet file"),
    (0, b"\x89HDF", "an HDF5 file"),
)
"""Offset, bytes at this offset, and name; the first match counts."""

RAW_MAKERS = {
    ".nef": "Nikon", ".nrw": "Nikon", ".cr2": "Canon", ".cr3": "Canon", ".arw": "Sony",
    ".dng": "Adobe", ".orf": "Olympus", ".rw2": "Panasonic", ".raf": "Fujifilm",
    ".pef": "Pentax",
}  # fmt: skip
"""Makers of raw images by file suffix: the contents of most begin like TIFF images."""


def unread_format(path: Path, data: bytes) -> str | None:
    """Return the format of a file that starcat does not read, with its article; None if unknown.

    Examples
    --------
    >>> unread_format(Path("a.png"), b"RIFF0000WEBPVP8 "), unread_format(Path("a.NEF"), b"MM")
    ('a WebP image', 'a raw image of Nikon (NEF)')
    """
    suffix = path.suffix.lower()
    if suffix in RAW_MAKERS:
        return f"a raw image of {RAW_MAKERS[suffix]} ({suffix[1:].upper()})"
    for offset, beginning, name in _BEGINNINGS:
        if data[offset : offset + len(beginning)] == beginning:
            return name
    return None
