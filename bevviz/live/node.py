"""ROS nodes of bevviz and the threads that spin them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from bevviz.errors import UserError
from bevviz.live.environment import load_rclpy
from bevviz.support.contexts import Closable


class Node(Closable):
    """One context with two nodes. Each is spun by its own thread from ``start`` to ``close``.

    ``node`` is the node that users see. It has the name, the parameters and the services, and it publishes.
    ``input`` receives, so that a slow service call delays no message. It subscribes by the names on the
    graph. Remaps apply to names that the user states, through ``resolve``.

    Args:
        arguments: arguments after ``--ros-args`` on the command line: remaps, namespace, parameters.
        on_end: called when a thread ends, for any reason.
        name: name of the node, unless remapped.

    Raises:
        UserError: rclpy does not work, or refuses the arguments.
    """

    def __init__(
        self,
        arguments: Sequence[str] = (),
        on_end: Callable[[], None] = lambda: None,
        name: str = "bevviz",
    ) -> None:
        rclpy = load_rclpy()
        from rclpy.signals import SignalHandlerOptions

        self.error: BaseException | None = None  # the exception that ended a thread
        self._on_end = on_end
        self._context: Any = rclpy.Context()
        ros_args = ["--ros-args", *arguments] if arguments else []
        try:
            # The command handles signals itself, so that it ends with a readable recording.
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
        except Exception as error:  # rclpy has no common base class for errors in the arguments
            self._context.try_shutdown()
            raise UserError(f"ROS does not start: {' '.join(str(error).split())}") from None
        self._executors = [self._make_executor(node) for node in (self.node, self.input)]
        self._threads = [
            threading.Thread(target=self._spin, args=(executor,), name="ros", daemon=True)
            for executor in self._executors
        ]

    def _make_executor(self, node: Any) -> Any:
        """Return an executor for one node."""
        from rclpy.executors import SingleThreadedExecutor

        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(node)
        return executor

    @property
    def domain(self) -> int:
        """ROS domain id."""
        return int(self._context.get_domain_id())

    @property
    def middleware(self) -> str:
        """Name of the middleware, such as ``rmw_fastrtps_cpp``."""
        from rclpy.utilities import get_rmw_implementation_identifier

        return str(get_rmw_implementation_identifier())

    @property
    def namespace(self) -> str:
        """Namespace of the node."""
        return str(self.node.get_namespace())

    def resolve(self, topic: str) -> str:
        """Return the name on the graph of a topic that the user states: with namespace, remapped."""
        return str(self.node.resolve_topic_name(topic))

    def owns(self, endpoint: Any) -> bool:
        """Return whether an rclpy TopicEndpointInfo belongs to one of these two nodes."""
        node_name = (endpoint.node_name, endpoint.node_namespace)
        return any(node_name == (node.get_name(), node.get_namespace()) for node in (self.node, self.input))

    @property
    def is_alone(self) -> bool:
        """Whether no other discovered node has the same name."""
        me = (self.node.get_name(), self.node.get_namespace())
        return list(self.input.get_node_names_and_namespaces()).count(me) <= 1

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def _spin(self, executor: Any) -> None:
        """Spin an executor until it is shut down. Keep the exception that ended it."""
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
        """Stop the threads and leave the graph."""
        for executor in self._executors:
            executor.shutdown(timeout_sec=0)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5)
        self.input.destroy_node()
        self.node.destroy_node()
        self._context.try_shutdown()
