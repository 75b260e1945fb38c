"""How a record declares its fields, and how they are checked when it is made."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
# Labels and grid numbers come by the ten million: they are kept small. Coordinates never are.
Labels = npt.NDArray[np.int32]
Codes = npt.NDArray[np.uint8]
Shorts = npt.NDArray[np.float32]


class RecordError(ValueError):
    """A record was given a value that does not fit its field."""


def column(*shape: int | str, dtype: type = np.float64) -> Any:
    """Declare an array field.

    ``shape`` holds a number for a fixed axis and a name for a free one; axes of one name have one length within the
    record. Without a value the array is empty.
    """
    return dataclasses.field(
        default_factory=lambda: np.empty([0 if isinstance(n, str) else n for n in shape] if shape else 0, dtype),
        metadata={"shape": shape, "dtype": dtype},
    )


def optional(*shape: int, dtype: type = np.float64) -> Any:
    """Declare an array field of fixed shape that may be absent (then it has size 0)."""
    return dataclasses.field(
        default_factory=lambda: np.empty(0, dtype), metadata={"shape": shape, "dtype": dtype, "optional": True}
    )


def names(axis: str) -> Any:
    """Declare a tuple of strings, as long as the axis of that name in the record's arrays."""
    return dataclasses.field(default=(), metadata={"axis": axis})


def newer() -> Any:
    """Declare a record that came to the schema later: absent, it changes no scene's hash."""
    return dataclasses.field(default=None, metadata={"newer": True})


class Checked:
    """Checks the declared fields of a frozen dataclass when it is made; holds no data and no behaviour."""

    def __post_init__(self) -> None:
        lengths: dict[str, tuple[int, str]] = {}
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            where = f"{type(self).__name__}.{field.name}"
            if "axis" in field.metadata:
                value = tuple(str(item) for item in value)
                _same_length(lengths, field.metadata["axis"], len(value), where)
                object.__setattr__(self, field.name, value)
            elif "shape" in field.metadata:
                array = _checked_array(value, field.metadata, where, lengths)
                object.__setattr__(self, field.name, array)


def _checked_array(
    value: Any, metadata: Any, where: str, lengths: dict[str, tuple[int, str]]
) -> npt.NDArray[np.generic]:
    shape = metadata["shape"]
    array: npt.NDArray[np.generic] = np.ascontiguousarray(value, dtype=metadata["dtype"])
    absent = array.size == 0
    if absent and metadata.get("optional"):
        array = np.empty(0, metadata["dtype"])
    else:
        if absent:
            array = array.reshape([0 if isinstance(n, str) else n for n in shape])
        fits = array.ndim == len(shape) and all(
            isinstance(want, str) or got == want for got, want in zip(array.shape, shape, strict=True)
        )
        if not fits:
            raise RecordError(f"{where}: expected an array of shape {shape}, got {array.shape}")
        if not absent:
            for got, want in zip(array.shape, shape, strict=True):
                if isinstance(want, str):
                    _same_length(lengths, want, got, where)
    array = array.view()
    array.flags.writeable = False
    return array


def _same_length(lengths: dict[str, tuple[int, str]], axis: str, length: int, where: str) -> None:
    known, first = lengths.setdefault(axis, (length, where))
    if known != length:
        raise RecordError(f"{where}: length {length} along '{axis}', but {first} has {known}")
