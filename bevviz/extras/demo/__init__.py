"""The simulator and `bevviz demo`: a street, its traffic, and sensors by ray casting with Open3D."""
