"""Options of ``bevviz live`` for its own topics, and the companion that has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import flag
from bevviz.cli.options import WHAT_TO_RUN
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.extras.ros_node.node import RosNode


@dataclass(frozen=True, kw_only=True)
class RosNodeOptions:
    """Options for the topics of the node."""

    group: ClassVar = WHAT_TO_RUN

    publish: bool = flag("publish the results, as the nodes of the tutorial do")
    diagnostics: bool = flag(
        "publish how bevviz does and what is worth a look on /diagnostics; --publish does it, too"
    )


OPTIONS = RosNodeOptions


def open(options: RosNodeOptions, *, observe: bool) -> RosNode:
    """Return the companion. Without options it has only the parameters and the service.

    Raises:
        UserError: there are no results to publish.
    """
    if observe and options.publish:
        raise UserError("--observe makes no results that --publish could send: leave one of them out")
    from bevviz.extras.ros_node.node import RosNode

    return RosNode(publish=options.publish, diagnostics=options.publish or options.diagnostics)
