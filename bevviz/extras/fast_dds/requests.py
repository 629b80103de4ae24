"""Requests to publishing nodes for the definitions of their types."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from bevviz.errors import UserError
from bevviz.live.graph import UNKNOWN, PublishedTopic, full_name
from bevviz.live.node import Node
from bevviz.messages.definitions import learn

PATIENCE = 3.0  # seconds until a missing answer is reported and the request is repeated


@dataclass(slots=True)
class _Question:
    """Request to one node for the definition of one type."""

    client: Any
    since: float
    sent: float = 0.0
    future: Any = None
    why: str = ""  # reason why there is no answer


class TypeRequests:
    """Client that asks publishing nodes for unknown types. Only the receiving thread may use it."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._met: dict[str, float] = {}  # type without a node to ask -> time it was first met
        self._questions: dict[tuple[str, str], _Question] = {}  # by type and node

    def ask(self, topic: PublishedTopic) -> str | None:
        """Ask a publisher of a topic for its type. Return why that fails, or None while an answer may come.

        ``definitions.store_of`` knows the type after an answer.
        """
        now = time.monotonic()
        publisher = next((p for p in topic.publishers if _can_say(p)), None)
        if publisher is None:  # no node can answer, or it is not discovered yet
            waited = now - self._met.setdefault(topic.type, now)
            return "its publishers do not say what it is made of, either" if waited > PATIENCE else None
        whom = full_name(publisher)
        question = self._questions.get((topic.type, whom))
        if question is None:
            from type_description_interfaces.srv import GetTypeDescription

            client = self._node.input.create_client(GetTypeDescription, f"{whom}/get_type_description")
            question = self._questions[topic.type, whom] = _Question(client, now)
        if question.why:
            return f"{whom}, which publishes it, was asked: {question.why}"
        if now - question.sent > PATIENCE and question.client.service_is_ready():
            self._send(question, topic.type, str(publisher.topic_type_hash))
        if now - question.since > PATIENCE:
            return f"{whom}, which publishes it, was asked and does not answer"
        return None

    def _send(self, question: _Question, name: str, digest: str) -> None:
        from type_description_interfaces.srv import GetTypeDescription

        def answered(future: Any) -> None:
            response = future.result()
            question.why = str(response.failure_reason) if not response.successful else ""
            try:
                if response.successful:
                    sources = {s.type_name: (s.encoding, s.raw_file_contents) for s in response.type_sources}
                    learn(name, sources, digest)
            except UserError as error:
                question.why = str(error)

        if question.future is not None:
            question.client.remove_pending_request(question.future)
        request = GetTypeDescription.Request(type_name=name, type_hash=digest, include_type_sources=True)
        question.sent = time.monotonic()
        question.future = question.client.call_async(request)
        question.future.add_done_callback(answered)


def _can_say(publisher: Any) -> bool:
    """Return whether the node of an rclpy TopicEndpointInfo can be asked.

    Older releases give no type hash.
    """
    return publisher.node_name != UNKNOWN and str(getattr(publisher, "topic_type_hash", "")).startswith(
        "RIHS"
    )
