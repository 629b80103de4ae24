"""What a configuration names, loaded: networks, functions of others, each once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bevviz.config import Config, DetectorConfig, object_network
from bevviz.config.pillars import FED
from bevviz.config.plugins import TOPIC
from bevviz.model.frame import Camera
from bevviz.model.results import Detections
from bevviz.stages import user_stages
from bevviz.stages.detector import Detector
from bevviz.stages.pillars import ObjectNetwork, PillarNetwork
from bevviz.stages.user_stages import Foreign

Detect = Callable[[Camera], Detections | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stages:
    """The functions and networks that a configuration names. None: the stage is ours, or there is none.

    Attributes:
        network: the detector's network, shared by configurations that only differ in thresholds.
        detector: the same with this configuration's thresholds.
        detect: what finds the objects in a camera's image instead of both.
    """

    ground: Foreign | None = None
    clustering: Foreign | None = None
    objects: Foreign | ObjectNetwork | None = None
    network: Detector | Foreign | None = None
    detector: Detector | None = None
    detect: Detect | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        """That the detector knows, as far as that is known."""
        return () if self.detector is None else tuple(self.detector.names)

    @property
    def provider(self) -> str:
        """What the networks run on, the detector's first; empty: there is none of ours."""
        if self.detector is not None:
            return self.detector.provider
        return self.objects.network.provider if isinstance(self.objects, ObjectNetwork) else ""


class StageLoader:
    """Loads what configurations name, each network and function once."""

    def __init__(self) -> None:
        self._networks: dict[tuple[str, str, str, int], Detector] = {}
        self._foreign: dict[tuple[str, str, str], Foreign | None] = {}
        self._pillars: dict[tuple[object, ...], PillarNetwork] = {}

    def load(self, config: Config, detect: Detect | None = None) -> Stages:
        """The stages of a configuration; with ``detect``, that instead of its detector.

        Raises:
            UserError: a network or somebody's function cannot be used.
        """
        detector = None if detect is not None else self._function(config, "detector")
        network = self._network(config.detector) if detect is None and detector is None else None
        return Stages(
            ground=self._function(config, "ground"),
            clustering=self._function(config, "clustering"),
            objects=self._objects(config),
            network=network or detector,
            detector=None if network is None else network.restated(config.detector),
            detect=detect,
        )

    def _function(self, config: Config, section: str) -> Foreign | None:
        key = section, getattr(config, section).model_dump_json(), str(config.functions)
        if key not in self._foreign:
            self._foreign[key] = user_stages.foreign(config, section)
        return self._foreign[key]

    def _objects(self, config: Config) -> Foreign | ObjectNetwork | None:
        params = object_network(config)
        if params is None:
            return self._function(config, "objects")
        runs_on = config.detector.provider, config.detector.threads
        fed = params.model_dump_json(include={*FED, "encoder"})
        key = config.objects.method, fed, *runs_on
        if key not in self._pillars:
            self._pillars[key] = PillarNetwork(Path(config.objects.method), params, *runs_on)
        return ObjectNetwork(self._pillars[key], params)

    def _network(self, config: DetectorConfig) -> Detector | None:
        if not config.model or config.model.startswith(TOPIC):
            return None
        key = config.model, config.names, config.provider, config.threads
        if key not in self._networks:
            self._networks[key] = Detector(config)
        return self._networks[key]
