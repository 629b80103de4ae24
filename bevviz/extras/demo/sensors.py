"""A LiDAR and a camera that see the same triangles by ray casting."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.errors import UserError, first_line
from bevviz.extras.demo.mesh import Material, Mesh
from bevviz.extras.demo.world import Light
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, U8, Intrinsics

# Share of the emitted light that is reflected, and amplitude of the texture.
_SURFACE: Mapping[Material, tuple[float, float]] = {
    Material.ROAD: (0.12, 0.14), Material.PAVEMENT: (0.28, 0.2), Material.KERB: (0.35, 0.15),
    Material.GRASS: (0.4, 0.5), Material.FACADE: (0.42, 0.12), Material.ROOF: (0.3, 0.25),
    Material.PAINT: (0.5, 0.0), Material.GLASS: (0.06, 0.0), Material.RUBBER: (0.05, 0.0),
    Material.CLOTH: (0.33, 0.08), Material.SKIN: (0.45, 0.0), Material.METAL: (0.55, 0.0),
    Material.FOLIAGE: (0.45, 0.7), Material.BARK: (0.25, 0.4), Material.SIGN: (1.0, 0.0),
}  # fmt: skip
VISIBILITY = 130.0  # metres that a camera sees through the haze, less than the length of street around it
REFLECTANCE, TEXTURE = np.array([_SURFACE[m] for m in Material], np.float32).T


def load_open3d() -> Any:
    """Import and return ``open3d``, which nothing else in the package imports.

    Open3D's wheel links libusb-1.0, which a minimal system lacks. ``libusb-package`` contains it. Once it is
    loaded globally, the dynamic linker uses it as the system's library.

    Raises:
        UserError: Open3D cannot be imported.
    """
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        import open3d
    except (ImportError, OSError) as error:  # OSError: a shared library that does not load
        raise UserError(
            f"the synthetic drive needs Open3D, which cannot be imported ({first_line(error)}): "
            "pip install 'bevviz[demo]'; bags and data sets do not need it"
        ) from error
    return open3d


class Caster:
    """Ray caster of one mesh: Open3D's RaycastingScene (Embree; Wald et al. 2014)."""

    def __init__(self, mesh: Mesh) -> None:
        open3d = load_open3d()
        self._core, self._scene = open3d.core, open3d.t.geometry.RaycastingScene()
        self.mesh = mesh
        a, b, c = (mesh.uv[mesh.triangles[:, i]] for i in range(3))
        self.uv = np.concatenate([a, b - a, c - a], axis=1)  # (T, 6): first corner and the two edges
        if len(mesh.triangles):
            self._scene.add_triangles(
                self._core.Tensor.from_numpy(mesh.vertices),
                self._core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
            )

    def cast(self, rays: F32) -> dict[str, NDArray[np.float32]]:
        """Cast (R, 6) rays. Return Open3D's results by name."""
        return {
            name: value.numpy()
            for name, value in self._scene.cast_rays(self._core.Tensor.from_numpy(rays)).items()
        }

    def occluded(self, rays: F32) -> NDArray[np.bool_]:
        """Return the (R,) mask of rays that hit the mesh."""
        hit: NDArray[np.bool_] = self._scene.test_occlusions(self._core.Tensor.from_numpy(rays)).numpy()
        return hit


@dataclass(frozen=True, slots=True)
class RayHits:
    """Hits of rays on surfaces: one row for each of the H rays that hit something."""

    ray: NDArray[np.intp]  # (H,) row of the ray
    distance: F32  # (H,) metres
    normal: F32  # (H, 3) unit, towards the ray's origin
    uv: F32  # (H, 2) metres over the surface
    color: U8  # (H, 3)
    material: U8  # (H,)
    object: I32  # (H,)


class RaycastView:
    """Scenery and moving objects at one time. Only the caster of the small mesh is rebuilt."""

    def __init__(self, static: Caster, moving: Mesh) -> None:
        self._casters: Sequence[Caster] = (static, Caster(moving)) if len(moving.triangles) else (static,)

    def cast(self, rays: F32, reach: float = np.inf) -> RayHits:
        """Cast (R, 6) rays and return the nearest hits within ``reach`` metres."""
        answers = [caster.cast(rays) for caster in self._casters]
        distance = answers[0]["t_hit"]
        nearest = np.zeros(len(rays), np.uint8)
        if len(answers) == 2:
            nearest = (answers[1]["t_hit"] < distance).view(np.uint8)
            distance = np.minimum(distance, answers[1]["t_hit"])
        ray = np.flatnonzero(distance < reach)
        out = RayHits(
            ray,
            distance[ray],
            np.empty((len(ray), 3), np.float32),
            np.empty((len(ray), 2), np.float32),
            np.empty((len(ray), 3), np.uint8),
            np.empty(len(ray), np.uint8),
            np.empty(len(ray), np.int32),
        )
        for k, (caster, answer) in enumerate(zip(self._casters, answers, strict=True)):
            row = np.flatnonzero(nearest[ray] == k)
            source, mesh = ray[row], caster.mesh
            triangle = answer["primitive_ids"][source].astype(np.intp)
            uv, weight = caster.uv[triangle], answer["primitive_uvs"][source]
            out.uv[row] = uv[:, :2] + weight[:, :1] * uv[:, 2:4] + weight[:, 1:] * uv[:, 4:]
            out.normal[row] = answer["primitive_normals"][source]
            out.color[row], out.material[row] = mesh.color[triangle], mesh.material[triangle]
            out.object[row] = mesh.object[triangle]
        away = np.einsum("ij,ij->i", out.normal, rays[ray, 3:]) > 0
        out.normal[away] *= -1
        return out

    def occluded(self, rays: F32) -> NDArray[np.bool_]:
        """Return the (R,) mask of rays that hit something."""
        shadow: NDArray[np.bool_] = np.any([caster.occluded(rays) for caster in self._casters], axis=0)
        return shadow


def _rays(map_from_sensor: F64, directions: F32) -> F32:
    """Return (R, 6) origins and directions in the map frame."""
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = map_from_sensor[:3, 3]
    # This is no BLAS product: for three columns the threads of BLAS cost ten times the computation.
    np.einsum("ij,kj->ik", directions, map_from_sensor[:3, :3].astype(np.float32), out=rays[:, 3:])
    return rays


# --- LiDAR -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Scan:
    """Points of one LiDAR scan."""

    xyz: F32  # (N, 3) in the LiDAR's frame, in firing order
    intensity: F32  # (N,) 0 to 255
    ring: NDArray[np.uint16]  # (N,) beam, 0 is the lowest
    time: F32  # (N,) seconds since the scan began
    material: U8  # (N,) Material
    object: I32  # (N,) number of the object, 0: scenery


@dataclass(frozen=True, slots=True)
class Lidar:
    """A spinning LiDAR with the beams of a Velodyne HDL-64E. Scans are free of motion distortion."""

    beams: int = 64
    azimuths: int = 1900
    lowest: float = -24.8  # degrees
    highest: float = 2.0
    reach: float = 120.0  # metres
    range_noise: float = 0.015  # metres, one sigma
    _directions: F32 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        azimuth = -np.arange(self.azimuths)[:, None] * (
            2 * np.pi / self.azimuths
        )  # clockwise, starting ahead
        elevation = np.radians(np.linspace(self.lowest, self.highest, self.beams))[None]
        unit = [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ]
        object.__setattr__(self, "_directions", np.stack(unit, -1).reshape(-1, 3).astype(np.float32))

    def scan(self, view: RaycastView, map_from_lidar: F64, rng: np.random.Generator) -> Scan:
        """Scan the view from this pose."""
        rays = _rays(map_from_lidar, self._directions)
        hits = view.cast(rays, self.reach)
        facing = np.abs(np.einsum("ij,ij->i", hits.normal, rays[hits.ray, 3:]))
        strength = REFLECTANCE[hits.material] * (0.35 + 0.65 * facing)
        marking = (hits.material == Material.ROAD) & _markings(hits.uv)
        strength[marking] = 0.7
        # The probability to lose a weak echo grows with its distance.
        noise = rng.standard_normal((3, len(hits.ray)), np.float32)
        kept = np.flatnonzero(strength * 255 * (1 + 0.25 * noise[0]) > (hits.distance / 40.0) ** 2)
        ray, material = hits.ray[kept], hits.material[kept]
        distance = hits.distance[kept] + self.range_noise * noise[1, kept]
        distance += np.where(material == Material.FOLIAGE, 0.15 * np.abs(noise[2, kept]), 0).astype(
            np.float32
        )
        intensity = np.clip(255 * strength[kept] * (1 + 0.08 * noise[2, kept]), 1, 255)
        return Scan(
            xyz=self._directions[ray] * distance[:, None],
            intensity=intensity.astype(np.float32),
            ring=(ray % self.beams).astype(np.uint16),
            time=(ray // self.beams * (0.1 / self.azimuths)).astype(np.float32),
            material=material,
            object=hits.object[kept],
        )


# --- camera ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """Image of a camera with the object of each pixel."""

    bgr: U8  # (H, W, 3)
    object: I32  # (H, W) number of the object, 0: scenery, -1: sky


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """A pinhole camera with one ray a pixel: Lambert shading, shadows, textures, haze and sensor noise."""

    width: int = 640
    height: int = 360
    focal: float = 440.0  # pixels, as for a ZED 2 with its 4 mm lens
    _directions: F32 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        v, u = np.mgrid[: self.height, : self.width].astype(np.float32)
        x, y = (u - (self.width - 1) / 2) / self.focal, (v - (self.height - 1) / 2) / self.focal
        unit = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
        object.__setattr__(self, "_directions", unit / np.linalg.norm(unit, axis=1, keepdims=True))

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics without distortion."""
        f, cx, cy = self.focal, (self.width - 1) / 2, (self.height - 1) / 2
        return Intrinsics(
            self.width, self.height, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), "plumb_bob", np.zeros(5)
        )

    def picture(
        self, view: RaycastView, map_from_camera: F64, light: Light, rng: np.random.Generator
    ) -> CameraPicture:
        """Render the view from this pose."""
        import cv2

        rays = _rays(map_from_camera, self._directions)
        hits = view.cast(rays, VISIBILITY)
        image = _sky(rays[:, 3:], light)
        direction = rays[hits.ray, 3:]
        point = rays[hits.ray, :3] + direction * hits.distance[:, None]
        albedo = hits.color.astype(np.float32) * _texture(hits, point)[:, None]
        _paint_road(albedo, hits)
        _paint_facades(albedo, hits)
        lit = np.maximum(np.einsum("ij,j->i", hits.normal, light.sun), 0)
        sunny = np.flatnonzero(lit > 0)
        towards = np.empty((len(sunny), 6), np.float32)
        towards[:, :3] = point[sunny] + 0.02 * hits.normal[sunny]
        towards[:, 3:] = light.sun
        lit[sunny[view.occluded(towards)]] = 0
        sky_seen = 0.75 + 0.25 * hits.normal[:, 2:]
        shade = albedo * (sky_seen * light.ambient + lit[:, None] * light.direct)
        _reflect(shade, hits, direction, light)
        haze = np.exp(-hits.distance / 350.0)[:, None]
        clear = np.clip((VISIBILITY - hits.distance) / (0.4 * VISIBILITY), 0, 1)[:, None]
        hazy = shade * haze + light.horizon * (1 - haze)
        image[hits.ray] = hazy * clear + image[hits.ray] * (1 - clear)
        image = cv2.GaussianBlur(image.reshape(self.height, self.width, 3), (3, 3), 0.55)
        image += rng.standard_normal(image.shape, np.float32) * 2.0
        number = np.full(len(rays), -1, np.int32)
        number[hits.ray] = hits.object
        return CameraPicture(np.clip(image, 0, 255).astype(np.uint8), number.reshape(self.height, self.width))


def _noise(seed: int) -> F32:
    """Return a (256, 256) tile of smooth noise in -1 to 1 that repeats without a seam."""
    spectrum = np.fft.fft2(np.random.default_rng(seed).standard_normal((256, 256)))
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    tile = np.fft.ifft2(spectrum / (f + 0.02)).real
    return np.asarray(np.clip(tile / (2.5 * tile.std()), -1, 1), np.float32)


_TILE = _noise(7)


def _texture(hits: RayHits, point: F32) -> F32:
    """Return the brightness around 1 from noise at two scales, projected along the main axis."""
    flat = np.abs(hits.normal[:, 2]) > 0.7
    wide = np.abs(hits.normal[:, 0]) > np.abs(hits.normal[:, 1])
    p = np.where(flat | ~wide, point[:, 0], point[:, 1])
    q = np.where(flat, point[:, 1], point[:, 2])
    fade = 1 / (1 + (hits.distance / 25) ** 2)  # fades patterns that are finer than a pixel
    fine = _TILE[(q * 40).astype(np.int32) & 255, (p * 40).astype(np.int32) & 255] * fade
    coarse = _TILE[(q * 5).astype(np.int32) & 255, (p * 5).astype(np.int32) & 255]
    return np.asarray(1 + TEXTURE[hits.material] * (fine + 0.6 * coarse), np.float32)


def _markings(uv: F32) -> NDArray[np.bool_]:
    """Return the mask of the dashed centre line and the lines of the parking lanes.

    ``uv`` is the way along and across the street.
    """
    s, across = uv[:, 0], np.abs(uv[:, 1])
    dashed: NDArray[np.bool_] = ((across < 0.07) & (s % 6.0 < 3.0)) | (np.abs(across - 4.25) < 0.05)
    return dashed


def _paint_road(albedo: F32, hits: RayHits) -> None:
    """Paint markings on the road and joints on the pavement."""
    road = np.flatnonzero(hits.material == Material.ROAD)
    albedo[road[_markings(hits.uv[road])]] = (205, 208, 210)
    slab = np.flatnonzero(hits.material == Material.PAVEMENT)
    s, across = hits.uv[slab].T
    joint = (s % 1.0 < 0.03) | (np.abs(across) % 1.0 < 0.03)
    albedo[slab[joint & (hits.distance[slab] < 30)]] *= 0.8


def _paint_facades(albedo: F32, hits: RayHits) -> None:
    """Paint windows on facades."""
    wall = np.flatnonzero(hits.material == Material.FACADE)
    u, v = hits.uv[wall].T
    column, row = u % 2.6, (v - 0.3) % 3.0
    frame = (column > 0.6) & (column < 2.0) & (row > 0.75) & (row < 2.5) & (v > 0.4)
    pane = (
        (column > 0.7) & (column < 1.9) & (row > 0.85) & (row < 2.4) & (np.abs(column - 1.3) > 0.04) & frame
    )
    albedo[wall[frame]] = (215, 218, 220)
    lot = np.floor(u / 2.6) * 31 + np.floor((v - 0.3) / 3.0) * 17  # each window has its own brightness
    albedo[wall[pane]] = np.array([88, 76, 66], np.float32) * (0.7 + 0.6 * ((lot[pane, None] * 0.618) % 1.0))


def _reflect(shade: F32, hits: RayHits, direction: F32, light: Light) -> None:
    """Mirror the sky in glass and paint, more at a grazing angle (Schlick 1994)."""
    shiny = np.flatnonzero((hits.material == Material.GLASS) | (hits.material == Material.PAINT))
    normal, ray = hits.normal[shiny], direction[shiny]
    facing = np.clip(-np.einsum("ij,ij->i", normal, ray), 0, 1)
    up = ray[:, 2] + 2 * facing * normal[:, 2]
    share = (0.06 + 0.6 * (1 - facing) ** 5) * np.where(up > 0.05, 1.0, 0.25)
    share *= np.where(hits.material[shiny] == Material.GLASS, 2.2, 0.8)
    share = np.minimum(share, 0.8)[:, None].astype(np.float32)
    shade[shiny] = shade[shiny] * (1 - share) + light.zenith * share


def _sky(direction: F32, light: Light) -> F32:
    """Return the (R, 3) colours of the sky in these directions."""
    up = np.clip(direction[:, 2], 0, 1)
    blend = np.sqrt(np.minimum(up * 2.2, 1))[:, None]
    scale = 20 / (up + 0.15)
    u, v = (direction[:, 0] * scale).astype(np.int32), (direction[:, 1] * scale).astype(np.int32)
    cloud = np.clip(_TILE[u & 255, v & 255] * 1.2, 0, 1)[:, None] * blend * 0.5
    clear = light.horizon * (1 - blend) + light.zenith * blend
    return np.asarray(clear * (1 - cloud) + 238 * cloud, np.float32)


def optical(translation: Sequence[float], pitch: float) -> F64:
    """Return (4, 4) base_from_optical of a camera that looks ahead, ``pitch`` radians below the horizon."""
    c, s = np.cos(pitch), np.sin(pitch)
    m = geometry.transform(np.asarray(translation), np.array([0, 0, 0, 1.0]))
    m[:3, :3] = np.array([[0, -s, c], [-1, 0, 0], [0, -c, -s]])
    return m
