"""Attributes of meshes and curves as numpy arrays, in one call each way."""

from __future__ import annotations

import numpy as np

_LAYOUT = {
    "FLOAT": ("value", np.float32, ()),
    "INT": ("value", np.int32, ()),
    "INT8": ("value", np.int32, ()),
    "BOOLEAN": ("value", bool, ()),
    "FLOAT2": ("vector", np.float32, (2,)),
    "FLOAT_VECTOR": ("vector", np.float32, (3,)),
}
"""Attribute type -> (property that holds the value, dtype, shape of one value)."""


def write_attribute(data, name: str, kind: str, domain: str, values: np.ndarray) -> None:
    """Set the attribute `name` of a mesh or curves, made where it is missing or of another type.

    kind: FLOAT, INT, BOOLEAN, FLOAT2 or FLOAT_VECTOR. domain: POINT, CURVE, CORNER, FACE. values: a row for each element.
    """
    slot, dtype, shape = _LAYOUT[kind]
    attribute = data.attributes.get(name)
    if attribute is not None and (attribute.data_type != kind or attribute.domain != domain):
        data.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = data.attributes.new(name, kind, domain)
    values = np.ascontiguousarray(values, dtype)
    if values.shape != (len(attribute.data), *shape):
        raise ValueError(f"attribute '{name}' needs values of shape {(len(attribute.data), *shape)}, got {values.shape}")
    attribute.data.foreach_set(slot, values.ravel())


def read_attribute(data, name: str) -> np.ndarray | None:
    """The values of an attribute, a row for each element; None where there is none, or none of a type known here."""
    attribute = data.attributes.get(name)
    if attribute is None or attribute.data_type not in _LAYOUT:
        return None
    slot, dtype, shape = _LAYOUT[attribute.data_type]
    values = np.empty(int(len(attribute.data) * np.prod(shape, dtype=int)), dtype)
    attribute.data.foreach_get(slot, values)
    return values.reshape(-1, *shape)
