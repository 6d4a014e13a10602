"""The documentation site: ``sphinx-build -W docs site``, without network.

Sphinx, because the docstrings are its own (autodoc reads them with nothing added); MyST, so that pages stay Markdown
that GitHub shows as well; furo, for light, dark and narrow screens. ``-D nb_execution_mode=off`` leaves the notebooks'
answers out and is quick.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(Path(__file__).parent / "extensions")]
# Kernels of notebooks are processes of their own, and see the package of this checkout.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import mgca_filter  # noqa: E402

project = "mgca_filter"
author = "mgca_filter authors"
release = version = mgca_filter.__version__
project_copyright = author

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "generated_reference", "browser_demo"]
exclude_patterns = ["_build", "extensions", "**/.ipynb_checkpoints"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
templates_path: list[str] = []

smartquotes_action = "De"  # dashes and ellipses; quotation marks are code's
pygments_style = "friendly"
pygments_dark_style = "github-dark"

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
add_module_names = False

html_theme = "furo"
html_title = f"mgca_filter {release}"
html_static_path = ["extensions/static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
# Made while the site is built: the report of the example pair (generated_reference), and the demo (browser_demo).
html_extra_path = [tempfile.mkdtemp(prefix="mgca_filter_docs_")]
