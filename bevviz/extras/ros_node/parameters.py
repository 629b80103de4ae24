"""ROS parameters for every key of the configuration, and the service that saves the last seconds."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bevviz.config import TUTORIAL_NAMES, Config, Parameter, parameters, values
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError

NO_LIMIT = 0  # a ROS parameter cannot be empty


class RosRequests:
    """ROS parameters for every key of the configuration, and the service ``~/save_recording``.

    Each key is a parameter (``clustering.eps``). The tutorial's names (``range_x``, ``voxel_size`` ...) exist
    too. Values given with ``--ros-args -p`` are applied before the constructor returns.

    Args:
        node: an rclpy node that another thread spins.
        settings: the configuration, which takes the values.
        save: writes the recording of the last seconds and returns its path, or raises a UserError.

    Raises:
        UserError: a value given with ``-p`` is refused.
    """

    def __init__(
        self,
        node: Any,
        settings: ReloadableConfig,
        save: Callable[[], Path] | None = None,
    ) -> None:
        self._node, self._configuration, self._save = node, settings, save
        config = settings.config
        about = parameters(config)
        self._keys = {**{key: key for key in about}, **TUTORIAL_NAMES}  # parameter name -> key
        declared = [
            node.declare_parameter(name, value, _descriptor(about[self._keys[name]].text))
            for name, value in self._parameters(config).items()
        ]
        if changed := self._settings(declared):
            settings.take(changed)
        # Ranges come after the first change, so that a wrong value given with ``-p`` gets our sentence.
        for name, key in self._keys.items():
            if (descriptor := _descriptor_with_range(about[key], config)) is not None:
                node.set_descriptor(name, descriptor)
        node.add_on_set_parameters_callback(self._set)
        if save is not None:
            from std_srvs.srv import Trigger

            node.create_service(Trigger, "~/save_recording", self._trigger)

    def show(self, config: Config) -> None:
        """Set the parameters to a configuration that was changed elsewhere."""
        from rclpy.parameter import Parameter

        parameters = self._parameters(config).items()
        self._node.set_parameters(
            [Parameter(n, value=v) for n, v in parameters if self._node.get_parameter(n).value != v]
        )

    def _parameters(self, config: Config) -> dict[str, Any]:
        """Return a configuration as ROS parameters. Lists become YAML, and None an empty text."""
        current, parameters = values(config), dict[str, Any]()
        for name, key in self._keys.items():
            value = current[key]
            if value is None:
                value = NO_LIMIT if name == "max_cluster_size" else ""
            parameters[name] = value if isinstance(value, bool | int | float | str) else _yaml(value)
        return parameters

    def _settings(self, parameters: Sequence[Any]) -> list[str]:
        """Return the parameters that differ from the configuration, as settings ``key=value``."""
        config = self._configuration.config
        current, unchanged = values(config), self._parameters(config)
        ordered = []
        for parameter in parameters:
            name, value = parameter.name, parameter.value
            key = self._keys.get(name)
            if key is None or value == unchanged[name]:
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
                self._configuration.take(settings)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _trigger(self, request: Any, response: Any) -> Any:
        assert self._save is not None
        try:
            response.success, response.message = True, str(self._save())
        except UserError as error:
            response.success, response.message = False, str(error)
        return response


def _text(value: Any) -> str:
    return _yaml(value) if isinstance(value, bool | list | tuple) or hasattr(value, "tolist") else str(value)


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line. JSON is YAML."""
    return json.dumps(value, default=lambda other: other.tolist() if hasattr(other, "tolist") else str(other))


def _descriptor(about: str) -> Any:
    from rcl_interfaces.msg import ParameterDescriptor

    # The configuration checks the type. `ros2 param set` takes 20 for an integer where 20.0 is meant.
    return ParameterDescriptor(description=about, dynamic_typing=True)


def _descriptor_with_range(parameter: Parameter, config: Config) -> Any:
    """Return the descriptor of a number with a range, for the sliders of rqt. None: the key has no range."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange

    value, low, high = values(config)[parameter.key], parameter.low, parameter.high
    if isinstance(value, bool) or parameter.optional or low is None or high is None:
        return None
    descriptor = _descriptor(parameter.text)
    if isinstance(value, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    elif isinstance(value, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]
    return descriptor
