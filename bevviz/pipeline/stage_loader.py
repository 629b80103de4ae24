"""Load the networks and functions that a configuration names, each once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bevviz.config import Config, DetectorConfig, object_network_params
from bevviz.config.pillars import INPUT_PARAMS
from bevviz.config.plugins import TOPIC
from bevviz.model.frame import Camera
from bevviz.model.results import Detections
from bevviz.pipeline.result_store import ResultStore, StoredDetector, StoredObjectNetwork, open_store
from bevviz.stages import user_stages
from bevviz.stages.detector import Detector
from bevviz.stages.pillars import ObjectNetwork, PillarNetwork
from bevviz.stages.user_stages import UserStage

DetectFunction = Callable[[Camera], Detections | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stages:
    """Functions and networks that a configuration names. None: the stage is built-in, or does not run.

    Attributes:
        ground: user-defined function.
        clustering: user-defined function.
        objects: user-defined function, or 3D detector.
        network: the detector's network, shared by configurations that differ only in thresholds.
        detector: the detector with this configuration's thresholds.
        detect: function that replaces both.
    """

    ground: UserStage | None = None
    clustering: UserStage | None = None
    objects: UserStage | ObjectNetwork | StoredObjectNetwork | None = None
    network: Detector | StoredDetector | UserStage | None = None
    detector: Detector | None = None
    detect: DetectFunction | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        """Class names of the detector, empty if unknown."""
        return () if self.detector is None else tuple(self.detector.names)

    @property
    def provider(self) -> str:
        """Provider of the networks, the detector's first. Empty: bevviz runs none."""
        if self.detector is not None:
            return self.detector.provider
        network = self.objects if isinstance(self.objects, ObjectNetwork | StoredObjectNetwork) else None
        return "" if network is None else network.network.provider


class StageLoader:
    """Loader that loads each network and function once.

    Args:
        store: whether the store of results may answer for networks, and keep what they answer.
    """

    def __init__(self, *, store: bool = True) -> None:
        self._uses_store = store
        self._networks: dict[tuple[str, str, str, int], Detector] = {}
        self._stored: dict[tuple[Detector, ResultStore], StoredDetector] = {}
        self._foreign: dict[tuple[str, str, str], UserStage | None] = {}
        self._pillars: dict[tuple[object, ...], PillarNetwork] = {}

    def load(self, config: Config, detect: DetectFunction | None = None) -> Stages:
        """Return the stages of a configuration. ``detect`` replaces its detector.

        Raises:
            UserError: a network or a user-defined function cannot be used.
        """
        detector = None if detect is not None else self._function(config, "detector")
        network = self._network(config.detector) if detect is None and detector is None else None
        return Stages(
            ground=self._function(config, "ground"),
            clustering=self._function(config, "clustering"),
            objects=self._objects(config),
            network=detector if network is None else self._with_store(network, config),
            detector=None if network is None else network.restated(config.detector),
            detect=detect,
        )

    def _function(self, config: Config, section: str) -> UserStage | None:
        """Return the user-defined function of a section, or None."""
        key = section, getattr(config, section).model_dump_json(), str(config.functions)
        if key not in self._foreign:
            self._foreign[key] = user_stages.load_user_stage(config, section)
        return self._foreign[key]

    def _objects(self, config: Config) -> UserStage | ObjectNetwork | StoredObjectNetwork | None:
        """Return the 3D detector or the user-defined function that makes the objects, or None."""
        params = object_network_params(config)
        if params is None:
            return self._function(config, "objects")
        runs_on = config.detector.provider, config.detector.threads
        input_params = params.model_dump_json(include={*INPUT_PARAMS, "encoder"})
        key = config.objects.method, input_params, *runs_on
        if key not in self._pillars:
            self._pillars[key] = PillarNetwork(Path(config.objects.method), params, *runs_on)
        network = ObjectNetwork(self._pillars[key], params)
        store = open_store(config.store.size) if self._uses_store else None
        if store is None:
            return network
        files = [Path(config.objects.method), *([Path(params.encoder)] if params.encoder else [])]
        return StoredObjectNetwork(network, store, files, params)

    def _with_store(self, network: Detector, config: Config) -> Detector | StoredDetector:
        """Return the detector's network with the store of results, if there is one."""
        store = open_store(config.store.size) if self._uses_store else None
        if store is None:
            return network
        key = network, store
        if key not in self._stored:
            self._stored[key] = StoredDetector(network, store)
        return self._stored[key]

    def _network(self, config: DetectorConfig) -> Detector | None:
        """Return the detector's network, or None."""
        if not config.model or config.model.startswith(TOPIC):
            return None
        key = config.model, config.names, config.provider, config.threads
        if key not in self._networks:
            self._networks[key] = Detector(config)
        return self._networks[key]
