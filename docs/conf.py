"""The documentation site: `sphinx-build -W docs build/site`. No network is needed."""

import sys
from pathlib import Path

import aniso_pm

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "aniso_pm"
author = copyright = "The aniso_pm authors"  # noqa: A001
version = release = aniso_pm.__version__
html_title = f"aniso_pm {release}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "command_help", "mathml", "mitsuba_docstrings"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_ext"]

html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"
