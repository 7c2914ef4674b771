"""OpenEXR files as Blender writes them, by numpy and zlib alone: Blender's Python need not have a package for them."""

import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x76\x2f\x31\x01"
FORMAT = 2
TILED, DEEP, MULTI_PART = 0x200, 0x800, 0x1000  # flags beside the format's number
CODECS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
ROWS_IN_CHUNK = {"none": 1, "ZIPS": 1, "ZIP": 16}  # of the codecs that are read
NUMBER_TYPES = ("<u4", "<f2", "<f4")
COMPRESSION_LEVEL = 4  # of zlib, as OpenEXR has it

Plane = NDArray[np.float32]


class BadFrame(ValueError):  # noqa: N818 - as of errors.BadInput
    """A frame that cannot be denoised; the message says what to do."""


@dataclass(frozen=True)
class Part:
    """The header of a part of a file, and where its chunks begin."""

    attributes: dict[str, bytes]
    channels: dict[str, np.dtype[Any]]  # in the order in which each row has them
    codec: str
    top: int
    height: int
    width: int
    chunks: NDArray[np.uint64]

    @property
    def row_bytes(self) -> int:
        return self.width * sum(dtype.itemsize for dtype in self.channels.values())


class ExrReader:
    """A file of one or more parts, without tiles. Raises BadFrame where it is incomplete or has another form."""

    def __init__(self, path: Path):
        self.path = path
        self.content = path.read_bytes()
        try:
            self.parts = list(self.read_parts())
        except (struct.error, ValueError, KeyError, IndexError) as error:
            raise self.damaged() if not isinstance(error, BadFrame) else error from None

    def damaged(self) -> BadFrame:
        return BadFrame(f"{self.path} is incomplete or no OpenEXR image: render it again")

    def read_parts(self) -> Iterator[Part]:
        flags = struct.unpack_from("<i", self.content, 4)[0]
        if self.content[:4] != MAGIC or flags & 0xFF != FORMAT:
            raise self.damaged()
        if flags & (TILED | DEEP):
            raise BadFrame(f"{self.path} has tiles or deep pixels: render a multi-layer OpenEXR image")
        self.is_multi_part = bool(flags & MULTI_PART)
        headers, at = [], 8
        while True:
            attributes, at = self.read_attributes(at)
            if attributes:
                headers.append(attributes)
            if not attributes or not self.is_multi_part:
                break
        for attributes in headers:
            part = self.part_of(attributes, at)
            at += part.chunks.nbytes
            yield part
            last = int(part.chunks.max()) + 4 * self.is_multi_part
            end = last + 8 + struct.unpack_from("<i", self.content, last + 4)[0]
            if part.chunks.min() < at or end > len(self.content):  # chunks that were not written are at 0
                raise self.damaged()

    def read_attributes(self, at: int) -> tuple[dict[str, bytes], int]:
        """The attributes of a header by name, and the position after it."""
        attributes = {}
        while self.content[at]:
            name, kind_at = self.text(at)
            _, size_at = self.text(kind_at)
            [size] = struct.unpack_from("<i", self.content, size_at)
            at = size_at + 4 + size
            attributes[name] = self.content[size_at + 4 : at]
        return attributes, at + 1

    def text(self, at: int) -> tuple[str, int]:
        """A text that ends with a zero, and the position after it."""
        end = self.content.index(b"\0", at)
        return self.content[at:end].decode(), end + 1

    def part_of(self, attributes: dict[str, bytes], at: int) -> Part:
        """The part with these attributes, whose table of chunks is `at` this position."""
        codec = CODECS[attributes["compression"][0]]
        if codec not in ROWS_IN_CHUNK:
            raise BadFrame(f"{self.path} has the codec {codec}: choose ZIP in the output properties and render again")
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        height, width = bottom - top + 1, right - left + 1
        count = -(-height // ROWS_IN_CHUNK[codec])
        chunks = np.frombuffer(self.content, "<u8", count, at)
        return Part(attributes, channels_of(attributes["channels"]), codec, top, height, width, chunks)

    def attribute(self, name: str) -> str | None:
        """A text from the header of any part."""
        return next((part.attributes[name].decode() for part in self.parts if name in part.attributes), None)

    @property
    def channels(self) -> list[str]:
        return [name for part in self.parts for name in part.channels]

    def planes(self, names: Iterable[str]) -> dict[str, Plane]:
        """Those channels of the file by name, (H, W) each; other parts are not decoded."""
        wanted = set(names)
        found: dict[str, Plane] = {}
        for part in self.parts:
            if here := wanted & part.channels.keys():
                found |= self.planes_of(part, here)
        return found

    def planes_of(self, part: Part, names: set[str]) -> dict[str, Plane]:
        rows = np.empty((part.height, part.row_bytes), np.uint8)
        try:
            in_parallel(partial(self.decode, part, rows), part.chunks.tolist())
        except (struct.error, zlib.error, ValueError):
            raise self.damaged() from None
        planes = {}
        at = 0
        for name, dtype in part.channels.items():
            after = at + part.width * dtype.itemsize
            if name in names:
                planes[name] = np.ascontiguousarray(rows[:, at:after]).view(dtype).astype(np.float32)
            at = after
        return planes

    def decode(self, part: Part, rows: NDArray[np.uint8], at: int) -> None:
        """Decode the chunk that begins `at` this position into its rows of all (H, bytes)."""
        at += 4 * self.is_multi_part  # the part's number
        y, size = struct.unpack_from("<2i", self.content, at)
        target = rows[y - part.top : y - part.top + ROWS_IN_CHUNK[part.codec]]
        packed = self.content[at + 8 : at + 8 + size]
        is_packed = size < target.size  # what does not become smaller is stored as it is
        values = unpacked(packed) if is_packed else np.frombuffer(packed, np.uint8)
        target[:] = values.reshape(target.shape)


def channels_of(attribute: bytes) -> dict[str, np.dtype[Any]]:
    """Names and number types of a header's channels, in order. Raises ValueError where one is subsampled."""
    channels = {}
    at = 0
    while attribute[at]:
        end = attribute.index(b"\0", at)
        kind, _, x_step, y_step = struct.unpack_from("<4i", attribute, end + 1)
        if (x_step, y_step) != (1, 1):
            raise ValueError("a channel is subsampled")
        channels[attribute[at:end].decode()] = np.dtype(NUMBER_TYPES[kind])
        at = end + 17
    return channels


def in_parallel(task: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """The results in order; zlib works without Python's lock."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(task, items))


def unpacked(packed: bytes) -> NDArray[np.uint8]:
    """The bytes of a chunk: zlib packs differences of neighbours, first those of even places, then of odd ones."""
    steps = np.frombuffer(bytearray(zlib.decompress(packed)), np.uint8)
    steps[1:] -= 128
    values = np.cumsum(steps, dtype=np.uint8)
    half = (len(values) + 1) // 2
    result = np.empty_like(values)
    result[::2], result[1::2] = values[:half], values[half:]
    return result


def packed(values: NDArray[np.uint8]) -> bytes:
    """The inverse of `unpacked`, or the bytes as they are where that is no longer."""
    halves = np.concatenate([values[::2], values[1::2]])
    steps = halves.copy()
    steps[1:] -= halves[:-1]
    steps[1:] += 128
    small = zlib.compress(steps.tobytes(), COMPRESSION_LEVEL)
    return small if len(small) < values.size else values.tobytes()


def write_exr(path: Path, planes: Mapping[str, NDArray[np.floating]], texts: Mapping[str, str]) -> None:
    """Write planes (H, W) of half or single precision by channel, and texts as attributes, with the codec ZIP.

    A reader never gets a part of a file: it appears when it is complete, also in place of another.
    """
    names = sorted(planes)
    height, width = planes[names[0]].shape
    kinds = {name: NUMBER_TYPES.index(planes[name].dtype.str) for name in names}
    channels = b"".join(name.encode() + struct.pack("<x4i", kinds[name], 0, 1, 1) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = [
        ("channels", "chlist", channels),
        ("compression", "compression", bytes([CODECS.index("ZIP")])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
        *((name, "string", text.encode()) for name, text in texts.items()),
    ]
    attributes = (
        struct.pack("<i", len(value)).join([f"{name}\0{kind}\0".encode(), value]) for name, kind, value in header
    )
    head = MAGIC + struct.pack("<i", FORMAT) + b"".join(attributes) + b"\0"
    rows = np.concatenate([np.ascontiguousarray(planes[name]).view(np.uint8) for name in names], axis=1)
    starts = range(0, height, ROWS_IN_CHUNK["ZIP"])
    chunks = in_parallel(lambda y: packed(rows[y : y + ROWS_IN_CHUNK["ZIP"]].ravel()), starts)
    chunks = [struct.pack("<2i", y, len(chunk)) + chunk for y, chunk in zip(starts, chunks, strict=True)]
    sizes = np.array([len(head) + 8 * len(chunks), *map(len, chunks)], "<u8")
    write_whole(path, b"".join([head, np.cumsum(sizes)[:-1].tobytes(), *chunks]))


def write_whole(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
