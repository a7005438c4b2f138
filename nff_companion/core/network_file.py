"""The file of a basis network: an ``.npz`` of float arrays and a JSON text ``metadata``; nothing in it is trusted."""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.features import NAMES
from nff_companion.core.toml_file import Text, explained
from nff_companion.core.tuning.span import shown, span
from nff_companion.core.vehicle import AXES
from nff_companion.errors import NetworkError

FORMAT = 1
SIZE_MAX = 16_000_000  # bytes; a network that flies has 50 kB
ENTRY_MAX = 1e6  # of any number
SCALE_MIN = 1e-6  # least of the numbers that divide
LAYERS_MAX = 20
_VECTORS = ("mean", "scale", "low", "high", "axis_scale")
_UNREADABLE = (
    OSError,
    ValueError,  # also JSON, UTF-8 and headers of arrays
    KeyError,
    EOFError,
    NotImplementedError,  # ways of compression that zipfile does not know
    OverflowError,
    RecursionError,
    zipfile.BadZipFile,
    zlib.error,
)


class Metadata(msgspec.Struct, frozen=True):
    """What is shown of a network and relied on; more may be there."""

    format: int
    inputs: list[Text]
    airframe: Text = "unnamed"
    fingerprint: Text = ""  # of the airframe that it was trained on (vehicle.py); empty: not known
    minutes: Annotated[float, span(0.0, 1e6, "min", "of flight that it was trained on")] = 0.0
    data_sha256: Text = ""
    covers: list[Literal["thrust", "roll", "pitch", "yaw"]] = []


def read(path: Path) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any]]:
    """Arrays by name, as float64, and the metadata. Raises NetworkError naming file, array and what is allowed."""
    try:
        arrays = _arrays(path)
        metadata = _metadata(arrays.pop("metadata", None))
        _check_metadata(metadata)
        _check_arrays(arrays)
    except _UNREADABLE as error:
        if isinstance(error, NetworkError):
            raise NetworkError(f"network {path}: {error}; train it again with nff train") from error
        raise NetworkError(
            f"network {str(path)!r} cannot be read: {shown(str(error), 200)}; train it again with nff train"
        ) from error
    return {name: value.astype(float) for name, value in arrays.items()}, metadata


def _refuse(what: str) -> NoReturn:
    raise NetworkError(what)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    if path.stat().st_size > SIZE_MAX:
        _refuse(f"file of {path.stat().st_size} bytes; at most {SIZE_MAX} are allowed")
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > SIZE_MAX:
            _refuse(f"its arrays have more than {SIZE_MAX} bytes")
        for entry in entries:
            name = entry.filename.removesuffix(".npy")
            if entry.flag_bits & 1:
                _refuse(f"{shown(name)} is encrypted; arrays as numpy writes them are allowed")
            if name in arrays:
                _refuse(f"{shown(name)} is there twice")
            arrays[name] = _array(name, archive.read(entry))
    return arrays


def _array(name: str, body: bytes) -> NDArray[Any]:
    """One array; its header is believed only where the bytes that follow are as many as it says."""
    stream = io.BytesIO(body)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        _refuse(f"{shown(name)} is written in version {version} of numpy's format; 1.0 and 2.0 are allowed")
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = header(stream)
    if kind.hasobject or kind.kind not in "fU" or (kind.kind == "f" and kind.itemsize not in (4, 8)):
        _refuse(f"{shown(name)} is of type {shown(str(kind))}; float32 and float64 are allowed")
    if math.prod(shape) * kind.itemsize != len(body) - stream.tell():
        _refuse(f"{shown(name)} says that it is of shape {shown(shape)}, which is not what follows")
    return np.asarray(np.load(io.BytesIO(body), allow_pickle=False))


def _metadata(array: NDArray[Any] | None) -> dict[str, Any]:
    if array is None:
        _refuse("metadata are missing")
    if array.shape != () or array.dtype.kind != "U":
        _refuse(f"metadata of type {array.dtype} and shape {array.shape}; one JSON text is allowed")
    try:
        metadata = json.loads(str(array))
    except (ValueError, RecursionError) as error:
        raise NetworkError(f"metadata are not JSON: {shown(str(error), 200)}") from error
    if not isinstance(metadata, dict):
        _refuse("its metadata are not a table")
    return metadata


def _check_metadata(metadata: dict[str, Any]) -> None:
    if metadata.get("format") != FORMAT:
        _refuse(f"metadata.format {shown(metadata.get('format'))}, expected {FORMAT}")
    if metadata.get("inputs") != list(NAMES):
        _refuse(f"metadata.inputs {shown(metadata.get('inputs'))}: its inputs are not those of this version")
    try:
        msgspec.convert(metadata, Metadata)
    except msgspec.ValidationError as error:
        _refuse(f"metadata.{explained(error, Metadata, metadata)}")


def _check_arrays(arrays: dict[str, NDArray[Any]]) -> None:
    """Names, types, shapes that fit each other, and sizes of the numbers."""
    layers = min(sum(name.startswith("weight_") for name in arrays), LAYERS_MAX)
    wanted = [f"{kind}_{i}" for i in range(max(layers, 1)) for kind in ("weight", "bias")] + [*_VECTORS, "prior"]
    for name in wanted:
        if name not in arrays:
            _refuse(f"{name} is missing")
    for name, array in arrays.items():
        if name not in wanted:
            _refuse(f"{shown(name)} is not known; there may be {', '.join(wanted)}")
        if array.dtype.kind != "f":
            _refuse(f"{name} is of type {array.dtype}; float32 and float64 are allowed")
        if not np.isfinite(array).all():
            _refuse(f"{name}: entries are not finite")
        if array.size and float(np.abs(array).max()) > ENTRY_MAX:
            _refuse(f"{name}: an entry of {float(np.abs(array).max()):.3g}; at most {ENTRY_MAX:g} is allowed")
    width = len(NAMES)
    for i in range(layers):
        weight, bias = arrays[f"weight_{i}"], arrays[f"bias_{i}"]
        if weight.ndim != 2 or weight.shape[1] != width or not weight.shape[0]:
            _refuse(f"weight_{i} of shape {weight.shape}, expected (any, {width}): layers do not fit each other")
        width = weight.shape[0]
        if bias.shape != (width,):
            _refuse(f"bias_{i} of shape {bias.shape}, expected ({width},): layers do not fit each other")
    for name in _VECTORS:
        expected = (len(AXES) if name == "axis_scale" else len(NAMES),)
        if arrays[name].shape != expected:
            _refuse(f"{name} of shape {arrays[name].shape}, expected {expected}")
    if arrays["prior"].shape != (width + 1, len(AXES)):
        _refuse(f"prior of shape {arrays['prior'].shape}, expected {(width + 1, len(AXES))}")
    for name in ("scale", "axis_scale"):
        if float(arrays[name].min()) < SCALE_MIN:
            _refuse(f"{name}: an entry of {float(arrays[name].min()):.3g}; at least {SCALE_MIN:g} is allowed")
    if (arrays["low"] > arrays["high"]).any():
        _refuse("low: an entry above that of high; the range of an input may not be empty")
