"""Coefficients of ``confidence``, written by ``python -m benchmarks.confidence fit``.

They are fitted to 4190 answers on the drives 1020 to 1029.
"""

COEFFICIENTS: dict[str, tuple[float, ...]] = {  # in the order of FEATURES
    "LiDAR": (0.76, -0.41, 0.02, 0.03, 0.12, -0.20, -2.31, 1.43, 0.12, 0.07, 0.08, 0.00),
    "detector": (1.44, 3.24, 0.00, -2.20, 0.87, -0.80, -0.97, -0.09, -1.18, -4.41, 0.00, 0.64),
    "fusion": (-1.80, -1.93, 0.35, 0.11, 2.02, -0.39, -0.32, 0.75, -0.49, -0.08, -1.27, -1.64),
    "objects": (-1.52, 1.72, 0.95, 2.37, 1.01, -2.01, 0.34, 0.25, -3.47, -0.09, -1.23, -1.97),
}
SECOND: dict[str, str] = {  # the right reason most often where this one was wrong
    "below threshold": "not detected",
    "borrowed name": "misnamed",
    "ground": "noise",
    "low overlap": "merged",
    "merged": "reported",
    "misfit": "below threshold",
    "noise": "ground",
    "not detected": "below threshold",
    "other cluster": "not detected",
    "reported": "merged",
    "shared box": "noise",
    "suppressed": "below threshold",
    "taken": "merged",
    "too few points": "merged",
    "too large": "out of view",
}
