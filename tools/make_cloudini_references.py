"""Clouds as cloudini's own library encodes and decodes them, in tests/references/clouds/cloudini.npz.

Needs cmake, a C++20 compiler and the headers of lz4 and zstd.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

OUT = Path(__file__).parents[1] / "tests" / "references" / "clouds" / "cloudini.npz"
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    + [("ring", "<u2"), ("line", "<u2"), ("t", "<f8"), ("id", "<i4"), ("offset_time", "<u4"), ("flag", "u1")]
)
TYPES = {"f4": 7, "f8": 8, "u2": 4, "u1": 2, "i4": 5, "u4": 6}
XYZI = {"x": 0.001, "y": 0.001, "z": 0.001, "intensity": 0.01}
EXACT = dict.fromkeys(XYZI, 0.0)
INTEGERS = dict.fromkeys(("ring", "line", "id", "offset_time", "flag"), 0.0)
CASES = {  # points, version, encoding, compression, binary header, resolution of each field
    "v3_lossy_lz4": (400, 3, 1, 1, 1, XYZI | {"t": 0.0} | INTEGERS),
    "v4_lossless_zstd": (400, 4, 2, 2, 0, EXACT | {"t": 0.0} | INTEGERS),
    "v5_lossy_zstd": (400, 5, 1, 2, 0, XYZI | {"t": 0.0} | INTEGERS),
    "v5_lossy_none_seconds": (400, 5, 1, 0, 0, XYZI | {"t": 1e-6, "ring": 0.0, "line": 0.0}),
    "v5_none_lz4": (400, 5, 0, 1, 0, EXACT | INTEGERS),
    "v5_two_chunks": (33_000, 5, 1, 2, 0, {"z": 0.001, "line": 0.0, "flag": 0.0}),
}
PROGRAM = """
#include <fstream>
#include <iterator>
#include "cloudini_lib/cloudini.hpp"
using namespace Cloudini;
// POINTS ENCODED DECODED version encoding compression binary point_step count name offset type resolution ...
int main(int count, char** given) {
  std::ifstream file(given[1], std::ios::binary);
  std::vector<uint8_t> raw((std::istreambuf_iterator<char>(file)), {}), encoded, header, decoded;
  EncodingInfo info;
  info.version = std::stoi(given[4]);
  info.encoding_opt = static_cast<EncodingOptions>(std::stoi(given[5]));
  info.compression_opt = static_cast<CompressionOption>(std::stoi(given[6]));
  info.point_step = std::stoi(given[8]);
  info.width = std::stoi(given[9]);
  for (int i = 10; i + 3 < count; i += 4) {
    PointField field;
    field.name = given[i];
    field.offset = std::stoi(given[i + 1]);
    field.type = static_cast<FieldType>(std::stoi(given[i + 2]));
    if (std::stof(given[i + 3]) > 0) field.resolution = std::stof(given[i + 3]);
    info.fields.push_back(field);
  }
  PointcloudEncoder(info).encode(ConstBufferView(raw.data(), raw.size()), encoded);
  EncodeHeader(info, header);
  std::vector<uint8_t> chunks(encoded.begin() + header.size(), encoded.end());
  if (std::stoi(given[7])) EncodeHeader(info, header, HeaderEncoding::BINARY);
  header.insert(header.end(), chunks.begin(), chunks.end());
  ConstBufferView view(header.data(), header.size());
  const auto told = DecodeHeader(view);
  PointcloudDecoder().decode(told, view, decoded);
  std::ofstream(given[2], std::ios::binary).write(reinterpret_cast<char*>(header.data()), header.size());
  std::ofstream(given[3], std::ios::binary).write(reinterpret_cast<char*>(decoded.data()), decoded.size());
}
"""


def cloud(count: int) -> np.ndarray:
    """Points whose columns are best encoded in different ways."""
    row = np.arange(count)
    points = np.zeros(count, POINT)
    points["x"] = np.where(row % 97, 5 + row / 400, np.nan)
    points["y"], points["z"] = np.sin(row / 50) * 4, row % 40 / 16
    points["intensity"], points["ring"], points["line"] = (
        row % 256,
        np.array([3, 900, 17])[row * 7 % 3],
        row // 100,
    )
    points["t"], points["id"] = 100 + row * 1e-4 * (row % 5 > 0), row * row % 1000 - 500
    points["offset_time"], points["flag"] = row * 55, row % 7
    return points


def _offset(field: str) -> int:
    return sum(POINT[name].itemsize for name in (POINT.names or ())[: (POINT.names or ()).index(field)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cloudini", type=Path, help="a checkout of github.com/facontidavide/cloudini")
    source = parser.parse_args().cloudini.resolve() / "cloudini_lib"
    found = {}
    with TemporaryDirectory() as folder:
        build = Path(folder)
        options = ("FORCE_VENDORED_DEPS=OFF", "BUILD_TOOLS=OFF", "BUILD_BENCHMARKS=OFF")
        subprocess.run(
            ["cmake", source, "-DBUILD_TESTING=OFF", *(f"-DCLOUDINI_{option}" for option in options)],
            cwd=build,
            check=True,
        )
        subprocess.run(["make", "-j2"], cwd=build, check=True)
        (build / "main.cpp").write_text(PROGRAM)
        includes = (f"-I{source / 'include'}", f"-I{build / 'include'}")
        libraries = ("libcloudini_lib.a", "-llz4", "-lzstd", "-lpthread")
        subprocess.run(
            ["g++", "-std=c++20", "-O1", "main.cpp", *includes, *libraries, "-o", "main"],
            cwd=build,
            check=True,
        )
        for name, (count, *how, fields) in CASES.items():
            cloud(count).tofile(build / "points")
            told = [
                str(value)
                for field, resolution in fields.items()
                for value in (field, _offset(field), TYPES[POINT[field].str[1:]], resolution)
            ]
            files = ("points", "encoded", "decoded")
            subprocess.run(
                ["./main", *files, *map(str, how), str(POINT.itemsize), str(count), *told],
                cwd=build,
                check=True,
            )
            found[name] = np.fromfile(build / "encoded", np.uint8)
            found[f"{name}_points"] = np.fromfile(build / "decoded", np.uint8)
    np.savez_compressed(OUT, allow_pickle=True, **found)


if __name__ == "__main__":
    main()
