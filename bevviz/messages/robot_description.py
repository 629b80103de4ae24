"""Robot descriptions (URDF) as simple solids, with the meshes that are on this machine."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import numpy as np

from bevviz.messages.decoders import MessageError
from bevviz.model import geometry
from bevviz.model.frame import F64, MeshFile, PlacedShape, SolidShapes

JOINT = 0.02  # metres; half of the size of the mark for a link without simple geometry


MESHES = {".stl", ".dae", ".obj", ".glb", ".gltf", ".ply"}  # formats that the viewer shows
LARGEST = 50_000_000  # bytes of the largest mesh


def parse_links(text: str, topic: str) -> Iterator[PlacedShape]:
    """Yield the solids and meshes of each link of a URDF; a small mark for a link without both.

    See http://wiki.ros.org/urdf/XML/link. Meshes are files of the robot. Only those that are on this machine
    are used.

    Raises:
        MessageError: the text is no URDF.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise MessageError(f"{topic}: not a robot description: {error}") from None
    for link in root.iterfind("link"):
        name = link.get("name", "").lstrip("/")
        try:
            visuals = list(link.iterfind("visual"))
            parts = [part for visual in visuals if (part := _visual(visual)) is not None]
            meshes = tuple(mesh for visual in visuals for mesh in _meshes(visual))
        except ValueError as error:
            raise MessageError(f"{topic}: link '{name}': {error}") from None
        if meshes and not parts:
            yield PlacedShape(f"{topic}/{name}", name, 0, meshes=meshes)
            continue
        poses = np.stack([pose for pose, _ in parts]) if parts else np.eye(4)[None]
        half = np.array([half for _, half in parts] or [(JOINT, JOINT, JOINT)], np.float32)
        turns = np.stack([geometry.quaternion(pose) for pose in poses]).astype(np.float32)
        solids = SolidShapes(poses[:, :3, 3].astype(np.float32), half, turns, round=not parts)
        yield PlacedShape(f"{topic}/{name}", name, 0, solids=solids, meshes=meshes)


def _visual(visual: ElementTree.Element) -> tuple[F64, tuple[float, ...]] | None:
    """Return (4, 4) link from the geometry, and half of the geometry's size; None for meshes."""
    pose = _origin(visual)
    for shape in visual.iterfind("geometry/*"):
        if shape.tag == "box":
            return pose, tuple(length / 2 for length in _floats(shape, "size"))
        if shape.tag in ("sphere", "cylinder"):
            radius = float(shape.get("radius", 0))
            return pose, (radius, radius, float(shape.get("length", 2 * radius)) / 2)
    return None


def _meshes(visual: ElementTree.Element) -> Iterator[MeshFile]:
    """Yield the meshes of a visual that are on this machine."""
    for mesh in visual.iterfind("geometry/mesh"):
        path = mesh_file(mesh.get("filename", ""))
        if path is not None:
            scale = _floats(mesh, "scale") if mesh.get("scale") else (1.0, 1.0, 1.0)
            yield MeshFile(path, _origin(visual), scale)


def mesh_file(name: str) -> Path | None:
    """Return the file of ``package://NAME/PATH`` or ``file:///PATH``; None if it is not on this machine.

    Packages are searched as ROS does: in AMENT_PREFIX_PATH, in the Python environment, and in
    ROS_PACKAGE_PATH.
    """
    parts = urlsplit(name)
    place = unquote(parts.path)
    if parts.scheme == "package":
        prefixes = [*_paths("AMENT_PREFIX_PATH"), Path(sys.prefix)]
        folders = [prefix / "share" / parts.netloc for prefix in prefixes]
        for path in _paths("ROS_PACKAGE_PATH"):
            folders += [path] if path.name == parts.netloc else [path / parts.netloc]
        candidates = [folder / place.lstrip("/") for folder in folders]
    elif parts.scheme == "file":
        candidates = [Path(place)]
    else:
        return None
    return next((path for path in candidates if _is_mesh(path)), None)


def _is_mesh(path: Path) -> bool:
    # A description may come from anywhere: do not open other files of this machine for it.
    try:
        return path.suffix.lower() in MESHES and path.is_file() and 0 < path.stat().st_size <= LARGEST
    except (OSError, ValueError):
        return False


def _paths(variable: str) -> list[Path]:
    return [Path(path) for path in os.environ.get(variable, "").split(os.pathsep) if path]


def _origin(visual: ElementTree.Element) -> F64:
    """Return (4, 4) link from the geometry."""
    origin = visual.find("origin")
    place, angles = (_floats(origin, name) for name in ("xyz", "rpy"))
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.divide(angles, 2)), np.sin(np.divide(angles, 2))
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return geometry.transform(place, (x, y, z, w))


def _floats(element: ElementTree.Element | None, name: str) -> tuple[float, float, float]:
    x, y, z = (float(word) for word in ("0 0 0" if element is None else element.get(name, "0 0 0")).split())
    return x, y, z
