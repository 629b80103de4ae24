"""Load the networks and functions that a configuration names, each once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from bevviz.config import Config, DetectorConfig, stage_files
from bevviz.config.plugins import TOPIC
from bevviz.model.frame import Camera
from bevviz.model.results import Detections
from bevviz.pipeline.result_store import ResultStore, StoredDetector, StoredStage, open_store
from bevviz.stages import user_stages
from bevviz.stages.detector import Detector
from bevviz.stages.user_stages import UserStage

DetectFunction = Callable[[Camera], Detections | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stages:
    """Functions and networks that a configuration names. None: the stage is built-in, or does not run.

    Attributes:
        ground: user-defined function.
        clustering: user-defined function.
        objects: user-defined function.
        network: the detector's network, shared by configurations that differ only in thresholds.
        detector: the detector with this configuration's thresholds.
        detect: function that replaces both.
    """

    ground: UserStage | None = None
    clustering: UserStage | None = None
    objects: UserStage | None = None
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
        return "" if self.objects is None else self.objects.provider


class StageLoader:
    """Loader that loads each network and function once.

    Args:
        store: whether the store of results may answer for networks, and keep what they answer.
    """

    def __init__(self, *, store: bool = True) -> None:
        self._uses_store = store
        self._networks: dict[tuple[str, str, str, int], Detector] = {}
        self._stored: dict[tuple[Detector, ResultStore], StoredDetector] = {}
        self._foreign: dict[tuple[str, str, str, str], UserStage | None] = {}

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
            objects=self._function(config, "objects"),
            network=detector if network is None else self._with_store(network, config),
            detector=None if network is None else network.restated(config.detector),
            detect=detect,
        )

    def _function(self, config: Config, section: str) -> UserStage | None:
        """Return the user-defined function of a section, or None."""
        runs_on = f"{config.detector.provider} {config.detector.threads} {config.store.size}"
        key = section, getattr(config, section).model_dump_json(), str(config.functions), runs_on
        if key not in self._foreign:
            stage = user_stages.load_user_stage(config, section)
            if stage is not None and stage.identity and (store := self._store(config)) is not None:
                files = [Path(file) for key, file in stage_files(config).items() if key.startswith(section)]
                stage = replace(stage, call=StoredStage(stage, store, files))
            self._foreign[key] = stage
        return self._foreign[key]

    def _store(self, config: Config) -> ResultStore | None:
        """Return the store of results, if there is one and this loader may use it."""
        return open_store(config.store.size) if self._uses_store else None

    def _with_store(self, network: Detector, config: Config) -> Detector | StoredDetector:
        """Return the detector's network with the store of results, if there is one."""
        store = self._store(config)
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
