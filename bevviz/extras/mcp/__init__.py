"""Server of `bevviz mcp`, by which agents ask about a drive or a batch."""
