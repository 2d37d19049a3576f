"""Gaussian PLY files (3DGS and 2DGS): read by property name, kept rows written back byte for byte.

Our own reader, as rows and header lines must come back as they were; why not plyfile: docs/developing.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import BadInput, refusing
from ..files import require_file, write_atomically
from ..gaussians import Gaussians, pad_sh

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PROPERTY_WORDS = {**dict.fromkeys(TYPES, 3), "list": 5}  # of a property's line, by its type
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
CACHED_ROWS = 1 << 12
MAX_HEADER = 1 << 20  # bytes; a longer header is not a PLY's
Body = tuple[bytes, np.ndarray, bytes]  # before the vertices, their rows, and behind them
ANTIALIASED = re.compile(r"SplatRenderMode:\s*mip\b|\bantialiased\s+1\b", re.IGNORECASE)


@dataclass(frozen=True)
class PlyTable:
    """A PLY file as it lies on disk: header lines and the vertex rows verbatim."""

    header: tuple[str, ...]  # every line but `end_header`, without line ends
    line_end: str
    format: str  # ascii | binary_little_endian | binary_big_endian
    properties: dict[str, str]  # of the vertices: name → type as written in the header
    rows: np.ndarray  # [N] void records of one row's bytes; ASCII: [N] object array of lines, as bytes
    before: bytes = b""  # the body of elements in front of the vertices, verbatim
    after: bytes = b""  # and behind them

    @property
    def comments(self) -> tuple[str, ...]:
        return tuple(h.split(" ", 1)[1] for h in self.header if h.startswith("comment "))

    @property
    def dtype(self) -> np.dtype:
        """The record type of a row in the file's byte order."""
        return np.dtype([(n, BYTE_ORDERS[self.format] + TYPES[kind]) for n, kind in self.properties.items()])


@dataclass(frozen=True)
class SplatFile:
    """A scene and the file it came from."""

    gaussians: Gaussians  # in float32, with quaternions as they are
    table: PlyTable  # the file's rows as they are, for `write_ply`


def read_ply(path: Path | str) -> SplatFile:
    """Read a Gaussian PLY (3DGS or 2DGS), by the names of its properties.

    Raises
    ------
    BadInput
        If the file is missing, damaged, or not a Gaussian scene, saying which.

    Examples
    --------
    >>> file = read_ply("scene.ply")
    >>> file.gaussians.means.dtype, file.gaussians.sh.shape[1:]
    (dtype('float32'), (1, 3))
    """
    head, elements, start = header_of(Path(path))
    names = [e.name for e in elements]
    if "chunk" in names or any(n.startswith("packed_") for e in elements for n in e.properties):
        raise BadInput(f"{path} is a PlayCanvas compressed PLY; convert it with gimp3d convert first")
    if names.count("vertex") != 1:
        raise BadInput(f"{path}: a PLY with one vertex element expected, found {names.count('vertex')}")
    vertex = elements[names.index("vertex")]
    if "list" in vertex.properties.values():
        raise BadInput(f"{path}: the vertex element has a list property; that is not a Gaussian scene")
    if vertex.count and not any(n.startswith("f_dc_") for n in vertex.properties):
        what = "it has plain colours (red, green, blue)" if "red" in vertex.properties else "a mesh or a point cloud"
        raise BadInput(f"{path} is not a Gaussian scene: no property f_dc_0, {what}")
    read = _read_ascii if head.format == "ascii" else _read_binary
    before, rows, after = read(Path(path), elements, names.index("vertex"), start)
    table = replace(head, properties=vertex.properties, rows=rows, before=before, after=after)
    return SplatFile(gaussians_of(table, path), table)


def write_ply(
    path: Path | str,
    file: SplatFile,
    keep: np.ndarray,  # [N] bool
    added: Gaussians | None = None,
) -> None:
    """Write the kept rows byte for byte in their order, then new ones in the same properties, format and types.

    Properties that a Gaussian does not have (normals, extras) are 0 in new rows. Written atomically.

    Raises
    ------
    BadInput
        If the file cannot be written.
    ValueError
        If a new Gaussian is not finite, or `keep` is not a bool for each row.

    Examples
    --------
    >>> file = read_ply("scene.ply")
    >>> write_ply("upper.ply", file, keep=file.gaussians.means[:, 2] > 0.1)
    >>> len(read_ply("upper.ply").gaussians) < len(file.gaussians)
    True
    """
    if keep.shape != (len(file.table.rows),) or keep.dtype != bool:
        raise ValueError(f"keep: {len(file.table.rows)} bools expected, got {keep.dtype} {keep.shape}")
    table = file.table
    new = np.zeros(0, table.dtype) if added is None else new_rows(table, added)
    for name in new.dtype.names or ():
        if not np.isfinite(new[name]).all():
            raise ValueError(f"a new Gaussian has a {name} that is not finite")
    count = f"element vertex {keep.sum() + len(new)}"
    lines = [count if h.split()[:2] == ["element", "vertex"] else h for h in table.header]
    header = table.line_end.join([*lines, "end_header", ""]).encode("latin-1")
    kept = table.rows if keep.all() else table.rows[keep]

    def write(f):  # type: ignore[no-untyped-def]
        f.write(header)
        f.write(table.before)
        if table.format == "ascii":
            f.write(b"".join(line + table.line_end.encode() for line in (*kept, *ascii_rows(new))))
        else:
            f.write(np.ascontiguousarray(kept).view(np.uint8))
            f.write(new.tobytes())
        f.write(table.after)

    write_atomically(Path(path), write)


def write_gaussians(path: Path | str, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write a fresh binary PLY in Inria's layout."""
    write_ply(path, file_of(gaussians, comments), np.ones(len(gaussians), bool))


def file_of(gaussians: Gaussians, comments: Sequence[str] = ()) -> SplatFile:
    """The Gaussians as a binary PLY in Inria's layout, as if it had been read."""
    bands = gaussians.sh.shape[1]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(3 * (bands - 1))] + ["opacity"]
    names += [f"scale_{k}" for k in range(gaussians.log_scales.shape[1])] + [f"rot_{k}" for k in range(4)]
    comments = [*comments, *(["antialiased 1"] if gaussians.antialiased else [])]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments), "element vertex 0"]
    header += [f"property float {n}" for n in names]
    table = PlyTable(tuple(header), "\n", "binary_little_endian", dict.fromkeys(names, "float"), np.zeros(0, "V1"))
    rows = new_rows(table, gaussians).view(f"V{4 * len(names)}")
    return SplatFile(gaussians, replace(table, rows=rows))


@dataclass(frozen=True)
class PlyElement:
    """An element that a PLY announces."""

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)  # name → type as written in the header, or list


def header_of(path: Path) -> tuple[PlyTable, list[PlyElement], int]:
    """What a PLY announces: its table without rows, all its elements, and where its body begins.

    Raises BadInput if the file cannot be read or its header is damaged.
    """
    with refusing(f"cannot read {path}", OSError), require_file(path).open("rb") as f:
        start = f.read(MAX_HEADER)
    if not re.match(rb"ply\r?\n", start):
        raise BadInput(f"{path} is not a PLY file (it does not begin with 'ply')")
    end = re.search(rb"^end_header[ \t]*\r?\n", start, re.MULTILINE)
    if not end:
        raise BadInput(f"{path}: the PLY header has no end_header; the file is damaged")
    line_end = "\r\n" if start[3:4] == b"\r" else "\n"
    lines = [line.rstrip("\r") for line in start[: end.start()].decode("latin-1").split("\n")[:-1]]
    form, elements = "", []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in BYTE_ORDERS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and re.fullmatch(r"\d{1,18}", words[2]):
            elements.append(PlyElement(words[1], int(words[2])))
        elif words[0] == "property" and elements and len(words) > 1 and len(words) == PROPERTY_WORDS.get(words[1]):
            name, properties = words[-1], elements[-1].properties
            if name in properties:
                raise BadInput(f"{path}: property {name} occurs twice in the {elements[-1].name} element")
            properties[name] = words[1]
        else:
            raise BadInput(f"{path}: the PLY header line {line[:60]!r} makes no sense; the file is damaged")
    if not form:
        raise BadInput(f"{path}: the PLY header names no format")
    return PlyTable(tuple(lines), line_end, form, {}, np.zeros(0, "V1")), elements, end.end()


def _row_bytes(path: Path, element: PlyElement) -> int:
    if "list" in element.properties.values():  # rows of different sizes
        raise BadInput(f"{path}: element {element.name} with lists in front of the vertices is not supported")
    return sum(np.dtype(TYPES[kind]).itemsize for kind in element.properties.values())


def _read_binary(path: Path, elements: Sequence[PlyElement], vertex: int, start: int) -> Body:
    first = start + sum(e.count * _row_bytes(path, e) for e in elements[:vertex])
    row_bytes, count, size = _row_bytes(path, elements[vertex]), elements[vertex].count, path.stat().st_size
    if first + count * row_bytes > size:
        raise BadInput(
            f"{path} is truncated: {count} rows of {row_bytes} bytes announced, {max(0, size - first)} bytes there"
        )
    with path.open("rb") as f:
        f.seek(start)
        before = f.read(first - start)
        rows = np.fromfile(f, dtype=f"V{row_bytes}", count=count) if row_bytes else np.zeros(0, "V1")
        after = f.read() if vertex < len(elements) - 1 else b""  # not bytes that no element announces
    return before, rows, after


def _read_ascii(path: Path, elements: Sequence[PlyElement], vertex: int, start: int) -> Body:
    lines = path.read_bytes()[start:].splitlines(keepends=True)
    first = sum(e.count for e in elements[:vertex])
    count = elements[vertex].count
    rows = [line.rstrip(b"\r\n") for line in lines[first : first + count]]
    if len(rows) < count:
        raise BadInput(f"{path} is truncated: {count} rows announced, {len(rows)} there")
    table = np.empty(count, object)
    table[:] = rows
    return b"".join(lines[:first]), table, b"".join(lines[first + count :])


def values(table: PlyTable, path: Path | str = "PLY") -> np.ndarray:
    """The rows as records in the machine's byte order, [N] structured."""
    if table.format != "ascii":
        records = np.ascontiguousarray(table.rows).view(table.dtype) if len(table.rows) else np.zeros(0, table.dtype)
        return records.astype(table.dtype.newbyteorder("="), copy=False)
    width, records = len(table.properties), np.zeros(len(table.rows), table.dtype)
    with refusing(f"{path}: a row holds something that is not a number", ValueError):
        cells = np.array(b" ".join(table.rows).split(), dtype=np.float64)
    if any(len(row.split()) != width for row in table.rows):  # the total may be right where lines are cut across
        raise BadInput(f"{path}: rows of {width} numbers expected; the file is damaged")
    with np.errstate(invalid="ignore", over="ignore"):
        for k, name in enumerate(table.properties):
            records[name] = cells[k::width]
    return records


def row_blocks(count: int) -> Iterator[slice]:
    """Slices of rows so few that they stay in the cache while their columns are copied one by one (3× faster)."""
    return (slice(start, start + CACHED_ROWS) for start in range(0, count, CACHED_ROWS))


def gaussians_of(table: PlyTable, path: Path | str = "PLY") -> Gaussians:
    """The Gaussians that a table holds; raises BadInput if it does not hold any."""
    names, records = list(table.properties), values(table, path)

    def columns(wanted: Sequence[str]) -> np.ndarray:
        missing = [n for n in wanted if n not in names]
        if missing:
            raise BadInput(f"{path} is not a Gaussian scene: no property {', '.join(missing)}")
        out = np.empty((len(records), len(wanted)), np.float32)
        if all(records.dtype[n] == np.float32 for n in names):  # four times as fast as one column after the other
            numbers = records.view(np.float32).reshape(len(records), len(names))
            return np.take(numbers, [names.index(n) for n in wanted], axis=1, out=out, mode="clip")
        with np.errstate(over="ignore", invalid="ignore"):
            for rows in row_blocks(len(records)):
                for k, n in enumerate(wanted):
                    out[rows, k] = records[n][rows]
        return out

    scale_count = sum(bool(re.fullmatch(r"scale_\d+", n)) for n in names)
    if scale_count not in (2, 3):
        raise BadInput(f"{path}: scale_0..2 (3DGS) or scale_0..1 (2DGS) expected, found {scale_count} scales")
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", n)) for n in names)
    if rest not in (0, 9, 24, 45):
        raise BadInput(f"{path}: {rest} f_rest properties; 0, 9, 24 or 45 expected (SH degree 0–3)")
    parts = {part: columns(of_part) for part, of_part in _layout(scale_count, rest).items()}
    parts["opacity_logits"] = parts["opacity_logits"][:, 0]
    parts["sh"] = parts["sh"].reshape(len(records), rest // 3 + 1, 3)
    return Gaussians(**parts, antialiased=any(ANTIALIASED.search(c) for c in table.comments))


def _layout(scales: int, rest: int) -> dict[str, list[str]]:
    """The properties of each array of Gaussians: the file is channel-major, Gaussians are coefficient-major."""
    higher = [f"f_rest_{c * (rest // 3) + k}" for k in range(rest // 3) for c in range(3)]
    return {
        "means": ["x", "y", "z"],
        "log_scales": [f"scale_{k}" for k in range(scales)],
        "quats": [f"rot_{k}" for k in range(4)],
        "opacity_logits": ["opacity"],
        "sh": ["f_dc_0", "f_dc_1", "f_dc_2", *higher],
    }


def positions(file: SplatFile) -> np.ndarray:
    """The Gaussians' centres in the file's own precision, [N, 3] float64."""
    if all(TYPES[file.table.properties[n]] == "f4" for n in "xyz"):
        return file.gaussians.means.astype(np.float64)
    records = values(file.table)
    return np.stack([records[n].astype(np.float64) for n in "xyz"], -1)


def new_rows(table: PlyTable, added: Gaussians) -> np.ndarray:
    """Records for new Gaussians in the table's properties, [M] structured in the file's byte order."""
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", n)) for n in table.properties)
    padded = replace(added, sh=pad_sh(added.sh, rest // 3 + 1))
    records = np.zeros(len(added), table.dtype)
    for part, of_part in _layout(added.log_scales.shape[1], rest).items():
        for name, column in zip(of_part, getattr(padded, part).reshape(len(added), len(of_part)).T):
            if name in (records.dtype.names or ()):
                records[name] = column
    return records


def ascii_rows(records: np.ndarray) -> list[bytes]:
    """Records as text lines, each number the shortest that reads back to the same value."""

    def text(value: np.generic) -> str:
        return np.format_float_positional(value, trim="-") if isinstance(value, np.floating) else str(value)

    columns = ([text(v) for v in records[name]] for name in records.dtype.names or ())
    return [" ".join(cells).encode() for cells in zip(*columns)]
