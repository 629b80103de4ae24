"""The whole configuration: pydantic models with units, two presets, YAML files and ``key=value`` settings.

The preset ``default`` takes the better method at every stage. The preset ``reference`` computes the results
of the ROS 2 tutorial pipeline. The tutorial's own parameter names (``cluster_tolerance`` ...) are accepted
everywhere. A user-defined stage takes its parameters under ``SECTION.params``.
"""

from bevviz.config.files import Layer, config_yaml, flat_yaml, read_layer, stated_lines
from bevviz.config.loading import changed_config, load, preset_differences, untrusted_layers
from bevviz.config.methods import (
    BUILTIN_METHODS,
    METHOD_KEYS,
    is_stage_file,
    method_label,
    method_of,
    params_of,
    plugin_of,
    same_stage,
    stage_files,
    stage_topics,
    with_stage_files,
)
from bevviz.config.parameters import TUTORIAL_NAMES, Parameter, parameter, parameters, unknown_key
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
    SyncConfig,
    TrackingConfig,
    VoxelConfig,
)
from bevviz.config.value_types import CLASS_SIZES
from bevviz.config.values_by_key import ParameterChange, changes, flatten, values

__all__ = [
    "BUILTIN_METHODS",
    "CLASS_SIZES",
    "METHOD_KEYS",
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
    "Parameter",
    "ParameterChange",
    "Preset",
    "Section",
    "SourceConfig",
    "SyncConfig",
    "TrackingConfig",
    "VoxelConfig",
    "changed_config",
    "changes",
    "config_yaml",
    "flat_yaml",
    "flatten",
    "is_stage_file",
    "load",
    "method_label",
    "method_of",
    "parameter",
    "parameters",
    "params_of",
    "plugin_of",
    "preset_differences",
    "read_layer",
    "same_stage",
    "stage_files",
    "stage_topics",
    "stated_lines",
    "unknown_key",
    "untrusted_layers",
    "values",
    "with_stage_files",
]
