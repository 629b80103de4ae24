"""`bevviz batch`, `causes` and `fix`: runs over many bags, what their findings share, and what repairs it."""
