"""Parts for a few users: each folder registers itself by entry points, and the core imports none of them."""
