"""Write the C++ library as one header, for those who copy files instead of linking.

    python cpp/tools/single_header.py mgca_filter.hpp

Every file of a program includes it; one defines ``MGCA_IMPLEMENTATION`` before. That one needs OpenCV's ``core`` and
``calib3d`` (of OpenCV 5 ``core`` and ``geometry``) and ONNX Runtime; with ``MGCA_OPENCV_DNN`` defined, OpenCV 5's
``dnn`` in its place. ``MGCA_EMBEDDED_FILE`` may name a model file, as a string, that becomes the embedded one,
``MGCA_EMBEDDED_FIRST_LOOK_FILE`` a quicker one that is asked before it.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

CPP = Path(__file__).resolve().parent.parent
_RUNTIMES = {"MGCA_OPENCV_DNN": "network_opencv.cpp", "": "network_onnxruntime.cpp"}
_LEFT_OUT = {"c_interface.cpp", *_RUNTIMES.values()}
_CONSTANTS = re.compile(r"^constexpr [^;]*;", re.MULTILINE)
_CONSTANT = re.compile(r"\b(k[A-Z]\w*) =")
_INCLUDE = re.compile(r'^#include ["<]([^">]+)[">]\n', re.MULTILINE)


def read(path: Path) -> str:
    """A file whose constants, where another source has some of the same name, are named after the file."""
    text = path.read_text(encoding="utf-8").replace("#pragma once\n", "")
    if path.suffix == ".cpp":
        others = (other for other in path.parent.glob("*.cpp") if other != path)
        taken = {name for other in others for name in constants(other.read_text(encoding="utf-8"))}
        for name in sorted(constants(text) & taken):
            text = re.sub(rf"\b{name}\b", f"{name}_{path.stem}", text)
    return text


def constants(text: str) -> set[str]:
    """Names of a source's own constants."""
    return {name for statement in _CONSTANTS.findall(text) for name in _CONSTANT.findall(statement)}


def inlined(path: Path, seen: set[Path]) -> str:
    """The text of a file with the library's own headers in the place of their includes, each once."""
    if path in seen:
        return ""
    seen.add(path)

    def include(found: re.Match[str]) -> str:
        own = [folder / found[1] for folder in (CPP / "src", CPP / "include") if (folder / found[1]).is_file()]
        return inlined(own[0], seen) if own else found[0]

    return f"// {path.relative_to(CPP).as_posix()}\n{_INCLUDE.sub(include, read(path))}"


def single_header() -> str:
    """The whole library: the public header, and behind ``MGCA_IMPLEMENTATION`` all sources."""
    seen: set[Path] = set()
    licence = (CPP.parent / "LICENSE").read_text(encoding="utf-8")
    parts = [
        "// mgca_filter for C++ in one file, written by cpp/tools/single_header.py. Define MGCA_IMPLEMENTATION in one\n"
        "// source file before including it: that one needs ONNX Runtime, or with MGCA_OPENCV_DNN OpenCV 5.\n//\n",
        "".join(f"// {line}".rstrip() + "\n" for line in licence.strip().splitlines()),
        "\n#pragma once\n\n",
        inlined(CPP / "include" / "mgca" / "filter.hpp", seen),
        "\n#ifdef MGCA_IMPLEMENTATION\n\n",
    ]
    sources = sorted(path for path in (CPP / "src").glob("*.cpp") if path.name not in _LEFT_OUT)
    parts += [inlined(path, seen) + "\n" for path in sources]
    parts.append(inlined(CPP / "src" / "network.hpp", seen))
    for macro, name in _RUNTIMES.items():
        parts.append(f"\n#ifdef {macro}\n" if macro else "\n#else\n")
        parts.append(inlined(CPP / "src" / name, seen))
    return "".join([*parts, "\n#endif\n\n#endif  // MGCA_IMPLEMENTATION\n"])


def main() -> None:
    """Write the header where the command says."""
    if len(sys.argv) != 2:
        sys.exit("usage: single_header.py FILE")
    Path(sys.argv[1]).write_text(single_header(), encoding="utf-8")


if __name__ == "__main__":
    main()
