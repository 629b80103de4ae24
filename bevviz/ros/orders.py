"""What other nodes may ask of a running bevviz: parameters to change, and the recording to be saved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bevviz.config import TUTORIAL_NAMES, Config, keys
from bevviz.errors import UserError

NO_LIMIT = 0  # a parameter cannot be empty


class Orders:
    """The tutorial's parameters (``range_x``, ``voxel_size`` ...) and the service ``~/save_recording``.

    Values given with ``--ros-args -p`` are ordered before the constructor returns. ``config``, ``change`` and
    ``save`` may be replaced later.

    Args:
        node: an rclpy node that somebody spins.
        config: with the values that the parameters begin with.
        change: takes settings as ``key=value``; a UserError refuses them, with its reason.
        save: writes the recording of the last seconds and says where; a UserError says why not.

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
        given = [
            node.declare_parameter(name, _value(config, key), _descriptor(key))
            for name, key in TUTORIAL_NAMES.items()
        ]
        if settings := self._settings(given):
            change(settings)
        node.add_on_set_parameters_callback(self._set)
        if save is not None:
            from std_srvs.srv import Trigger

            node.create_service(Trigger, "~/save_recording", self._trigger)

    def show(self, config: Config) -> None:
        """Let the parameters say what holds now, wherever it was changed."""
        from rclpy.parameter import Parameter

        self.config = config
        current = {name: _value(config, key) for name, key in TUTORIAL_NAMES.items()}
        self._node.set_parameters(
            [Parameter(n, value=v) for n, v in current.items() if self._node.get_parameter(n).value != v]
        )

    def _settings(self, parameters: Sequence[Any]) -> list[str]:
        """What differs from the configuration, in its words."""
        keyed = [(TUTORIAL_NAMES[p.name], p.value) for p in parameters if p.name in TUTORIAL_NAMES]
        return [f"{key}={_text(key, value)}" for key, value in keyed if value != _value(self.config, key)]

    def _set(self, parameters: Sequence[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        try:
            if settings := self._settings(parameters):
                self.change(settings)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _trigger(self, request: Any, response: Any) -> Any:
        assert self.save is not None
        try:
            response.success, response.message = True, str(self.save())
        except UserError as error:
            response.success, response.message = False, str(error)
        return response


def _value(config: Config, key: str) -> Any:
    section, _, name = key.partition(".")
    value = getattr(getattr(config, section), name)
    return NO_LIMIT if value is None else value


def _text(key: str, value: Any) -> str:
    unlimited = key == "clustering.max_cluster_points" and value == NO_LIMIT
    return "null" if unlimited else str(value)


def _descriptor(key: str) -> Any:
    from rcl_interfaces.msg import ParameterDescriptor

    # Typed by the configuration: `ros2 param set` takes 20 for an integer where 20.0 is meant.
    return ParameterDescriptor(description=keys()[key], dynamic_typing=True)
