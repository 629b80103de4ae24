"""The nodes of bevviz on the graph, and the threads that spin them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from bevviz.errors import UserError
from bevviz.live.environment import load_rclpy
from bevviz.support.contexts import Closing


class Node(Closing):
    """One context with two nodes, each spun by a thread of its own from ``start`` to ``close``.

    ``node`` is the one that users meet: it has the name, the parameters and the services, and publishes.
    ``input`` receives, so that an order that takes its time delays no message. It takes topics by the
    names they have on the graph: remaps are for what is stated by name, through ``resolve``.

    Args:
        arguments: what follows ``--ros-args`` on the command line: remaps, namespace, parameters.
        on_end: called when a thread ends, for whatever reason.
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
        from rclpy.signals import SignalHandlerOptions

        self.error: BaseException | None = None  # what ended a thread, where it was not ``close``
        self._on_end = on_end
        self._context: Any = rclpy.Context()
        ros_args = ["--ros-args", *arguments] if arguments else []
        try:
            # Signals are the command's own business: it ends with a readable recording.
            rclpy.init(args=ros_args, context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self.node: Any = rclpy.create_node(name, context=self._context)
            self.input: Any = rclpy.create_node(
                f"{self.node.get_name()}_input",
                namespace=self.node.get_namespace(),
                context=self._context,
                use_global_arguments=False,
                start_parameter_services=False,
                enable_rosout=False,
            )
        except Exception as error:  # rclpy has no common base class for what the arguments can do wrong
            self._context.try_shutdown()
            raise UserError(f"ROS does not start: {' '.join(str(error).split())}") from None
        self._executors = [self._make_executor(node) for node in (self.node, self.input)]
        self._threads = [
            threading.Thread(target=self._spin, args=(executor,), name="ros", daemon=True)
            for executor in self._executors
        ]

    def _make_executor(self, node: Any) -> Any:
        from rclpy.executors import SingleThreadedExecutor

        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(node)
        return executor

    @property
    def domain(self) -> int:
        return int(self._context.get_domain_id())

    @property
    def middleware(self) -> str:
        from rclpy.utilities import get_rmw_implementation_identifier

        return str(get_rmw_implementation_identifier())

    @property
    def namespace(self) -> str:
        return str(self.node.get_namespace())

    def resolve(self, topic: str) -> str:
        """The name on the graph of a topic that the user states: with namespace, remapped."""
        return str(self.node.resolve_topic_name(topic))

    def owns(self, endpoint: Any) -> bool:
        """Whether rclpy's TopicEndpointInfo is of one of our nodes."""
        whose = (endpoint.node_name, endpoint.node_namespace)
        return any(whose == (node.get_name(), node.get_namespace()) for node in (self.node, self.input))

    @property
    def is_alone(self) -> bool:
        """Whether no other node that is known by now has the same name."""
        me = (self.node.get_name(), self.node.get_namespace())
        return list(self.input.get_node_names_and_namespaces()).count(me) <= 1

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def _spin(self, executor: Any) -> None:
        from rclpy.executors import ExternalShutdownException, ShutdownException

        try:
            executor.spin()
        except (ExternalShutdownException, ShutdownException):
            pass
        except BaseException as error:
            self.error = error
        finally:
            self._on_end()

    def close(self) -> None:
        for executor in self._executors:
            executor.shutdown(timeout_sec=0)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5)
        self.input.destroy_node()
        self.node.destroy_node()
        self._context.try_shutdown()
