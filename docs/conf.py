# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the site: make docs."""

import os
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
# Signatures and docstrings are all that is wanted of the package: nothing is compiled.
os.environ["NUMBA_DISABLE_JIT"] = "1"

import fdi_ros  # noqa: E402

project = "fdi_ros"
author = "fdi_ros maintainers"
project_copyright = "2026, fdi_ros maintainers"
version = release = fdi_ros.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}

# Anchors as on the usual hosts of repositories, so that a link works in both places; Sphinx checks them.
myst_heading_anchors = 3

# A name in single backticks, as docstrings have them.
default_role = "code"

# ROS 2 need not be installed where the site is built.
autodoc_mock_imports = [
    "rclpy",
    "builtin_interfaces",
    "diagnostic_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
python_use_unqualified_type_names = True
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"fdi_ros {version}"
html_copy_source = False
html_show_sphinx = False
html_static_path = ["static"]
html_css_files = ["site.css"]
# What is copied is what is typed.
copybutton_prompt_text = "$ "


def shorten_types(app: Any, doctree: nodes.document, docname: str) -> None:
    """Show NDArray[float64] in signatures, as the sources have it, not what it stands for."""
    types = (addnodes.desc_parameter, addnodes.desc_returns, addnodes.desc_annotation)
    for node in [node for kind in types for node in doctree.findall(kind)]:
        text = node.astext().removeprefix(" -> ")
        short = re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
        short = re.sub(
            r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]", r"NDArray[\1]", short
        )
        if short != text:
            node.children = [nodes.Text(short)]


def setup(app: Any) -> None:
    """Connect what this site adds to Sphinx."""
    app.connect("doctree-resolved", shorten_types)
