#!/usr/bin/env python3
"""What a wheel must hold and must not hold: ``.ci/check_wheel.py dist/mgca_filter-*.whl``; prints what is in it.

Exit status 1, with one line for each fault, where it is not as it should be. Python alone, nothing to install.
"""

from __future__ import annotations

import sys
import zipfile
from collections import Counter
from email import message_from_bytes
from email.message import Message
from pathlib import Path

LIMIT_BYTES = 10_000_000
NEEDED = (
    *("mgca_filter/py.typed", "mgca_filter/fit/choice.json", "mgca_filter/models/SHA256SUMS"),
    *("mgca_filter/models/mgca_small.onnx", "mgca_filter/models/mgca_small.md"),
    *("mgca_filter/models/mgca_fast.onnx", "mgca_filter/models/mgca_fast.md"),
    *("mgca_filter/html_report/page.html", "mgca_filter/html_report/style.css", "mgca_filter/html_report/viewer.js"),
    *("mgca_filter/training/configs/small.toml", "licenses/LICENSE", "licenses/LICENSE-WEIGHTS.md"),
)
ONLY_FOLDERS = ("mgca_filter/", "mgca_filter-")
SUFFIXES = (".py", ".onnx", ".safetensors", ".json", ".toml", ".md", ".html", ".css", ".js", ".typed", "/SHA256SUMS")


def faults(path: Path) -> list[str]:
    """What is wrong with a wheel, one line each; empty where nothing is."""
    with zipfile.ZipFile(path) as wheel:
        names = wheel.namelist()
        (metadata_name,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(wheel.read(metadata_name))
    found = [f"lacks {needed}" for needed in NEEDED if not any(name.endswith(needed) for name in names)]
    found += [f"holds {name}" for name in names if not name.startswith(ONLY_FOLDERS)]
    package = [name for name in names if name.startswith("mgca_filter/")]
    found += [f"holds {name}" for name in package if not name.endswith(SUFFIXES) or "__pycache__" in name]
    size = path.stat().st_size
    if size >= LIMIT_BYTES:
        found.append(f"{size} bytes, the limit is {LIMIT_BYTES}")
    return found + metadata_faults(metadata)


def metadata_faults(metadata: Message) -> list[str]:
    """What is wrong with its METADATA."""
    required = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    found = [f"requires {line}" for line in required if not line.startswith(("numpy", "onnxruntime"))]
    if metadata["License-Expression"] != "MIT AND LicenseRef-mgca-weights":
        found.append(f"licence expression {metadata['License-Expression']}")
    pythons = [line.split()[-1] for line in metadata.get_all("Classifier", []) if "Python :: 3." in line]
    if pythons != ["3.10", "3.11", "3.12", "3.13", "3.14"]:
        found.append(f"classifiers of Python {', '.join(pythons)}")
    labels = {line.split(",")[0] for line in metadata.get_all("Project-URL", [])}
    found += [
        f"no project URL {label}" for label in ("Documentation", "Source", "Issues", "Changelog") if label not in labels
    ]
    page = metadata.get_payload()
    found += [
        f"relative link {part.split(')')[0]}" for part in page.split("](")[1:] if not part.startswith(("https://", "#"))
    ]
    return found


def contents(path: Path) -> str:
    """Bytes in the wheel by folder, the largest first."""
    with zipfile.ZipFile(path) as wheel:
        sizes: Counter[str] = Counter()
        for entry in wheel.infolist():
            sizes["/".join(entry.filename.split("/")[:2] if entry.filename.count("/") > 1 else [entry.filename])] += (
                entry.compress_size
            )
    return "\n".join(f"{size:>10}  {name}" for name, size in sizes.most_common(12))


def main() -> int:
    """Look at the wheels that the command line names."""
    status = 0
    for path in map(Path, sys.argv[1:]):
        print(f"{path}: {path.stat().st_size} bytes\n{contents(path)}")
        for fault in faults(path):
            print(f"{path.name}: {fault}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
