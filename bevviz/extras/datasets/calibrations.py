"""Calibration files of other tools in a plain folder: what each states about cameras and LiDARs.

A function of ``PARSERS`` reads one kind of file. A new kind is one function more.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.config.files import parse_yaml
from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, describe_error, files_in, subfolders
from bevviz.datasets.folder import FoundCalibration
from bevviz.datasets.kitti_labels import MIN_FOCAL, Calibration, named_rows, split_projection
from bevviz.errors import UserError
from bevviz.extras.datasets.kitti_files import read_rigid, rectified_camera
from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.support.files import read_text

SUFFIXES = (".json", ".yaml", ".yml", ".txt")
LEVELS = 3  # folders deep that are searched
FEW, MAX_FILES = 12, 64  # of one folder: more than few of numbered names are of single frames
FRAME_NAME = re.compile(r"\d{4}")  # in the name of a file of one frame: its number or stamp
MAX_SIZE = 1 << 20  # bytes of a calibration
LABELS = re.compile(r"label|annot|result|pred", re.IGNORECASE)  # folders that are not searched
UNREAD = re.compile(r"extrin|^(?!calib_).*calib", re.IGNORECASE)  # names of files that state sensors
OPENCV_TAG = re.compile(r"!!opencv-matrix|^%YAML.*$", re.MULTILINE)
# A camera's body frame (x forward) in its optical frame (z forward).
OPTICAL_FROM_BODY = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
LENSES = {"radtan": "plumb_bob", "equi": "equidistant", "fisheye": "equidistant", "none": ""}
CAMERAS = (2, 0, 1, 3, 4)  # of KITTI: the left colour camera first
ANY_CAMERA = "camera"  # the only one of a folder, whatever its name
ANY_LIDAR = "lidar"  # a folder's LiDAR without a name of its own
# T_camera_lidar, T_cl and the like: the target first, as in a_from_b.
DIRECTION = re.compile(
    r"T_?(?P<target>c(am(era)?)?\d*_?(?=(l|v))|(l(idar)?|velo(dyne)?)_?(?=c))"
    r"(c(am(era)?)?\d*|l(idar)?|velo(dyne)?)",
    re.IGNORECASE,
)
# os1_cloud_node-pylon_camera_node, vel2os1
BETWEEN = re.compile(r"(?P<base>\w+)-(?P<sensor>\w+)|(?P<source>[a-z]\w*?)2(?P<target>[a-z]\w*)")
CAMERA_WORD = re.compile("cam", re.IGNORECASE)
SAME = 1e-3  # relative difference of two calibrations of a camera
TOLERANCE = 0.02  # of a rotation matrix, which some tools write with few digits


@dataclass(frozen=True, slots=True)
class FoundSensor:
    """Statement of a calibration file about a sensor.

    Attributes:
        name: name of the sensor in the file, or that of the file; empty: the file names none.
        lens: K, D, distortion_model and size, as in ``calibration.yaml``.
        sensor_from_lidar: (4, 4) transform from the LiDAR; None: not stated.
        base_from_sensor: (4, 4) pose in the frame of the vehicle; None: not stated.
        is_lidar: whether it is a LiDAR.
        note: what the file states and is not used; empty: nothing.
    """

    name: str
    lens: Mapping[str, Any] = field(default_factory=dict)
    sensor_from_lidar: F64 | None = None
    base_from_sensor: F64 | None = None
    is_lidar: bool = False
    note: str = ""


def find_calibrations(path: Path, lidars: Collection[str], cameras: Collection[str]) -> FoundCalibration:
    """Find what the calibration files in a folder state about its sensors.

    Args:
        path: the folder.
        lidars: names of its LiDARs.
        cameras: names of its cameras.
    """
    cameras = [name for name in cameras if not LABELS.search(name)] or cameras  # images with labels
    found = FoundCalibration()
    stated_in = dict[Path, list[FoundSensor]]()
    for file in _candidates(path):
        try:
            stated_in[file] = _sensors_of(file)
        except (UserError, *NOT_AS_DOCUMENTED) as error:
            why = str(error) if isinstance(error, UserError) else describe_error(error)
            found.warnings.append(f"{file.relative_to(path)}: is not used: {why}")

    for file, sensors in stated_in.items():
        found.warnings += [f"{file.relative_to(path)}: {sensor.note}" for sensor in sensors if sensor.note]
        if not sensors and UNREAD.search(file.stem) and file.name != "calibration.yaml":
            found.warnings.append(
                f"{file.relative_to(path)}: is not used: no kind of calibration that is known here; "
                "calibration.yaml can state it (docs/inputs.md)"
            )

    def names_none(file: Path) -> bool:
        """Return whether a file names no camera of the folder."""
        return not any(match_name(sensor.name, cameras, alone=False) for sensor in stated_in[file])

    for file in sorted(stated_in, key=names_none):
        sensors = stated_in[file]
        single = len([sensor for sensor in sensors if not sensor.is_lidar]) == 1
        before = {name: stated["K"] for name, stated in found.cameras.items() if "K" in stated}
        used = [_note(found, sensor, lidars, cameras, single) for sensor in sensors]
        for name, K in before.items():
            stated = [s.lens["K"] for s in sensors if "K" in s.lens and _means(s, cameras, single) == name]
            if stated and not np.allclose(_flat(stated[0]), _flat(K), rtol=SAME):
                found.warnings.append(
                    f"{file.relative_to(path)} states another K of {name} than "
                    f"{found.files[0].relative_to(path)}: the first is used for all frames"
                )
        if any(used):
            found.files.append(file)
    return found


def _note(
    found: FoundCalibration,
    sensor: FoundSensor,
    lidars: Collection[str],
    cameras: Collection[str],
    single: bool,
) -> bool:
    """Note a statement about a sensor of the folder. Return False if the folder has no such sensor."""
    names, sensors = (lidars, found.lidars) if sensor.is_lidar else (cameras, found.cameras)
    name = _means(sensor, names, single)
    if not name:
        return False
    stated = sensors.setdefault(name, {})
    for key, value in sensor.lens.items():
        stated.setdefault(key, value)
    pose = sensor.base_from_sensor
    if pose is None and sensor.sensor_from_lidar is not None:
        pose = geometry.inverse(sensor.sensor_from_lidar)
    if pose is not None:
        stated.setdefault("pose", pose.reshape(-1).tolist())
    return True


def _means(sensor: FoundSensor, names: Collection[str], single: bool) -> str:
    """Return the sensor of the folder that a statement is about; empty if it is not clear."""
    alone = single or sensor.is_lidar or sensor.name == ANY_CAMERA
    name = match_name(sensor.name, names, alone=alone)
    pose = sensor.base_from_sensor
    is_base = sensor.is_lidar and pose is not None and np.array_equal(pose, np.eye(4))
    return ANY_LIDAR if is_base and not name and ANY_LIDAR in names else name


def match_name(name: str, names: Collection[str], *, alone: bool) -> str:
    """Return the sensor of a folder that a calibration means; empty if it is not clear.

    Args:
        name: name in the calibration.
        names: names of the sensors in the folder.
        alone: whether the only sensor of the folder is meant if no name fits.
    """
    wanted = _plain(name)
    for fits in (
        lambda known: known == wanted,
        lambda known: bool(known) and (known in wanted or (bool(wanted) and wanted in known)),
    ):
        matching = [known for known in names if fits(_plain(known))]
        if len(matching) == 1:
            return matching[0]
    return next(iter(names)) if alone and len(names) == 1 else ""


def _plain(name: str) -> str:
    """Return a name without case and marks, with one word for a camera."""
    return re.sub(r"[^a-z0-9]", "", name.lower()).replace("camera", "cam").replace("image", "cam")


def _candidates(path: Path) -> Iterator[Path]:
    """Yield the files that may be calibrations. Of a folder with one for each frame the first is one."""
    level = [path]
    for depth in range(LEVELS):
        for folder in level:
            files = [f for f in files_in(folder, SUFFIXES) if f.stat().st_size <= MAX_SIZE]
            of_frames = len(files) > FEW and all(FRAME_NAME.search(file.stem) for file in files)
            yield from files[: 1 if of_frames else MAX_FILES]
        if depth + 1 < LEVELS:
            level = [d for folder in level for d in subfolders(folder) if not LABELS.search(d.name)][:200]


def _sensors_of(file: Path) -> list[FoundSensor]:
    """Return the statements of a file; none if it is no calibration."""
    if file.suffix == ".txt":
        return list(_text(file))
    text = OPENCV_TAG.sub("", read_text(file, MAX_SIZE))
    tree = json.loads(text) if file.suffix == ".json" else parse_yaml(text, str(file))
    if not isinstance(tree, dict):
        return []
    name = file.parent.name if file.stem.isdigit() else file.stem
    for parser in PARSERS:
        if sensors := list(parser(tree, name)):
            return sensors
    return []


# --- one kind of file each ---------------------------------------------------------------------


def _text(file: Path) -> Iterator[FoundSensor]:
    """Read lines of a name and numbers: those of KITTI's benchmarks and raw drives, and of CalibAnything.

    RELLIS-3D's ``camera_info.txt`` has fx, fy, cx and cy alone.
    """
    if file.name == "camera_info.txt":
        yield FoundSensor(ANY_CAMERA, {"K": _pinhole(read_text(file, MAX_SIZE).split())})
        return
    if "extrin" in file.stem.lower() and (matrix := _plain_matrix(file)) is not None:
        yield FoundSensor(ANY_CAMERA, {}, matrix)
        return
    rows = named_rows(file)
    sizes = {name: len(values) for name, values in rows.items()}
    if not {"Tr_velo_to_cam", "Tr_velo_to_cam_0", "Tr", "Tr_velo_cam"}.isdisjoint(rows):
        yield from _kitti(file, rows)
    elif file.name == "calib_velo_to_cam.txt":
        cameras = file.with_name("calib_cam_to_cam.txt")
        names = named_rows(cameras) if cameras.is_file() else ()
        yield from _numbered(
            {n: rectified_camera(file.parent, f"{n:02}") for n in CAMERAS if f"P_rect_{n:02}" in names}
        )
    elif sizes.get("K") == 9 and sizes.get("T") == 12:
        yield FoundSensor(
            ANY_CAMERA, {"K": _square(rows["K"]), **_lens(_flat(rows.get("D", ())), "")}, _rigid(rows["T"])
        )
    elif sizes.get("P2") == 12 and sizes.get("R") == 9 and sizes.get("T") == 3:
        K, camera_from_reference = split_projection(rows["P2"].reshape(3, 4))
        yield from _numbered({2: (K, camera_from_reference @ _rigid(read_rigid(file)))})


def _plain_matrix(file: Path) -> F64 | None:
    """Return camera_from_lidar of a file of 12 or 16 numbers alone (LVT2Calib); None: it has others."""
    words = re.split(r"[\s,;]+", read_text(file, MAX_SIZE).strip())
    try:
        return _rigid([float(word) for word in words]) if len(words) in (12, 16) else None
    except ValueError:
        return None


def _kitti(file: Path, rows: Mapping[str, F64]) -> Iterator[FoundSensor]:
    """Read the text of KITTI's benchmarks: projections P0 to P3 and ``Tr_velo_to_cam``."""
    calibration = Calibration(file)
    numbers = [number for number in CAMERAS if len(rows.get(f"P{number}", ())) == 12]
    if not numbers:
        yield FoundSensor(ANY_CAMERA, {}, calibration.rectified_from_lidar)
    cameras, problems = dict[int, tuple[F64, F64]](), list[UserError]()
    for number in numbers:
        try:
            cameras[number] = calibration.camera(number)
        except UserError as error:  # Converters write placeholders for cameras that a set does not have.
            problems.append(error)
    if problems and not cameras:
        raise problems[0]
    yield from _numbered(cameras)


def _numbered(cameras: Mapping[int, tuple[F64, F64]]) -> Iterator[FoundSensor]:
    """Yield numbered cameras of KITTI: (3, 3) K and (4, 4) camera_from_lidar."""
    for number, (K, camera_from_lidar) in cameras.items():
        yield FoundSensor(f"image_{number:02}", {"K": K.tolist()}, camera_from_lidar)
        yield FoundSensor(f"image_{number}", {"K": K.tolist()}, camera_from_lidar)
    for K, camera_from_lidar in [*cameras.values()][:1]:  # of a folder with one camera of any name
        yield FoundSensor(ANY_CAMERA, {"K": K.tolist()}, camera_from_lidar)


def _sustech(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read SUSTechPOINTS: ``extrinsic`` from the LiDAR to the camera, and ``intrinsic``."""
    if {"extrinsic", "intrinsic"} <= tree.keys() and isinstance(tree["intrinsic"], list):
        yield FoundSensor(name, {"K": _square(tree["intrinsic"])}, _rigid(tree["extrinsic"]))


def _supervisely(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read the JSON of an image in Supervisely: ``sensorsData`` has the transform from the LiDAR, and K.

    Images without a calibration have zeros.
    """
    about = tree.get("meta", tree)
    about = about.get("sensorsData") if isinstance(about, dict) else None
    if isinstance(about, dict) and any(_flat(about["intrinsicMatrix"])):
        K, camera_from_lidar = about["intrinsicMatrix"], about["extrinsicMatrix"]
        yield FoundSensor(name, {"K": _square(K)}, _rigid(camera_from_lidar))


def _plycal(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read PlyCal: the lens in ``cam``, and ``tf`` from the LiDAR to the camera."""
    if isinstance(tree.get("cam"), dict) and "tf" in tree:
        for sensor in _camera_info(tree["cam"], ANY_CAMERA):
            yield replace(sensor, sensor_from_lidar=_rigid(tree["tf"]))


def _opencalib(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read OpenCalib: ``NAME-intrinsic``, and ``LIDAR-to-CAMERA-extrinsic``."""
    for key, about in tree.items():
        param = about.get("param") if isinstance(about, dict) else None
        if not isinstance(param, dict):
            continue
        if key.endswith("-intrinsic") and "cam_K" in param:
            D = _flat(param.get("cam_dist", {}).get("data", ()))
            # The tool does not use the size of the image that its files state, and some state a wrong one.
            yield FoundSensor(
                about.get("sensor_name") or key.removesuffix("-intrinsic"),
                {"K": _square(_flat(param["cam_K"]["data"])), **_lens(D, "")},
            )
        elif key.endswith("-extrinsic") and "sensor_calib" in param:
            target = about.get("target_sensor_name") or key.removesuffix("-extrinsic").partition("-to-")[2]
            yield FoundSensor(target, {}, _rigid(param["sensor_calib"]["data"]))


def _camera_info(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read camera matrices as ROS' camera_calibration, its CameraInfo, OpenCV and Autoware.AI write them."""
    matrix = next((tree[key] for key in ("camera_matrix", "CameraMat", "K", "k") if key in tree), None)
    matrix = matrix.get("data") if isinstance(matrix, dict) else matrix
    if not isinstance(matrix, list) or len(matrix) not in (3, 9):
        return
    keys = ("distortion_coefficients", "DistCoeff", "dist_coeffs", "D", "d")
    distortion: Any = next((tree[key] for key in keys if key in tree), {})
    D = _flat(distortion.get("data", ()) if isinstance(distortion, dict) else distortion)
    sides = tree.get("ImageSize") or [
        tree.get(f"image_{side}", tree.get(side, 0)) for side in ("width", "height")
    ]
    lens = {"K": _square(matrix), "size": sides, **_lens(D, str(tree.get("distortion_model", "")))}
    extrinsic = tree.get("CameraExtrinsicMat")
    lidar_from_camera = _rigid(extrinsic["data"]) if isinstance(extrinsic, dict) else None
    camera_from_lidar = None if lidar_from_camera is None else geometry.inverse(lidar_from_camera)
    if camera_from_lidar is None:
        camera_from_lidar = _named_transform(tree)
    yield FoundSensor(str(tree.get("camera_name") or name), lens, camera_from_lidar)


def _kalibr(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read Kalibr's camchain; ``T_cam_lidar`` is an addition of some tools."""
    previous: F64 | None = None
    for key, about in tree.items():
        if not (isinstance(about, dict) and re.fullmatch(r"cam\d+", key)):
            continue
        pose = None
        if "T_cam_lidar" in about:
            pose = _rigid(about["T_cam_lidar"])
        elif previous is not None and "T_cn_cnm1" in about:
            pose = _rigid(about["T_cn_cnm1"]) @ previous
        previous = pose
        lens: dict[str, Any] = {}
        model = str(about.get("camera_model", "pinhole"))
        if model != "pinhole":
            raise UserError(f"{key}: camera_model {model} is not supported; calibrate with pinhole")
        note = ""
        if pose is None and "T_cam_imu" in about:
            note = f"T_cam_imu of {key} states the IMU, not the LiDAR: T_cam_lidar is missing"
        if len(about.get("intrinsics", ())) == 4:
            fx, fy, cx, cy = map(float, about["intrinsics"])
            D = _flat(about.get("distortion_coeffs", ()))
            lens = {"K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]}
            lens |= {"size": about.get("resolution", [0, 0])}
            lens |= _lens(D, str(about.get("distortion_model", "")))
        yield FoundSensor(key, lens, pose, note=note)


def _autoware(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read Autoware's sensor calibration: x y z roll pitch yaw of each frame in its parent."""
    edges = {
        (parent, child): _autoware_pose(pose)
        for parent, children in tree.items()
        if isinstance(children, dict)
        for child, pose in children.items()
        if isinstance(pose, dict) and {"x", "y", "z", "roll", "pitch", "yaw"} <= pose.keys()
    }
    parents = {child: parent for parent, child in edges}
    for _, child in edges:
        pose, frame = np.eye(4), child
        for _ in range(len(edges)):
            if frame not in parents:
                break
            pose, frame = edges[parents[frame], frame] @ pose, parents[frame]
        if re.search("cam", child, re.IGNORECASE):
            body = child.endswith("camera_link")
            pose = pose @ geometry.inverse(OPTICAL_FROM_BODY) if body else pose
            yield FoundSensor(child.removesuffix("/camera_link"), {}, None, pose)
        elif re.search("lidar|velodyne|hesai|pandar|ouster|livox|rslidar", child, re.IGNORECASE):
            yield FoundSensor(child.removesuffix("_base_link"), {}, None, pose, is_lidar=True)


def _named_sensors(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read sensors by name, with the translation and the quaternion (w x y z) of nuScenes."""
    for inner in ("sensors", "calibration", "calibrated_sensors"):
        tree = tree[inner] if isinstance(tree.get(inner), dict) else tree
    for key, about in tree.items():
        if not (isinstance(about, dict) and {"translation", "rotation"} <= about.keys()):
            continue
        pose = geometry.transform_wxyz(about["translation"], about["rotation"])
        intrinsic = about.get("camera_intrinsic") or about.get("intrinsic")
        lens = {"K": _square(_flat(intrinsic))} if intrinsic else {}
        if D := _flat(about.get("camera_distortion") or ()):
            lens |= _lens(D, "")
        yield FoundSensor(key, lens, None, pose, is_lidar=not intrinsic)


def _direct_visual(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read direct_visual_lidar_calibration: the lens in ``camera``, and ``T_lidar_camera`` in ``results``."""
    camera, results = tree.get("camera"), tree.get("results")
    if not (isinstance(camera, dict) and isinstance(results, dict)) or len(camera.get("intrinsics", ())) != 4:
        return
    model = str(camera.get("camera_model", "plumb_bob"))
    if model not in ("plumb_bob", "fisheye", "equidistant", "rational_polynomial"):
        raise UserError(f"camera_model {model} is not supported")
    lens = {"K": _pinhole(camera["intrinsics"]), **_lens(_flat(camera.get("distortion_coeffs", ())), model)}
    yield FoundSensor(ANY_CAMERA, lens, _named_transform(results))


def _fast_livo(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read FAST-LIVO2: ``Rcl`` and ``Pcl`` in one file, and the lens as ``cam_fx`` in another."""
    for inner in ("/**", "ros__parameters"):
        tree = tree[inner] if isinstance(tree.get(inner), dict) else tree
    extrinsic = tree.get("extrin_calib")
    if isinstance(extrinsic, dict) and {"Rcl", "Pcl"} <= extrinsic.keys():
        rotation, position = (
            np.reshape(_flat(extrinsic["Rcl"]), (3, 3)),
            np.reshape(_flat(extrinsic["Pcl"]), (3, 1)),
        )
        yield FoundSensor(ANY_CAMERA, {}, _rigid(np.hstack([rotation, position])))
    if {"cam_fx", "cam_fy", "cam_cx", "cam_cy"} <= tree.keys():
        model = str(tree.get("cam_model", "Pinhole"))
        if model.lower() != "pinhole":
            raise UserError(f"cam_model {model} is not supported")
        scale = float(tree.get("scale", 1.0))
        size = [int(tree.get(f"cam_{side}", 0)) for side in ("width", "height")]
        lens = {"K": _pinhole([tree[f"cam_{key}"] for key in ("fx", "fy", "cx", "cy")]), "size": size}
        if scale != 1.0:
            raise UserError(f"scale {scale:g} of the image is not supported")
        D = [float(tree.get(f"cam_d{i}", 0.0)) for i in range(4)]
        yield FoundSensor(ANY_CAMERA, {**lens, **_lens(D, "plumb_bob")})


def _between_frames(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read RELLIS-3D: ``LIDAR-CAMERA`` is the camera's pose in the LiDAR, ``vel2os1`` moves points so.

    The first sensor of a name with ``-``, and the last one of a name with ``2``, is the base of the others.
    """
    for key, about in tree.items():
        match = BETWEEN.fullmatch(key) if isinstance(about, dict) and {"q", "t"} <= about.keys() else None
        if match is None:
            continue
        q, t = about["q"], about["t"]
        pose = geometry.transform_wxyz([t[axis] for axis in "xyz"], [q[part] for part in "wxyz"])
        base, sensor = match["base"] or match["target"], match["sensor"] or match["source"]
        if CAMERA_WORD.search(base):
            base, sensor, pose = sensor, base, geometry.inverse(pose)
        yield FoundSensor(base, {}, None, np.eye(4), is_lidar=True)
        yield FoundSensor(sensor, {}, None, pose, is_lidar=not CAMERA_WORD.search(sensor))


def _matrix_by_name(tree: Mapping[str, Any], name: str) -> Iterator[FoundSensor]:
    """Read one transform whose name tells its direction, such as ``T_cam_lidar`` or ``T_C_L``."""
    pose = _named_transform(tree)
    if pose is None and "extrinsic_matrix" in tree:
        pose = _rigid(_values(tree["extrinsic_matrix"]))
    if pose is not None:
        yield FoundSensor(ANY_CAMERA, {}, pose)


def _named_transform(tree: Mapping[str, Any]) -> F64 | None:
    """Return camera_from_lidar where it is named ``T_camera_lidar``, ``T_C_L`` or the other way round."""
    for key, value in tree.items():
        match = DIRECTION.fullmatch(key)
        if match is None:
            continue
        numbers = _flat(_values(value))
        pose = geometry.transform(numbers[:3], numbers[3:]) if len(numbers) == 7 else _rigid(numbers)
        return pose if match["target"].lower().startswith("c") else geometry.inverse(pose)
    return None


def _values(value: Any) -> Any:
    """Return the numbers of a matrix, which OpenCV puts into ``data``."""
    return value["data"] if isinstance(value, dict) else value


def _pinhole(intrinsics: Any) -> list[float]:
    """Return the nine numbers of a camera matrix from fx, fy, cx, cy."""
    fx, fy, cx, cy = _flat(intrinsics)
    return _square([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])


PARSERS: Sequence[Callable[[Mapping[str, Any], str], Iterator[FoundSensor]]] = (
    _sustech,
    _supervisely,
    _plycal,
    _opencalib,
    _camera_info,
    _kalibr,
    _named_sensors,
    _autoware,
    _direct_visual,
    _fast_livo,
    _between_frames,
    _matrix_by_name,
)


# --- numbers -----------------------------------------------------------------------------------


def _flat(values: Any) -> list[float]:
    """Return the numbers of nested lists."""
    return [float(value) for value in np.array(values, np.float64).reshape(-1)]


def _square(values: Any) -> list[float]:
    """Return the nine numbers of a camera matrix.

    Raises:
        ValueError: they are no camera matrix.
    """
    numbers = _flat(values)
    if len(numbers) != 9 or numbers[6:8] != [0, 0] or min(numbers[0], numbers[4]) < MIN_FOCAL:
        raise ValueError(f"{numbers} is no camera matrix")
    return numbers


def _rigid(values: Any) -> F64:
    """Return a (4, 4) transform of 12 or 16 numbers.

    Raises:
        ValueError: they are no rotation and translation.
    """
    numbers = _flat(values)
    if len(numbers) not in (12, 16):
        raise ValueError(f"{len(numbers)} numbers are no transform")
    matrix = np.eye(4)
    matrix[: len(numbers) // 4] = np.reshape(numbers, (-1, 4))
    u, scale, v = np.linalg.svd(matrix[:3, :3])
    if np.abs(scale - 1).max() > TOLERANCE or np.linalg.det(u @ v) < 0:
        raise ValueError("its upper left part is no rotation")
    matrix[:3, :3] = u @ v
    return matrix


def _autoware_pose(pose: Mapping[str, Any]) -> F64:
    """Return the (4, 4) transform of x, y, z, roll, pitch and yaw."""
    matrix = np.eye(4)
    angles = np.array([[float(pose[name])] for name in ("roll", "pitch", "yaw")])
    about_x, about_y, about_z = (geometry.rotations(axis, angle)[0] for axis, angle in enumerate(angles))
    matrix[:3, :3] = about_z @ about_y @ about_x
    matrix[:3, 3] = [float(pose[name]) for name in "xyz"]
    return matrix


def _lens(D: Sequence[float], model: str) -> dict[str, Any]:
    """Return the distortion as ``calibration.yaml`` states it; nothing for an ideal lens."""
    if not any(D):
        return {}
    known = LENSES.get(model, model) or ("plumb_bob" if len(D) <= 5 else "rational_polynomial")
    return {"D": list(D), "distortion_model": known}
