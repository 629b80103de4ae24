"""Requests of other nodes to a running bevviz: change parameters, save the recording."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bevviz.config import TUTORIAL_NAMES, Config, keys, values
from bevviz.errors import UserError

NO_LIMIT = 0  # a ROS parameter cannot be empty


class Orders:
    """ROS parameters for every key of the configuration, and the service ``~/save_recording``.

    Each key is a parameter (``clustering.eps``). The tutorial's names (``range_x``, ``voxel_size`` ...) exist
    too. Values given with ``--ros-args -p`` are applied before the constructor returns. ``config``,
    ``change`` and ``save`` may be replaced later.

    Args:
        node: an rclpy node that another thread spins.
        config: initial values of the parameters.
        change: applies settings ``key=value``, or raises a UserError with the reason.
        save: writes the recording of the last seconds and returns its path, or raises a UserError.

    Raises:
        UserError: a value given with ``-p`` is refused.
    """

    def __init__(
        self,
        node: Any,
        config: Config,
        change: Callable[[list[str]], None],
        save: Callable[[], Path] | None = None,
    ) -> None:
        self._node = node
        self.config = config
        self.change = change
        self.save = save
        self._keys = {**{key: key for key in keys(config)}, **TUTORIAL_NAMES}  # parameter name -> key
        about = keys(config)
        parameters = [
            node.declare_parameter(name, _value(config, name, key), _descriptor(about[key]))
            for name, key in self._keys.items()
        ]
        if settings := self._settings(parameters):
            change(settings)
        node.add_on_set_parameters_callback(self._set)
        if save is not None:
            from std_srvs.srv import Trigger

            node.create_service(Trigger, "~/save_recording", self._trigger)

    def show(self, config: Config) -> None:
        """Set the parameters to a configuration that was changed elsewhere."""
        from rclpy.parameter import Parameter

        self.config = config
        current = {name: _value(config, name, key) for name, key in self._keys.items()}
        self._node.set_parameters(
            [Parameter(n, value=v) for n, v in current.items() if self._node.get_parameter(n).value != v]
        )

    def _settings(self, parameters: Sequence[Any]) -> list[str]:
        """Return the parameters that differ from the configuration, as settings ``key=value``."""
        current = values(self.config)
        ordered = []
        for parameter in parameters:
            name, value = parameter.name, parameter.value
            key = self._keys.get(name)
            if key is None or value == _value(self.config, name, key):
                continue
            empty = value == NO_LIMIT if name == "max_cluster_size" else value in ("", None)
            none = empty and not isinstance(current[key], str)
            ordered.append(f"{key}={'null' if none else _text(value)}")
        return ordered

    def _set(self, parameters: Sequence[Any]) -> Any:
        """Apply changed parameters. Return whether they were accepted."""
        from rcl_interfaces.msg import SetParametersResult

        try:
            if settings := self._settings(parameters):
                self.change(settings)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _trigger(self, request: Any, response: Any) -> Any:
        """Answer a call of the service."""
        assert self.save is not None
        try:
            response.success, response.message = True, str(self.save())
        except UserError as error:
            response.success, response.message = False, str(error)
        return response


def _value(config: Config, name: str, key: str) -> Any:
    """Return a value as a ROS parameter. Lists and the like become YAML, and None an empty text."""
    value = values(config)[key]
    if value is None:
        return NO_LIMIT if name == "max_cluster_size" else ""
    return value if isinstance(value, bool | int | float | str) else _yaml(value)


def _text(value: Any) -> str:
    """Return a value as text for a setting."""
    return _yaml(value) if isinstance(value, bool | list | tuple) or hasattr(value, "tolist") else str(value)


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line. JSON is YAML."""
    return json.dumps(value, default=lambda other: other.tolist() if hasattr(other, "tolist") else str(other))


def _descriptor(about: str) -> Any:
    """Return the descriptor of a parameter."""
    from rcl_interfaces.msg import ParameterDescriptor

    # The configuration checks the type. `ros2 param set` takes 20 for an integer where 20.0 is meant.
    return ParameterDescriptor(description=about, dynamic_typing=True)
