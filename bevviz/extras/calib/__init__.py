"""`bevviz calib`: errors of extrinsics and clocks, by the edges of clouds and images."""
