"""KITTI, nuScenes, T4 and Argoverse: loaders, calibrations of other tools, and exports."""
