"""A node and the thread that spins it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

from bevviz.errors import UserError
from bevviz.ros.environment import load_rclpy


class Session:
    """A context of its own, with one node; ``start`` spins it in a thread until ``close``.

    Args:
        arguments: what follows ``--ros-args`` on the command line: remaps, namespace, parameters.
        on_end: called when the thread ends, for whatever reason.
        name: of the node, unless remapped.

    Raises:
        UserError: no working rclpy, or arguments that it refuses.
    """

    def __init__(
        self,
        arguments: Sequence[str] = (),
        on_end: Callable[[], None] = lambda: None,
        name: str = "bevviz",
    ) -> None:
        rclpy = load_rclpy()
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        self._context: Any = rclpy.Context()
        ros_args = ["--ros-args", *arguments] if arguments else []
        try:
            # Signals are the command's own business: it ends with a readable recording.
            rclpy.init(args=ros_args, context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self.node: Any = rclpy.create_node(name, context=self._context)
        except Exception as error:  # rclpy has no common base class for what the arguments can do wrong
            self._context.try_shutdown()
            raise UserError(f"ROS does not start: {' '.join(str(error).split())}") from None
        self.executor: Any = SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)
        self._on_end = on_end
        self.error: BaseException | None = None  # what ended the thread, where it was not ``close``
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)

    @property
    def domain(self) -> int:
        return int(self._context.get_domain_id())

    def start(self) -> None:
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException, ShutdownException

        try:
            self.executor.spin()
        except (ExternalShutdownException, ShutdownException):
            pass
        except BaseException as error:
            self.error = error
        finally:
            self._on_end()

    def close(self) -> None:
        self.executor.shutdown(timeout_sec=0)
        if self._thread.is_alive():
            self._thread.join(timeout=5)
        self.node.destroy_node()
        self._context.try_shutdown()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
