"""Coefficients."""

COEFFICIENTS: dict[str, tuple[float, ...]] = dict.fromkeys(
    ("objects", "detector", "LiDAR", "fusion"), (0.0,) * 12
)
SECOND: dict[str, str] = {}
