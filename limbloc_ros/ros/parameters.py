# SPDX-License-Identifier: Apache-2.0
"""Config dataclasses -> ROS parameters: declared with description, unit and bounds, read, and changed live.

A parameter is written once, as a field with `limbloc_ros.core.config.setting`. A section's prefix joins its fields'
names with a dot, e.g. `hull.voxel_m`.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from limbloc_ros.core.config import from_mapping
from limbloc_ros.core.errors import ConfigError

T = TypeVar("T")

_ARRAYS = {str: Parameter.Type.STRING_ARRAY, float: Parameter.Type.DOUBLE_ARRAY, int: Parameter.Type.INTEGER_ARRAY}


@dataclass
class _Section(Generic[T]):
    kind: type[T]
    names: dict[str, str]  # parameter name -> field name
    value: T
    on_change: Callable[[T], None] | None


class NodeParameters:
    """The parameters of one node, by sections that are config dataclasses.

    Fields that are marked live may be changed while the node runs; the new section is validated as a whole, refused
    with the reason if that fails, and handed to `on_change` otherwise. All other fields are read-only.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._sections: list[_Section[Any]] = []
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def declare(self, kind: type[T], prefix: str = "", on_change: Callable[[T], None] | None = None) -> T:
        """Declare every field of `kind` and return it filled from the node's overrides.

        Raises:
            ConfigError: an override has the wrong type or is out of its bounds.
        """
        hints = typing.get_type_hints(kind)
        names: dict[str, str] = {}
        for field in dataclasses.fields(kind):  # type: ignore[arg-type]
            name = f"{prefix}.{field.name}" if prefix else field.name
            names[name] = field.name
            default: Any = list(field.default) if isinstance(field.default, tuple) else field.default
            if default == []:  # rclpy cannot tell what an empty list holds
                default = _ARRAYS[typing.get_args(hints[field.name])[0]]
            try:
                self._node.declare_parameter(name, default, descriptor(field))
            except (InvalidParameterTypeException, InvalidParameterValueException) as error:
                floats = hints[field.name] in (float, tuple[float, ...])
                hint = " (write 1.0, not 1)" if floats else ""
                raise ConfigError(f"parameter {name}: {error}; expected {_expected(field)}{hint}") from error
        values = {name: self._node.get_parameter_or(name).value for name in names}
        section = _Section(kind, names, _build(kind, names, values), on_change)
        self._sections.append(section)
        return section.value

    def _changed(self, parameters: Sequence[Parameter]) -> list[tuple[_Section[Any], Any]]:
        """The sections that the new values touch, with what they become."""
        changed = []
        for section in self._sections:
            new = {p.name: p.value for p in parameters if p.name in section.names}
            if new:
                old = {name: getattr(section.value, field) for name, field in section.names.items()}
                changed.append((section, _build(section.kind, section.names, {**old, **new})))
        return changed

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        try:
            self._changed(parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        for section, value in self._changed(parameters):
            if value != section.value:
                section.value = value
                if section.on_change is not None:
                    section.on_change(value)


def descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    """What `ros2 param describe` shows of a config field."""
    info = field.metadata
    result = ParameterDescriptor(
        description=f"{info['description']} [{info['unit']}]" if info["unit"] else info["description"],
        read_only=not info["live"],
        additional_constraints=f"one of: {', '.join(info['choices'])}" if info["choices"] else "",
    )
    low, high = info["low"], info["high"]
    if math.isinf(low) and math.isinf(high):
        return result
    if isinstance(field.default, float):
        limit = float(2**1023)
        result.floating_point_range = [FloatingPointRange(from_value=max(low, -limit), to_value=min(high, limit))]
    elif isinstance(field.default, int) and not isinstance(field.default, bool):
        limit = 2**63 - 1
        result.integer_range = [
            IntegerRange(from_value=int(max(low, -limit)), to_value=int(high) if high < limit else limit, step=1)
        ]
    return result


def _expected(field: dataclasses.Field[Any]) -> str:
    info = field.metadata
    kind = "array" if isinstance(field.default, tuple) else type(field.default).__name__
    if math.isinf(info["low"]) and math.isinf(info["high"]):
        return f"{kind} like {field.default!r}"
    return f"{kind} from {info['low']:g} to {info['high']:g} {info['unit']}".rstrip()


def _build(kind: type[T], names: dict[str, str], values: dict[str, Any]) -> T:
    """The dataclass from parameter values; arrays become tuples, unset arrays empty ones."""
    arrays = {f.name for f in dataclasses.fields(kind) if isinstance(f.default, tuple)}  # type: ignore[arg-type]
    return from_mapping(
        kind,
        {field: tuple(values[name] or ()) if field in arrays else values[name] for name, field in names.items()},
    )
