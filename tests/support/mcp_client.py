"""Client of ``bevviz mcp``: the official package's, over standard input and output."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcp import ClientSession, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.types import TextContent


@dataclass
class Client:
    """Client of a server, which counts calls and bytes."""

    session: ClientSession
    calls: int = 0
    largest: int = 0
    errors: list[str] = field(default_factory=list)

    async def ask(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Call a tool. An error gives an empty answer."""
        self.calls += 1
        answer = await self.session.call_tool(tool, arguments)
        content = answer.content[0]
        assert isinstance(content, TextContent)
        self.largest = max(self.largest, len(content.text.encode()))
        if answer.isError:
            self.errors.append(content.text)
            return {}
        tree: dict[str, Any] = json.loads(content.text)
        return tree


@asynccontextmanager
async def connected(*arguments: str) -> AsyncIterator[Client]:
    """Start ``bevviz mcp`` and connect a client."""
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "bevviz", "mcp", *arguments],
        env=dict(os.environ),
        cwd=Path.cwd(),
    )
    with open(os.devnull, "w") as nowhere:  # noqa: PTH123
        async with stdio_client(server, errlog=nowhere) as streams, ClientSession(*streams) as session:
            await session.initialize()
            yield Client(session)
