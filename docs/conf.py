"""How the documentation is built: ``sphinx-build -W --keep-going -b html docs OUT``."""

import sys
from pathlib import Path

import dougong

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "dougong"
author = "The dougong authors"
project_copyright = author
version = release = dougong.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "from_code",
]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
exclude_patterns = ["_ext", "evidence/README.md"]
source_suffix = {".md": "markdown"}
highlight_language = "text"  # indented blocks are files and output, not programs

myst_enable_extensions = ["colon_fence", "deflist", "attrs_block", "attrs_inline"]
myst_heading_anchors = 4

html_theme = "furo"
html_title = f"dougong {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#9a3412",
        "color-brand-content": "#9a3412",
    },
    "dark_css_variables": {
        "color-brand-primary": "#fb923c",
        "color-brand-content": "#fb923c",
    },
}
