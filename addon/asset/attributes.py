# SPDX-License-Identifier: GPL-3.0-or-later
"""Attributes of points as arrays, and back."""

from __future__ import annotations

import numpy as np

KINDS = {  # of attributes: numbers in a value, key, dtype
    "FLOAT": (1, "value", np.float32),
    "INT": (1, "value", np.int32),
    "BOOLEAN": (1, "value", bool),
    "INT8": (1, "value", np.int8),
    "FLOAT2": (2, "vector", np.float32),
    "FLOAT_VECTOR": (3, "vector", np.float32),
    "FLOAT4": (4, "vector", np.float32),
    "QUATERNION": (4, "value", np.float32),
    "FLOAT_COLOR": (4, "color", np.float32),
    "BYTE_COLOR": (4, "color", np.float32),
}


def read_attribute(data, name: str) -> np.ndarray:
    """An attribute, of its kind's dtype, as (N,) or for several numbers in a value (N,width). Raises KeyError."""
    attribute = data.attributes[name]
    width, key, dtype = KINDS[attribute.data_type]
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width) if width > 1 else values


def write_attributes(data, found: list[tuple[str, str, np.ndarray]]) -> None:
    """(name, kind, values of all points) of each; one that is there already gets the values."""
    for name, kind, values in found:
        attribute = data.attributes.get(name) or data.attributes.new(name, kind, "POINT")
        _, key, dtype = KINDS[kind]
        attribute.data.foreach_set(key, np.ascontiguousarray(values, dtype).ravel())
