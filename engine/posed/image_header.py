"""Size and kind of a PNG or JPEG without decoding it, and whether the file is whole. Standard library only: Blender's
Python has no OpenCV, which itself fills the missing part of a truncated image with grey instead of failing."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Literal

from ..errors import PlgsError, reading
from ..gates import open_plain, read_plain
from .frames import Size

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB\x60\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_TAIL = 4096
_ORIENTATION = 0x112
_EXIF_LOOKED_AT = 4096  # bytes of a segment searched for the orientation, which is in its first directory
MOST_PIXELS = 160_000_000  # of an image; no camera has more, and decoded, they take half a gigabyte
_MOST_BYTES = 1 << 29


@dataclass(frozen=True)
class ImageHeader:
    """The header of an image. ``palette`` means that its values are indices into a colour table.
    ``orientation`` is a JPEG's EXIF tag: 1 upright, 3 upside down, 6 and 8 on one side."""

    format: Literal["png", "jpeg"]
    width: int
    height: int
    bit_depth: int
    channels: int
    palette: bool = False
    orientation: int = 1

    @property
    def size(self) -> Size:
        return self.width, self.height


def read_image_header(path: Path) -> ImageHeader:
    """Read the header of a PNG or JPEG and check that the file has an end. Raises PlgsError for other files."""
    with reading(path), open_plain(path) as file:
        start = file.read(33)  # a PNG's signature and its whole IHDR
        if start.startswith(_PNG_SIGNATURE):
            header, end = _png_header(start, path), _PNG_END
        elif start.startswith(_JPEG_START):
            header, end = _jpeg_header(file, path), _JPEG_END
        else:
            raise _neither(start, path)
        # A thumbnail in the metadata ends like a JPEG, but comes before the frame header.
        after_header = file.tell()
        file.seek(max(after_header, file.seek(0, 2) - _TAIL))
        tail = file.read()
    # Some cameras append data after a JPEG's end; then the whole file has to be searched.
    if end not in tail and (header.format == "png" or not _jpeg_is_whole(_read(path))):
        raise _truncated(path)
    return header


def check_image_file(path: Path) -> bytes:
    """Return an image's bytes. Raises PlgsError unless it is a whole PNG, with right checksums, or a whole JPEG."""
    data = _read(path)
    check_image_bytes(data, path)
    return data


def _read(path: Path) -> bytes:
    with reading(path):
        return read_plain(path, _MOST_BYTES)


def check_image_bytes(data: bytes, path: Path) -> None:
    """Check that an image's bytes are a whole PNG or JPEG. Raises PlgsError otherwise, for its file ``path``."""
    if data.startswith(_PNG_SIGNATURE):
        _png_header(data[:33], path)
        _check_png_chunks(data, path)
    elif data.startswith(_JPEG_START):
        _jpeg_header(BytesIO(data), path)
        if not _jpeg_is_whole(data):
            raise _truncated(path)
    else:
        raise _neither(data, path)


def _neither(data: bytes, path: Path) -> PlgsError:
    if not data:
        return PlgsError("image-empty", "the image file is empty", path, "Save this image again.")
    return PlgsError("not-png-or-jpeg", "this is neither a PNG nor a JPEG image", path, "Convert it to one of the two.")


def _refuse_vast(width: int, height: int, path: Path) -> None:
    if width * height > MOST_PIXELS:
        what = f"the image claims {width}x{height} pixels, but at most {MOST_PIXELS // 10**6} million are allowed"
        raise PlgsError("image-too-large", what, path, "Make it smaller, or write this file again.")


def _truncated(path: Path) -> PlgsError:
    return PlgsError("image-cut-off", "the image is cut off", path, "Copy or write this file again.")


def _png_header(start: bytes, path: Path) -> ImageHeader:
    if len(start) < 33 or start[12:16] != b"IHDR":
        raise _truncated(path)
    width, height, bit_depth, kind = struct.unpack(">IIBB", start[16:26])
    if kind not in _PNG_CHANNELS or not width or not height:
        raise PlgsError("png-header", "the PNG header is invalid", path, "Save this image again.")
    _refuse_vast(width, height, path)
    return ImageHeader("png", width, height, bit_depth, _PNG_CHANNELS[kind], palette=kind == 3)


def _jpeg_header(file: BinaryIO, path: Path) -> ImageHeader:
    """Read a JPEG's header: walk its marker segments up to the frame header (SOF)."""
    file.seek(2)
    orientation = 1
    while True:
        marker = file.read(2)
        while marker == b"\xff\xff":  # fill bytes may precede a marker
            marker = b"\xff" + file.read(1)
        length_bytes = file.read(2)
        if len(marker) < 2 or len(length_bytes) < 2 or marker[0] != 0xFF:
            raise _truncated(path)
        (length,) = struct.unpack(">H", length_bytes)
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):  # DHT, JPG, DAC: no frame
            body = file.read(6)
            if len(body) < 6:
                raise _truncated(path)
            bit_depth, height, width, channels = struct.unpack(">BHHB", body)
            if not width or not height:
                raise PlgsError("jpeg-header", "the JPEG header is invalid", path, "Save this image again.")
            _refuse_vast(width, height, path)
            return ImageHeader("jpeg", width, height, bit_depth, channels, orientation=orientation)
        if marker[1] == 0xE1:  # APP1: Exif or XMP
            after = file.tell() + length - 2
            orientation = _orientation(file.read(min(length - 2, _EXIF_LOOKED_AT))) or orientation
            file.seek(after)
        else:
            file.seek(length - 2, 1)


def _orientation(segment: bytes) -> int:
    """The orientation 1 to 8 in the Exif segment of a JPEG; 0 without one, or in another segment."""
    order = {b"Exif\0\0II": "<", b"Exif\0\0MM": ">"}.get(segment[:8])
    tiff = segment[6:]
    if order is None or len(tiff) < 8:
        return 0
    (first,) = struct.unpack_from(f"{order}I", tiff, 4)
    count = struct.unpack_from(f"{order}H", tiff, first)[0] if first + 2 <= len(tiff) else 0
    for at in range(first + 2, min(first + 2 + 12 * count, len(tiff) - 11), 12):
        tag, _, _, value = struct.unpack_from(f"{order}HHIH", tiff, at)
        if tag == _ORIENTATION:
            return value if 1 <= value <= 8 else 0
    return 0


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether the end marker comes after the start of the scan (a thumbnail in the metadata has end markers too)."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        if data[position + 1] == 0xFF:
            position += 1
        elif data[position + 1] == 0xDA:  # SOS: the picture, which has no segments to skip
            return data.find(_JPEG_END, position) >= 0
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return False


def _check_png_chunks(data: bytes, path: Path) -> None:
    for chunk in png_chunks(data):
        if zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            raise PlgsError("image-damaged", "the image is damaged (checksum)", path, "Copy or write this file again.")
        if chunk[4:8] == b"IEND":
            return
    raise _truncated(path)


def png_chunks(data: bytes) -> Iterator[bytes]:
    """Yield the complete chunks of a PNG, each as bytes: its length, type, body and checksum."""
    start = len(_PNG_SIGNATURE)
    while (end := start + 12 + int.from_bytes(data[start : start + 4], "big")) <= len(data):
        yield data[start:end]
        start = end
