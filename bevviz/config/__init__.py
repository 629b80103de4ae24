"""The whole configuration: pydantic models with units, two presets, YAML files and ``key=value`` settings.

The preset ``default`` takes the better method at every stage. The preset ``reference`` computes the results
of the ROS 2 tutorial pipeline. The tutorial's own parameter names (``cluster_tolerance`` ...) are accepted
everywhere. A user-defined stage takes its parameters under ``SECTION.params``.
"""

from bevviz.config.class_sizes import SIZES
from bevviz.config.files import Layer, dump, flat_yaml, read_layer, stated_lines
from bevviz.config.keys import (
    TUTORIAL_NAMES,
    ParameterChange,
    changes,
    flattened,
    keys,
    unit,
    unit_spellings,
    unknown_key,
    values,
)
from bevviz.config.loading import load, received, revised
from bevviz.config.methods import OURS, STAGES
from bevviz.config.sections import (
    AnomaliesConfig,
    AnomalyKind,
    BevConfig,
    ClusteringConfig,
    Config,
    DetectorConfig,
    FusionConfig,
    GroundConfig,
    LiveConfig,
    LoggingConfig,
    ObjectsConfig,
    OpinionsConfig,
    Preset,
    Section,
    SourceConfig,
    TrackingConfig,
    VoxelConfig,
)
from bevviz.config.user_stages import (
    object_files,
    object_network,
    params_of,
    plugin_of,
    stage_topics,
    with_object_files,
)

__all__ = [
    "OURS",
    "SIZES",
    "STAGES",
    "TUTORIAL_NAMES",
    "AnomaliesConfig",
    "AnomalyKind",
    "BevConfig",
    "ClusteringConfig",
    "Config",
    "DetectorConfig",
    "FusionConfig",
    "GroundConfig",
    "Layer",
    "LiveConfig",
    "LoggingConfig",
    "ObjectsConfig",
    "OpinionsConfig",
    "ParameterChange",
    "Preset",
    "Section",
    "SourceConfig",
    "TrackingConfig",
    "VoxelConfig",
    "changes",
    "dump",
    "flat_yaml",
    "flattened",
    "keys",
    "load",
    "object_files",
    "object_network",
    "params_of",
    "plugin_of",
    "read_layer",
    "received",
    "revised",
    "stage_topics",
    "stated_lines",
    "unit",
    "unit_spellings",
    "unknown_key",
    "values",
    "with_object_files",
]
