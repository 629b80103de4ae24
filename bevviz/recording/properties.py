"""Log how a recording was made: as a page for people, and as a recording property for programs."""

from __future__ import annotations

from typing import Any

import rerun as rr

from bevviz.config import Config, config_yaml, stated_lines
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.primitives import document
from bevviz.recording.provenance import versions
from bevviz.recording.retention import omitted_data
from bevviz.recording.writer import Writer
from bevviz.support.text import fenced, markdown


def log_run_settings(to: Writer, config: Config, scene: Scene, network: str = "") -> None:
    """Log source, configuration, versions, and the device of the detector's network."""
    settings = config_yaml(config)
    stated = stated_lines(config, folders=False)
    packages = [f"{name} {version}" for name, version in versions().items()]
    lines = [*map(markdown, stated), *packages, *([f"network on {markdown(network)}"] if network else [])]
    omitted = list(omitted_data(config.logging))
    omissions = "".join(f"- {line}\n" for line in omitted)
    omissions = (
        f"## Not in this recording (keep: {config.logging.keep})\n\n{omissions}\n" if omissions else ""
    )
    to.static(
        entities.CONFIG,
        document(
            "# How this recording was made\n\n"
            f"Source: **{markdown(scene.name)}**, preset: **{config.preset}**\n\n"
            f"{omissions}{fenced(settings, 'yaml')}\n\n" + "\n".join(f"- {line}" for line in lines)
        ),
    )
    if not to.root:
        to.recording.send_recording_name(scene.name)
    fields: dict[str, Any] = {
        "source": scene.name,
        "preset": config.preset,
        "config": settings,
        "stated": stated,
        "versions": packages,
        "lidars": [name for name in scene.lidars or (scene.lidar,) if name],
        "cameras": list(scene.cameras),
        "keep": config.logging.keep,
        "left_out": omitted,
        "network": network,
    }
    # Rerun omits None and may omit or keep empty values, depending on names that its process has seen.
    values = rr.AnyValues(**{name: value for name, value in fields.items() if value})
    to.recording.send_property(entities.PROPERTY + to.root.replace("/", "_"), values)
