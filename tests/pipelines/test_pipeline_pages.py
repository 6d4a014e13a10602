"""The command sequences of docs/pipelines run as they stand there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NEEDS = {"colmap": "pycolmap", "hloc": "h5py", "folder": "pycolmap", "ray": "ray"}
# The package from here, under the names that users type.
PREAMBLE = f"""set -euo pipefail
python() {{ "{sys.executable}" "$@"; }}
mgca-match() {{ "{sys.executable}" -m mgca_filter "$@"; }}
"""


@pytest.mark.slow
@pytest.mark.parametrize("page", NEEDS)
def test_commands_of_the_page(page, tmp_path):
    pytest.importorskip(NEEDS[page])
    blocks = re.findall(r"^```bash\n(.*?)^```$", (ROOT / "docs" / "pipelines" / f"{page}.md").read_text(), re.M | re.S)
    assert blocks
    ray = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "REPOSITORY": str(ROOT), **ray}
    script = PREAMBLE + "".join(blocks)
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
